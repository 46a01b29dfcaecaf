"""Annotations that err: how far, and that the truth is their middle."""

import numpy as np
import pytest

from slatprep.demo import make_asset, make_demo
from slatprep.demo.write import MISTAKEN, SPREAD, sample_grids
from slatprep.errors import ConfigError
from slatprep.parameters.files import load_parameters


def test_parts_err_as_said():
    asset = make_asset(3, 1, levels=(0,))
    known = (asset.grid[..., 3] >= 0) & (asset.grid[..., 3] != 7)
    grids = sample_grids(3, 1, asset, 100)
    assert np.array_equal(grids[:, ~known], np.repeat(asset.grid[~known][None], 100, axis=0))
    parts, first = np.unique(asset.grid[known], axis=0, return_index=True)
    drawn = grids[:, known][:, first].astype(float)
    apart = np.log10(drawn[..., :2] / parts[:, :2])
    # 100 draws of a part: their mean within 4 standard errors, their spread within a third.
    assert (np.abs(apart.mean(axis=0)) < 0.4 * SPREAD[:2]).all()
    assert (np.abs(apart.std(axis=0) / SPREAD[:2] - 1) < 1 / 3).all()
    others = (drawn[..., 3] != parts[:, 3]).mean()
    assert 0.5 * MISTAKEN < others < MISTAKEN
    assert np.array_equal(sample_grids(3, 1, asset, 2), grids[:2])


def test_a_demo_of_several_samples_asks_for_a_merge(tmp_path):
    summary = make_demo(tmp_path / "demo", 1, 0, samples=3)
    assert load_parameters(summary.config).pixieverse.samples == "merge"
    (folder,) = (tmp_path / "demo/pixieverse").iterdir()
    assert sorted(path.name for path in folder.glob("sample_*")) == [
        "sample_0", "sample_1", "sample_2"
    ]  # fmt: skip
    with pytest.raises(ConfigError, match="source 'pixieverse'"):
        make_demo(tmp_path / "other", 1, 0, samples=3, source="pixie-predictions")

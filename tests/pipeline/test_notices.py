"""What a build tells once of a dataset as a whole."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import Dataset

from slatprep.errors import ConfigError
from slatprep.normalize import ranges_from_extents
from slatprep.pipeline.dataset import build_store
from slatprep.pipeline.summary import wild_ranges

USUAL = ((3.2, 10.8), (1.8, 3.8), (0.21, 0.45))


def told(*rows: tuple[tuple[float, float], ...]) -> list[str]:
    extents = np.array(rows, dtype=float)
    return list(wild_ranges("abcdefgh"[: len(rows)], extents, ranges_from_extents(extents)))


def test_an_asset_that_alone_widens_a_range_is_named():
    wild = ((3.2, 10.8), (1.8, 9.7), (0.21, 0.45))
    (text,) = told(USUAL, wild, USUAL)
    assert text.startswith("b alone makes the range of density 7.94e+05 times wider")
    (text,) = told(USUAL, USUAL, ((-3.7, 10.8), *USUAL[1:]))
    assert text.startswith("c alone makes the range of youngs_modulus")


def test_ranges_that_pixie_publishes_are_no_surprise():
    soft, steel = ((3.2, 4.0), (3.0, 3.0), (0.4, 0.4)), ((11.3, 11.3), (3.9, 3.9), (0.3, 0.3))
    assert told(soft, soft, soft, steel) == []
    assert told(USUAL, ((3.2, 10.8), (1.8, 9.7), (0.21, 0.45))) == []  # which of two?


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    made = Dataset(tmp_path / "data").having(*"abcdef")
    return made


def test_objects_with_one_slat_or_one_grid_are_named(dataset, tmp_path):
    asset = dataset.assets["a"]
    dataset.write_slat("c.npz", asset.coords, asset.feats)
    warnings = build_store(dataset.parameters(), tmp_path / "s.zarr").warnings
    assert any("2 assets of different objects have one SLAT (a = c)" in text for text in warnings)
    assert any("have one grid (a = e" in text for text in warnings)


def test_unusual_values_are_told_once_and_recorded(dataset, tmp_path):
    parameters = dataset.parameters()
    warn = replace(parameters.pixieverse, plausibility="warn")
    for name in ("a", "b"):
        file = dataset.root / "pixieverse" / name / "sample_0/material_grid.npy"
        grid = np.load(file)
        grid[..., 1] /= 1e9
        np.save(file, grid)
    summary = build_store(parameters, tmp_path / "refused.zarr")
    assert sorted(name for name, why in summary.problems if "the values look like" in why) == [
        "a",
        "b",
    ]
    summary = build_store(replace(parameters, pixieverse=warn), tmp_path / "s.zarr")
    (text,) = [text for text in summary.warnings if "unusual" in text]
    assert text.startswith("values of 2 of 6 assets are unusual (a, b): the values look like")
    lines = Path(str(summary.records)).read_text().splitlines()
    assert sum("plausibility: " in line for line in lines) == 2


def test_one_asset_alone_does_not_tell_whether_it_is_standardised(tmp_path):
    dataset = Dataset(tmp_path / "data")
    dataset.add("a", 0)
    asset = dataset.assets["a"]
    rng = np.random.default_rng(0)
    narrow = rng.normal(size=asset.feats.shape) * 0.4  # standardised, of one asset
    dataset.write_slat("a.npz", asset.coords, narrow.astype(np.float32))
    parameters = dataset.parameters()
    with pytest.raises(ConfigError, match="one asset alone does not tell"):
        build_store(parameters, tmp_path / "s.zarr")
    said = replace(parameters, slat=replace(parameters.slat, standardised="yes"))
    assert build_store(said, tmp_path / "s.zarr").statuses["ok"] == 1

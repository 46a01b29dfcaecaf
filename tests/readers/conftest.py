"""Small sources whose content is written down by hand."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.raw_sources import COORDS, FEATS, pair_of, raw_grid, touch

from slatprep.parameters import BuildParameters, PairingParameters, PixieverseSource, SlatSource
from slatprep.readers import discover
from slatprep.records import AssetPair, SourceRoots


@pytest.fixture
def make_pair(tmp_path: Path) -> Callable[..., AssetPair]:
    """Write the given arrays as sources and return the pair of them."""

    def make(grid=None, mask=None, bounds=None, coords=COORDS, feats=FEATS) -> AssetPair:
        folder = tmp_path / "pixieverse" / "a"
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / "grid.npy", raw_grid() if grid is None else grid)
        if mask is not None:
            np.save(folder / "mask.npy", mask)
        if bounds is not None:
            np.savez(folder / "bounds.npz", **bounds)
        (tmp_path / "slat").mkdir(exist_ok=True)
        np.savez(tmp_path / "slat" / "a.npz", coords=coords, feats=feats)
        return replace(
            pair_of(folder, tmp_path / "slat" / "a.npz"),
            roots=SourceRoots(tmp_path / "pixieverse", tmp_path / "slat"),
            mask=None if mask is None else folder / "mask.npy",
            bounds=None if bounds is None else folder / "bounds.npz",
        )

    return make


@pytest.fixture
def find(tmp_path):
    """Make empty files on both sides, and return what discover says of them."""

    def run(grids=(), slats=(), *, pixieverse=None, slat=None, **pairing):
        for side, names in (("pixie", grids), ("slat", slats)):
            (tmp_path / side).mkdir(exist_ok=True)
            touch(tmp_path / side, *names)
        sides = (
            PixieverseSource(**{"root": tmp_path / "pixie", **(pixieverse or {})}),
            SlatSource(**{"root": tmp_path / "slat", **(slat or {})}),
        )
        return list(discover(BuildParameters(*sides, pairing=PairingParameters(**pairing))))

    return run

"""Small sources whose content is written down by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slatprep.records import AssetPair

COORDS = np.array([[0, 0, 0], [63, 1, 2], [5, 63, 63]], dtype=np.uint8)
FEATS = np.arange(24, dtype=np.float32).reshape(3, 8) / 8 - 1


def raw_grid() -> np.ndarray:
    """Return three voxels of jelly, metal and stationary in a grid of background.

    Channels are in the files' order: density, Young's modulus, Poisson's ratio, class.
    """
    grid = np.zeros((64, 64, 64, 4), dtype=np.float32)
    grid[..., 3] = 7
    grid[1, 2, 3] = 1000.0, 2.0e6, 0.25, 0
    grid[1, 2, 4] = 7850.0, 2.0e11, 0.30, 1
    grid[60, 0, 63] = 500.0, 1.0e5, 0.45, 6
    return grid


@pytest.fixture
def make_pair(tmp_path: Path) -> Callable[..., AssetPair]:
    """Write the given arrays as sources and return the pair of them."""

    def make(
        grid: np.ndarray | None = None,
        mask: np.ndarray | None = None,
        bounds: dict[str, object] | None = None,
        coords: np.ndarray = COORDS,
        feats: np.ndarray = FEATS,
    ) -> AssetPair:
        folder = tmp_path / "pixieverse" / "a"
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / "grid.npy", raw_grid() if grid is None else grid)
        if mask is not None:
            np.save(folder / "mask.npy", mask)
        if bounds is not None:
            np.savez(folder / "bounds.npz", **bounds)
        (tmp_path / "slat").mkdir(exist_ok=True)
        np.savez(tmp_path / "slat" / "a.npz", coords=coords, feats=feats)
        return AssetPair(
            asset_id="a",
            object_id="a",
            view="",
            category="",
            pixieverse_root=tmp_path / "pixieverse",
            slat_root=tmp_path / "slat",
            grid=folder / "grid.npy",
            mask=None if mask is None else folder / "mask.npy",
            bounds=None if bounds is None else folder / "bounds.npz",
            slat=tmp_path / "slat" / "a.npz",
        )

    return make

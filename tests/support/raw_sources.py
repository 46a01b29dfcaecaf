"""Small sources whose content is written down by hand."""

import io
from pathlib import Path

import numpy as np

from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import discover, read_field
from slatprep.records import AssetPair, MaterialField, SourceRoots, Units

COORDS = np.array([[0, 0, 0], [63, 1, 2], [5, 63, 63]], dtype=np.uint8)
FEATS = np.arange(24, dtype=np.float32).reshape(3, 8) / 8 - 1


def raw_grid() -> np.ndarray:
    """Return three voxels of jelly, metal and stationary in a grid of background."""
    # In the files' order: density, Young's modulus, Poisson's ratio, class.
    grid = np.zeros((64, 64, 64, 4), dtype=np.float32)
    grid[..., 3] = 7
    grid[1, 2, 3] = 1000.0, 2.0e6, 0.25, 0
    grid[1, 2, 4] = 7850.0, 2.0e11, 0.30, 1
    grid[60, 0, 63] = 500.0, 1.0e5, 0.45, 6
    return grid


def changed(array: np.ndarray, *edits: tuple[object, object]) -> np.ndarray:
    """Return a copy with other values at places."""
    made = array.copy()
    for place, value in edits:
        made[place] = value
    return made


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


def grid(name: str) -> str:
    return f"{name}/sample_0/material_grid.npy"


def pair_of(folder: Path, slat: Path) -> AssetPair:
    """Return the pair of a grid and a mask of a folder, which is the root, and a SLAT."""
    roots = SourceRoots(folder, slat.parent)
    return AssetPair("a", "a", "", "", roots, folder / "grid.npy", folder / "mask.npy", None, slat)


def npy(array: np.ndarray) -> bytes:
    """Return an array as `numpy.save` writes it."""
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def field_at(root: Path, adapter: str = "voxels", name: str = "a", **units: str) -> MaterialField:
    """Read the one field below a root, for which a SLAT is made."""
    slat = root.parent / "slat"
    slat.mkdir(exist_ok=True)
    latents = np.zeros((1, 3), np.uint8), np.ones((1, 8), np.float32)
    np.savez(slat / f"{name}.npz", coords=latents[0], feats=latents[1])
    source = PixieverseSource(root, adapter=adapter, units=Units(**units))
    (pair,) = discover(BuildParameters(source, SlatSource(slat)))
    return read_field(pair)

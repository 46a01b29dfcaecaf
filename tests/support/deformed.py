"""A solid without any symmetry, and the same bent or stretched: where each voxel lies is known."""

from collections.abc import Callable

import numpy as np

from slatprep.geometry.frames import voxel_centres
from slatprep.geometry.voxels import boundary, voxels_of
from support.synthetic import JELLY, METAL, Dataset

Move = Callable[[np.ndarray], np.ndarray]

CENTRES = voxel_centres(np.argwhere(np.ones((64, 64, 64), dtype=bool)))


def thing(points: np.ndarray) -> np.ndarray:
    """Say which points (P, 3) of the unit cube are inside a solid without any symmetry."""
    x, y, z = points.T * 64

    def box(low: tuple[int, int, int], high: tuple[int, int, int]) -> np.ndarray:
        inside = np.ones(len(x), dtype=bool)
        for value, a, b in zip((x, y, z), low, high, strict=True):
            inside &= (value >= a) & (value < b)
        return inside

    solid = box((-22, -18, -14), (20, 16, -4)) | box((-22, -18, -4), (-14, 16, 24))
    solid |= box((2, -18, -4), (12, -10, 8))
    return solid | ((x - 12) ** 2 + (y - 8) ** 2 + (z + 2) ** 2 < 64)


def occupancy(move: Move) -> np.ndarray:
    """Return the grid whose voxels x are those with `move(x)` in the solid."""
    return thing(move(CENTRES)).reshape(64, 64, 64)


def bend(points: np.ndarray) -> np.ndarray:
    """Move points smoothly by up to three voxels."""
    x, y, z = points.T * 2 * np.pi * 0.8
    return points + 3 / 64 * np.stack([np.sin(z + 0.4), np.sin(x), np.cos(y)], axis=1)


def stretch(points: np.ndarray) -> np.ndarray:
    return points * [1.15, 1.0, 0.95]


MOVES: dict[str, Move] = {"bent": bend, "long": stretch}


def add_deformed(dataset: Dataset) -> None:
    """Write the solid, metal above and jelly below, and a SLAT for each of `MOVES`."""
    solid = occupancy(lambda points: points)
    grid = np.zeros((64, 64, 64, 4), dtype=np.float32)
    grid[..., 3] = 7
    above = CENTRES.reshape(64, 64, 64, 3)[..., 2] > -4 / 64
    for part, (material, modulus, density, ratio) in ((above, METAL), (~above, JELLY)):
        grid[solid & part] = (density, modulus, ratio, material)
    for name, move in MOVES.items():
        dataset.write_grid(name, grid)
        coords = voxels_of(boundary(occupancy(move)))
        feats = np.random.default_rng(0).normal(size=(len(coords), 8)).astype(np.float32)
        dataset.write_slat(f"{name}.npz", coords, feats)

"""Several annotations of an object, as repeated labelling with errors might give."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slatprep.demo.asset import DemoAsset
from slatprep.records import BACKGROUND

SPREAD = np.array([0.03, 0.15, 0.02])
"""Standard deviation of a part's log10 density, log10 Young's modulus and Poisson's ratio."""

MISTAKEN = 0.15
"""Probability that a part gets another class."""

_STREAM = 6
"""Index of the random stream; those of `slatprep.demo.asset` come before."""


def sample_grids(seed: int, index: int, asset: DemoAsset, samples: int) -> NDArray[np.float32]:
    """Return annotations (samples, 64, 64, 64, 4) whose parts err as a language model errs.

    In each part, log density, log Young's modulus and Poisson's ratio are drawn about the true
    values with `SPREAD`. A sample does not depend on the number of samples.
    """
    known = asset.grid[..., 3] >= 0
    known &= asset.grid[..., 3] != BACKGROUND
    parts, part_of = np.unique(asset.grid[known], axis=0, return_inverse=True)
    grids = np.repeat(asset.grid[None], samples, axis=0)
    for k, grid in enumerate(grids):
        rng = np.random.default_rng([seed, index, _STREAM, k])
        error = rng.normal(0.0, SPREAD, size=(len(parts), 3))
        drawn = parts.astype(np.float64)
        drawn[:, :2] *= 10.0 ** error[:, :2]
        drawn[:, 2] = np.clip(drawn[:, 2] + error[:, 2], 0.05, 0.48)
        mistaken = rng.uniform(size=len(parts)) < MISTAKEN
        drawn[:, 3] = np.where(mistaken, rng.integers(BACKGROUND, size=len(parts)), drawn[:, 3])
        grid[known] = drawn[part_of.reshape(-1)]
    return grids


def write_samples(root: Path, asset: DemoAsset, grids: NDArray[np.float32]) -> None:
    """Write annotations as ``sample_<k>/material_grid.npy`` of an asset below `root`."""
    for k, grid in enumerate(grids):
        folder = root / asset.object_id / f"sample_{k}"
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / "material_grid.npy", grid)

"""Shapes of which everything is known by construction."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slatprep.demo import make_demo
from slatprep.geometry import boundary, occupancy_of, voxels_of
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import discover, read_field, read_latents
from slatprep.records import MaterialField, StructuredLatents
from slatprep.truth import Truth, read_truth

Case = tuple[MaterialField, StructuredLatents, Truth]

GRID = np.stack(np.meshgrid(*[np.arange(64)] * 3, indexing="ij"), axis=-1)


def field_of(occupancy: np.ndarray, material: np.ndarray | None = None) -> MaterialField:
    """Make a field of a solid; `material` (64, 64, 64) gives classes, else all is class 1."""
    voxels = voxels_of(occupancy)
    classes = np.ones(len(voxels), dtype=np.uint8)
    if material is not None:
        classes = material[tuple(voxels.T.astype(int))].astype(np.uint8)
    # Class c has E = 10^(5+c), density 100 (c+1), nu 0.2 + c/100.
    c = classes.astype(np.float64)
    properties = np.stack([10.0 ** (5 + c), 100.0 * (c + 1), 0.2 + c / 100], axis=1)
    return MaterialField(occupancy, voxels, classes, properties.astype(np.float32))


def latents_of(voxels: np.ndarray) -> StructuredLatents:
    """Make a SLAT of given voxels."""
    coords = np.asarray(voxels).reshape(-1, 3).astype(np.uint8)
    return StructuredLatents(coords, np.zeros((len(coords), 8), dtype=np.float32))


def surface_latents(occupancy: np.ndarray) -> StructuredLatents:
    return latents_of(voxels_of(boundary(occupancy)))


def chair() -> np.ndarray:
    """A solid without any symmetry: a box, a back on one side, one arm, one ball."""
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[14:44, 18:42, 20:30] = True
    solid[14:20, 18:42, 30:54] = True
    solid[20:40, 18:22, 30:38] = True
    solid |= ((GRID - np.array([40, 38, 33])) ** 2).sum(axis=-1) < 25
    return solid


def turned(occupancy: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Turn a grid by a signed permutation about the cube's centre."""
    doubled = 2 * np.argwhere(occupancy) - 63
    return occupancy_of((doubled @ rotation.T.astype(int) + 63) // 2)


@pytest.fixture(scope="session")
def demo_cases(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], list[Case]]:
    """Return demo assets of a level with their truth; each level is made once."""
    made: dict[int, list[Case]] = {}

    def cases(level: int) -> list[Case]:
        if level not in made:
            root: Path = tmp_path_factory.mktemp(f"level{level}")
            make_demo(root, assets=14, seed=11, levels=(level,))
            parameters = BuildParameters(
                pixieverse=PixieverseSource(root=root / "pixieverse"),
                slat=SlatSource(root=root / "slat"),
            )
            made[level] = [
                (
                    read_field(pair),
                    read_latents(pair),
                    read_truth(root / "truth" / f"{pair.asset_id}.npz"),
                )
                for pair in discover(parameters)
            ]
        return made[level]

    return cases

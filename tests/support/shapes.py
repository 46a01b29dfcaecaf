"""Shapes of which everything is known by construction."""

from dataclasses import replace
from typing import Any

import numpy as np

from slatprep import Alignment, Annotation, MaterialField, Quality, StructuredLatents
from slatprep.geometry.voxels import boundary, occupancy_of, voxels_of
from slatprep.parameters import SampleParameters
from slatprep.pipeline.annotate import look_up
from slatprep.records import UNANNOTATED, Engine, Judgement, Model, Placement, Search

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


def aligned(*tied: np.ndarray, **others: Any) -> Alignment:
    """Return an alignment by the first of placements that tie, the identity where none is given."""
    first, *rest = tied or (np.eye(4),)
    placements = tuple(Placement(one, 1.0, 9.0) for one in rest)
    how = Engine.FIELD, Model.RIGID, Search.EULER64, Quality(1, 0, 1, 0, 1, 1)
    return replace(Alignment(first, *how, placements=placements), **others)


def annotated(material: np.ndarray, place: np.ndarray | None = None, **others: Any) -> Annotation:
    """Return an annotation of these classes (N,), 255 for none, looked up at places (N, 3)."""
    count = len(material)
    made = Annotation(
        np.ones((count, 3), np.float32),
        np.asarray(material).astype(np.uint8),
        np.asarray(material) < UNANNOTATED,
        np.zeros(count, np.float32),
        np.zeros((count, 3), np.float32) if place is None else place.astype(np.float32),
    )
    return replace(made, **others)


def judged(field: MaterialField, latents: StructuredLatents, alignment: Alignment) -> Judgement:
    """Judge an alignment by the labels that are looked up under it."""
    return look_up(field, latents, alignment, SampleParameters())[1]


def chair() -> np.ndarray:
    """A solid without any symmetry: a box, a back on one side, one arm, one ball."""
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[14:44, 18:42, 20:30] = True
    solid[14:20, 18:42, 30:54] = True
    solid[20:40, 18:22, 30:38] = True
    solid |= ((GRID - np.array([40, 38, 33])) ** 2).sum(axis=-1) < 25
    return solid


def crate(points: np.ndarray) -> np.ndarray:
    """Return which points (N, 3), in voxels, are in a crate with a pole and a flag on its lid."""
    x, y, z = points.T
    body = (x / 15) ** 4 + (y / 18) ** 4 + (z / 18) ** 4 < 1
    pole = (x**2 + y**2 < 4) & (z > 0) & (z < 25)
    flag = (abs(z - 23) < 2) & (x > 0) & (x < 9) & (abs(y) < 3)
    return np.asarray(body | pole | flag).reshape(64, 64, 64)


def turned(occupancy: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Turn a grid by a signed permutation about the cube's centre."""
    doubled = 2 * np.argwhere(occupancy) - 63
    return occupancy_of((doubled @ rotation.T.astype(int) + 63) // 2)

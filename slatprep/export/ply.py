"""A PLY point cloud for each asset, with the fields of Pixie's material fields.

Fields, their order and types are those of Pixie's ``map_pred_to_coords.py``, which Pixie's fork
of PhysGaussian loads (``load_point_cloud``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.errors import StoreError
from slatprep.export.formats import (
    Exported,
    ExportOptions,
    Frame,
    Points,
    Writer,
    annotated_points,
    one_by_one,
)
from slatprep.records import COLOURS, MATERIAL_CLASSES, PROPERTY_COLUMNS, RESOLUTION
from slatprep.storage.arrays import write_ply
from slatprep.storage.files import file_name
from slatprep.store import Store, StoredAsset
from slatprep.store.records import StoredRecords

VERTEX = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
        ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1"),
        ("part_label", "<i4"), ("density", "<f4"), ("E", "<f4"), ("nu", "<f4"),
        ("material_id", "<i4"), ("conf", "<f4"),
    ]
)  # fmt: skip
"""The fields of a point in Pixie's order; density in kg/m^3, E in Pa."""

UNITS = "density kg/m^3, E Pa, nu 1"
"""Comment on the units in every PLY of slatprep."""

COMMENTS: dict[Frame, str] = {
    "slat": "frame SLAT, unit cube -0.5..0.5, z up",
    "pixieverse": "frame PixieVerse, world coordinates of its bounds",
}
"""Comment on the frame in a PLY of an asset."""

Bounds = NDArray[np.float64]
"""Smallest and largest world coordinates of a field, (2, 3)."""

UNIT_CUBE: Bounds = np.array([[-0.5] * 3, [0.5] * 3])
"""Pixie's default bounds."""


def writer(store: Store, ids: Sequence[str], options: ExportOptions) -> Writer:
    """Return the writer of a PLY for each asset; see `slatprep.export.FORMATS`."""
    bounds, notes = read_bounds(store, ids) if options.frame == "pixieverse" else ({}, ())
    points = options.points or "slat"
    one = partial(write, points, options.frame, bounds)
    return one_by_one(one, points=points, remarks=lambda _entries: notes)


def write(
    points: Points, frame: Frame, bounds: Mapping[str, Bounds], directory: Path, asset: StoredAsset
) -> Exported:
    """Write a PLY of an asset's annotated points.

    `bounds` has the world bounds by asset id, for the PixieVerse frame. ``conf`` is 1 for points
    of the grid. For others it falls linearly to 0 at the largest distance that a lookup may have.
    ``part_label`` is the class, as in Pixie's own predictions. A comment names classes that are not
    PhysGaussian's.
    """
    there = annotated_points(asset, points)
    max_distance = asset.store.about.build.parameters.sample.max_distance
    conf = np.clip(1.0 - there.distance / max_distance, 0.0, 1.0)
    positions = there.in_slat
    if frame == "pixieverse":
        positions = to_world(there.in_pixieverse, bounds[asset.asset_id])
    name = f"{file_name(asset.asset_id)}.ply"
    columns = zip(asset.store.contents.properties, there.values.T, strict=True)
    more = {(of.name, of.unit): own for of, own in columns if of.name not in PROPERTY_COLUMNS}
    solid, material, classes = there.solid(asset), there.material, asset.store.contents.classes
    own = () if classes == MATERIAL_CLASSES else classes
    write_points(directory / name, positions, material, solid, conf, COMMENTS[frame], more, own)
    return Exported(asset, name, len(material))


def write_points(
    path: Path,
    positions: NDArray[np.floating],
    material: NDArray[np.uint8],
    properties: NDArray[np.float32],
    conf: NDArray[np.floating],
    frame: str,
    more: Mapping[tuple[str, str], NDArray[np.float32]] | None = None,
    classes: Sequence[str] = (),
) -> None:
    """Write N annotated points as Pixie does, with a class each and ``conf`` in 0..1.

    `properties` (N, 3) are Young's modulus [Pa], density [kg/m^3] and Poisson's ratio; `more` has
    further ones (N,) by name and unit. The line `frame` describes the frame in a comment.
    Comments name `classes` that are not PhysGaussian's, and ``material_id`` is -1 for those.
    """
    more = more or {}
    names: list[str] = []
    for name, _ in more:
        while name in {*names, *(VERTEX.names or ())}:
            name = f"property_{name}"
        names.append(name)
    layout = np.dtype([*VERTEX.descr, *((name, "<f4") for name in names)])
    modulus, density, ratio = properties.T
    alpha = np.full_like(material, 255)
    colours = *COLOURS[material].T, alpha
    solver = np.full(len(material), -1) if classes else material
    fields = *positions.T, *colours, material, density, modulus, ratio, solver, conf
    vertices = np.rec.fromarrays([*fields, *more.values()], layout)
    stated = zip(names, more, strict=True)
    units = ", ".join((UNITS, *(f"{name} {unit}" for name, (_, unit) in stated if unit)))
    labels = (f"part_label {number} is {label}" for number, label in enumerate(classes))
    write_ply(path, vertices, frame, units, *labels)


def has_comment(path: Path, *comments: str) -> bool:
    """Return whether the header of a file has one of slatprep's comments on a PLY."""
    with path.open("rb") as stream:
        head = stream.read(1024)
    return any(one.encode() in head for one in comments)


def read_bounds(store: Store, ids: Sequence[str]) -> tuple[dict[str, Bounds], tuple[str, ...]]:
    """Return the world bounds of assets by id, from their records, and remarks for the user.

    Bounds are `UNIT_CUBE` if the sources stated none. StoreError if a record's bounds are invalid.
    """
    records = StoredRecords(store)
    stated = {asset_id: records.of(asset_id).bounds for asset_id in ids}
    bounds = {
        asset_id: _bounds(one, f"{store.path}: {asset_id}") if one else UNIT_CUBE
        for asset_id, one in stated.items()
    }
    missing = sum(not one for one in stated.values())
    note = f"{missing:,} assets have no world bounds; Pixie's default -0.5..0.5 was taken"
    return bounds, (note,) if missing else ()


def _bounds(stated: dict[str, Any], where: str) -> Bounds:
    try:
        bounds = np.array([stated["min_bounds"], stated["max_bounds"]], dtype=np.float64)
        if bounds.shape != (2, 3) or not (bounds[0] < bounds[1]).all():
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise StoreError(
            f"{where} has bounds {stated}; expected min_bounds and max_bounds of "
            "three numbers each, min below max"
        ) from None
    return bounds


def to_world(points: ArrayLike, bounds: ArrayLike) -> NDArray[np.float64]:
    """Convert points (N, 3) of the PixieVerse frame, the unit cube, to world coordinates.

    `bounds` (2, 3) are ``min_bounds`` and ``max_bounds`` of ``clip_features.npz``. Voxel i lies at
    ``linspace(min_bounds, max_bounds, 64)[i]``, as in Pixie's ``map_pred_to_coords.py``.
    """
    lo, hi = np.asarray(bounds, dtype=np.float64)
    index = (np.asarray(points, dtype=np.float64) + 0.5) * RESOLUTION - 0.5
    world: NDArray[np.float64] = lo + index * (hi - lo) / (RESOLUTION - 1)
    return world

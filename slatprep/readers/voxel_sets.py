"""Convert annotated voxels of any grid, or points, to a field on the frame's 64^3 grid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep import records
from slatprep.errors import InputError
from slatprep.geometry.voxels import flat_index, occupancy_of, shown_in_cells, voxels_at
from slatprep.normalize import from_mapped, to_mapped
from slatprep.readers.plausible import UNSTATED, coarse_places
from slatprep.readers.values import require_plausible

MAX_RESOLUTION = 512


def field_of_voxels(
    where: str | records.Place,
    voxels: NDArray[Any],
    properties: NDArray[Any],
    *,
    roots: records.SourceRoots,
    resolution: int = records.RESOLUTION,
    material: NDArray[Any] | None = None,
    table: Sequence[records.Property] = records.PROPERTIES,
    max_unphysical: float = 0.0,
    sources: Sequence[records.SourceFile] = (),
    frame: NDArray[np.float64] | None = None,
    description: str = "",
    bare: records.Units = UNSTATED,
) -> records.MaterialField:
    """Make a field of annotated voxels (K, 3): integers in 0..resolution - 1, or float points.

    Points lie in the unit cube [-0.5, 0.5]^3. `properties` (K, P) have a column for each entry of
    `table`, in SI units or in those that `roots`, the pair's, state; these also say how implausible
    values are treated. `bare` are the units of what `roots` do not state, by default SI units; an
    SI unit named here is one that the file states, and is not doubted. `material` (K,) are ids of
    the classes of `roots`, all 0 by default, or -1 for an occupied voxel without a class. Errors
    call the source `where`.

    Cells of a grid coarser than 64^3 stay whole. From a finer grid or points, each cell takes its
    voxels' most frequent class (the lowest at a tie) and the mean properties of that class's
    voxels. The mean is in log10 for properties that are normalised in log10. InputError if there is
    no voxel, one is out of range, or too many are unphysical. If a file `description` states the
    resolution, an integer voxel may not occur twice with different values. Integer voxels that fill
    only an eighth of the grid give a warning.
    """
    cells, resolution = _cells_of(where, np.asarray(voxels), resolution)
    count, notes = len(cells), list[str]()
    whole = np.asarray(voxels).dtype.kind != "f"
    if whole:
        way = description and f"say the grid's own resolution in {description}"
        notes += coarse_places(cells, resolution, way)
    given = np.zeros(count, np.int64) if material is None else np.asarray(material)
    with np.errstate(invalid="ignore"):
        own = given.astype(np.int64)
    if given.shape != (count,):
        raise InputError(where, f"has material {given.shape}", f"({count},)")
    last = len(roots.contents.labels) - 1
    if (unknown := (own < -1) | (own > last) | (own != given)).any():
        row = int(np.argmax(unknown))
        expected = f"classes 0 to {last}, or -1 for an occupied voxel without one"
        raise InputError(where, f"has class {given[row]:g} in row {row}", expected)
    if len(classed := np.flatnonzero(own >= 0)) == 0:
        raise InputError(where, f"has no class in any of {count} rows", "a voxel with a class")
    if without := count - len(classed):
        notes.append(f"{without} occupied voxels have no class (-1); not annotated")
    if (shape := np.shape(properties)) != (count, len(table)):
        raise InputError(where, f"has properties {shape}", f"({count}, {len(table)})")
    exact = np.asarray(properties)[classed].astype(np.float64)
    labelled = None if material is None else own[classed]
    notes += require_plausible(where, exact, labelled, table, roots, bare)
    with np.errstate(over="ignore"):  # values beyond float32 become infinite, an error later
        known = exact.astype(np.float32)

    def told(row: int, column: int) -> tuple[str, Any]:
        value = np.asarray(properties)[classed[row], column]
        return f"{table[column].name} {value:g} in row {classed[row]}", value

    fine = physical_rows(where, physical(known, table), table, told, max_unphysical, notes)
    keep, values = classed[fine], known[fine]

    side, index = min(resolution, records.RESOLUTION), cells
    if resolution > records.RESOLUTION:
        cells = (2 * cells + 1) * records.RESOLUTION // (2 * resolution)
    flat = flat_index(cells, side)
    cell, labels, means = _merged(flat[keep], own[keep], values, table)
    if len(cell) < len(keep):
        if whole and description:
            _require_alike(where, keep, flat_index(index[keep], resolution), own[keep], values)
        notes.append(f"{len(keep)} voxels were merged into {len(cell)} of {side}^3")
    annotated, rows = shown_in_cells(voxels_at(cell, (side,) * 3), side)
    return records.MaterialField(
        occupancy=occupancy_of(cells, side),
        voxels=annotated,
        material=labels[rows].astype(np.uint8),
        properties=means[rows],
        unphysical=len(classed) - len(keep),
        sources=tuple(sources),
        warnings=tuple(notes),
        table=tuple(table),
        frame=frame,
        classified=material is not None,
        converted=True,
    )


def _cells_of(
    where: str | records.Place, voxels: NDArray[Any], resolution: int
) -> tuple[NDArray[np.int64], int]:
    """Return the cells (K, 3) of voxels or points, and the number of cells along each axis."""
    if voxels.ndim != 2 or voxels.shape[1] != 3 or len(voxels) == 0:
        raise InputError(where, f"has voxels of shape {voxels.shape}", "(K, 3), one at least")
    if not 2 <= resolution <= MAX_RESOLUTION:
        raise InputError(where, f"has a grid of {resolution}^3", f"2 to {MAX_RESOLUTION} a side")
    index, expected = voxels.astype(np.float64), f"0..{resolution - 1}"
    if voxels.dtype.kind == "f":
        resolution, expected = max(resolution, records.RESOLUTION), "points of [-0.5, 0.5]^3"
        index = np.where(voxels == 0.5, resolution - 1, np.floor((index + 0.5) * resolution))
    inside = ((index >= 0) & (index < resolution)).all(axis=1)
    if not inside.all():
        row = int(np.argmin(inside))
        raise InputError(where, f"voxel {voxels[row].tolist()} in row {row} is outside", expected)
    return index.astype(np.int64), resolution


def physical(values: NDArray[np.float32], table: Sequence[records.Property]) -> NDArray[np.bool_]:
    """Return which values (K, P) a material can have, column by column in memory."""
    return np.stack([one.physical(values[:, k]) for k, one in enumerate(table)]).T


def physical_rows(
    where: str | records.Place,
    fine: NDArray[np.bool_],
    table: Sequence[records.Property],
    told: Callable[[int, int], tuple[str, Any]],
    max_unphysical: float,
    notes: list[str],
) -> NDArray[np.bool_]:
    """Return which annotated voxels (K,) are physical; note a few others, refuse too many.

    `fine` (K, P) is true for each physical value. `told` takes a row and a column, and returns a
    description of the value there and the value in the file.
    """
    keep = np.asarray(fine.all(axis=1))
    if bad := int(np.count_nonzero(~keep)):
        row, column = np.argwhere(~fine)[0].tolist()
        what, value = told(row, column)
        if getattr(value, "dtype", None) == np.float16 and np.isinf(value):
            what += ", as float16 holds nothing above 65,504: save it as float32"
        if bad == len(keep) or bad > max_unphysical * len(keep):
            fault = f"{bad} of {len(keep)} annotated voxels are unphysical, the first by {what}"
            most = f"in all but {100 * max_unphysical:.4g}% (sample.max_unphysical)"
            raise InputError(where, fault, f"{table[column].allowed}, {most}")
        notes.append(f"{bad} voxels are unphysical, the first by {what}; not annotated")
    return keep


def _require_alike(
    where: str | records.Place,
    rows: NDArray[np.intp],
    flat: NDArray[np.int64],
    classes: NDArray[np.int64],
    values: NDArray[np.float32],
) -> None:
    """Refuse rows of the same voxel that differ in class or values; errors name `rows`."""
    order = np.argsort(flat, kind="stable")
    twice = np.flatnonzero(np.diff(flat[order]) == 0)
    first, second = order[twice], order[twice + 1]
    unlike = ~np.isclose(values[first], values[second], rtol=1e-3, atol=0.0)  # as float16 rounds
    other = (classes[first] != classes[second]) | unlike.any(axis=1)
    if other.any():
        both = f"rows {rows[first[other][0]]} and {rows[second[other][0]]}"
        fault = f"{both} are of one voxel, and differ in class or properties"
        raise InputError(where, fault, "each voxel once; or points, as floats in the unit cube")


def _merged(
    flat: NDArray[np.int64],
    classes: NDArray[np.int64],
    values: NDArray[np.float32],
    table: Sequence[records.Property],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Return the cells that hold voxels, sorted, each with a class and a row of values."""
    cells, first, cell = np.unique(flat, return_index=True, return_inverse=True)
    if len(cells) == len(flat):
        return cells, classes[first], values[first]
    most = int(classes.max(initial=0)) + 1
    parties, votes = np.unique(cell * most + classes, return_counts=True)
    # In each cell the class with most votes comes first, at a tie the lowest.
    parties = parties[np.lexsort((parties, -votes, parties // most))]
    winners = parties[np.searchsorted(parties // most, np.arange(len(cells)))] % most
    counted = classes == winners[cell]
    means = np.zeros((len(cells), len(table)))
    np.add.at(means, cell[counted], to_mapped(values[counted], table))
    means /= np.bincount(cell[counted])[:, None]
    return cells, winners, from_mapped(means, table)

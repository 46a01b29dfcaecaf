"""Reading a PixieVerse field: raw grids and the network's predictions.

Both forms become the same `MaterialField` in SI units. Raw grids and
predictions order their channels density, Young's modulus, Poisson's ratio;
slatprep orders them as `PROPERTY_COLUMNS` does, Young's modulus first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep import normalize
from slatprep.errors import InputError
from slatprep.geometry.voxels import voxels_at
from slatprep.parameters import PixieverseSource
from slatprep.readers import files
from slatprep.readers.adapters import Holding, SourceAdapter
from slatprep.readers.values import FOR_ALL, require_plausible, require_possible, require_prediction
from slatprep.readers.voxel_sets import physical, physical_rows
from slatprep.records import (
    BACKGROUND,
    MATERIAL_CLASSES,
    PROPERTIES,
    PROPERTY_COLUMNS,
    RESOLUTION,
    AssetPair,
    MaterialField,
    Normalization,
    Place,
    SourceFile,
    SourceRoots,
    oddity,
    table_of,
)

_CUBE = (RESOLUTION,) * 3
_RAW_SHAPE = (*_CUBE, 4)

GRID = files.ArraySpec((_RAW_SHAPE, (3 + len(MATERIAL_CLASSES), *_CUBE), (4, *_CUBE)), kinds="f")
MASK = files.ArraySpec(shapes=(_CUBE,), kinds="bfiu")
BOUND = files.ArraySpec(shapes=(), kinds="biufU")

_DIFFERS, _CONTRADICTS = 0.05, 0.5
"""Bounds on two shares: voxels with a class that the mask leaves out, and voxels of the mask that
are background. If one is above the first bound, a warning says so; if both are above the second,
grid and mask are not of one object."""

UNLABELLED = -1
"""Class id of an occupied voxel that Pixie's labelling set aside."""

_NO_LOG_OF_ZERO = 1e-6
"""Offset that Pixie adds to density and Young's modulus before it takes log10."""

# Source channel of each of PROPERTY_COLUMNS; the files begin with density.
_CHANNEL_ORDER = (1, 0, 2)


class PixieVerse(SourceAdapter):
    """Source adapter of PixieVerse's grids and Pixie's predictions."""

    patterns = PixieverseSource.grid

    def describe(self, source: PixieverseSource) -> Holding:
        """Return the three properties and PhysGaussian's classes."""
        return Holding()

    def read(self, pair: AssetPair, max_unphysical: float) -> MaterialField:
        """Read the PixieVerse side of a pair: a raw grid or a prediction, and its mask if any.

        A raw grid is (64, 64, 64, 4): density [kg/m^3], Young's modulus [Pa], Poisson's ratio,
        class id. A prediction is (11, 64, 64, 64) or (4, 64, 64, 64): the same three properties,
        then eight class scores or a class id. Properties are normalised to [-1, 1] by Pixie's
        published ranges.

        A voxel is occupied if the (64, 64, 64) mask says so or, without a mask, if it is not
        background. It is annotated if it is occupied, of class 0 to 6, its density and Young's
        modulus are finite and positive, and its Poisson's ratio is in [0, 0.5]. The properties of a
        prediction need only be finite. InputError names file, value and voxel.
        """
        path, _ = files.require_complete(pair)
        root = pair.roots.pixieverse
        channels, raw, source = _channels_of(path, root)
        sources = [source]
        warnings: list[str] = []

        mask = None
        if pair.mask is not None:
            data, source = files.load_source(pair.mask, root, "mask")
            sources.append(source)
            mask = _read_mask(files.npy_array(data, pair.mask, MASK), pair.mask, warnings)

        material = _classes_of(channels, mask, path, warnings)
        occupancy = material != BACKGROUND if mask is None else mask
        if not occupancy.any():
            raise InputError(path, "no voxel is occupied: all are background", "an occupied voxel")
        annotated = _annotated(occupancy, material, path, warnings)
        if pair.mask is not None and raw:
            warnings += _contradictions(pair.mask, occupancy, material, pair.roots)

        cells = np.flatnonzero(annotated)
        voxels = voxels_at(cells)
        properties, classes = _gather(channels, cells), material.reshape(-1)[cells].astype(np.uint8)
        if raw:
            warnings += require_plausible(path, properties, classes, PROPERTIES, pair.roots)
        else:
            warnings += require_prediction(path, properties, classes, pair.roots.plausibility)

        def told(row: int, column: int) -> tuple[str, Any]:
            at = tuple(voxels[row].tolist())
            value = channels[_CHANNEL_ORDER[column]][at]
            return f"{PROPERTIES[column].title} {value:g} at annotated voxel {at}", value

        fine = physical(properties, PROPERTIES) if raw else np.isfinite(properties)
        keep = physical_rows(path, fine, PROPERTIES, told, max_unphysical, warnings)
        if unphysical := int(np.count_nonzero(~keep)):
            voxels, properties, classes = voxels[keep], properties[keep], classes[keep]
        if not raw:
            properties = _to_si(properties, warnings)

        bounds = None
        if pair.bounds is not None:
            bounds = _read_bounds(pair.bounds, root, sources, warnings)
        return MaterialField(
            occupancy=occupancy,
            voxels=voxels,
            material=classes,
            properties=np.ascontiguousarray(properties),
            unphysical=unphysical,
            bounds=bounds,
            converted=True,
            sources=tuple(sources),
            warnings=tuple(warnings),
        )


def read_prediction(
    path: Place, root: Place, where: NDArray[np.bool_], normalization: Normalization
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Read properties (K, 3) and classes (K,) of a grid at the K voxels of the mask `where`.

    The grid has a form of `PixieVerse.read`; its own mask is ignored. The returned properties are
    normalised by `normalization`. Normalised values are converted without clipping. SI values are
    normalised as Pixie does it: 1e-6 is added before log10, and the result is clipped. A class is
    background if several scores are the highest, or the id is -1. InputError if the grid has
    another form, or a value at one of the voxels is not finite or not possible.
    """
    channels, raw, _ = _channels_of(path, root)
    classes = _classes_of(channels, where, path, [])
    material = np.where(classes == UNLABELLED, BACKGROUND, classes)[where].astype(np.uint8)
    values = _gather(channels, np.flatnonzero(where)).astype(np.float64)
    bad = ~np.isfinite(values)
    if raw:
        bad[:, :2] |= values[:, :2] < 0
    if bad.any():
        row, column = _first(bad)
        voxel = tuple(np.argwhere(where)[row].tolist())
        fault = f"{PROPERTY_COLUMNS[column]} {values[row, column]:g} at voxel {voxel}"
        limit = ", none of E and density below 0" if raw else ""
        raise InputError(path, fault, f"finite numbers{limit}")
    if not raw:
        require_prediction(path, values, material)
        return normalize.change_ranges(values, normalize.PIXIE_RANGES, normalization), material
    require_possible(path, values, material)
    values[:, :2] += _NO_LOG_OF_ZERO
    mapped = normalize.to_mapped(values)
    return np.clip(normalize.normalize_mapped(mapped, normalization), -1, 1), material


def _channels_of(path: Place, root: Place) -> tuple[NDArray[Any], bool, SourceFile]:
    """Return the channels of a grid (4 or 11, 64, 64, 64), whether they are raw, and its file."""
    data, source = files.load_source(path, root, "grid")
    grid = files.npy_array(data, path, GRID)
    raw = grid.shape == _RAW_SHAPE
    return np.moveaxis(grid, -1, 0) if raw else grid, raw, source


def _read_mask(values: NDArray[Any], path: Place, warnings: list[str]) -> NDArray[np.bool_]:
    bad = ~((values >= 0) & (values <= 1))  # NaN is bad, too
    if bad.any():
        voxel = _first(bad)
        expected = "0 (empty) or 1 (occupied), or a bool"
        raise InputError(path, f"value {values[voxel]} at voxel {voxel}", expected)
    mask = np.ascontiguousarray(values > 0.5)
    if not mask.any():
        raise InputError(path, "the mask is empty", "an occupied voxel (a value above 0.5)")
    if between := int(np.count_nonzero((values != 0) & (values != 1))):
        warnings.append(f"mask: {between} voxels lie between 0 and 1; above 0.5 is occupied")
    return mask


def _contradictions(
    path: Place, mask: NDArray[np.bool_], material: NDArray[np.int8], roots: SourceRoots
) -> list[str]:
    """Compare a mask with the classes of its raw grid, and return a warning if they differ.

    Predictions are not compared, as they may have any class outside the mask. InputError if most of
    each is not in the other, and `roots.plausibility` is ``refuse``.
    """
    classified = material != BACKGROUND
    both, whole, masked = (
        int(np.count_nonzero(one)) for one in (mask & classified, classified, mask)
    )
    left_out, empty = 1 - both / whole, 1 - both / masked
    if roots.plausibility == "off" or max(left_out, empty) <= _DIFFERS:
        return []
    fault = (
        f"leaves out {left_out:.0%} of the voxels with a class, and {empty:.0%} of it is background"
    )
    table = table_of(roots.number)
    if min(left_out, empty) > _CONTRADICTS and roots.plausibility == "refuse":
        expected = "the mask of this grid, in the same axes, or none: mask = []; or plausibility"
        raise InputError(path, fault, f'{expected} = "warn". {FOR_ALL.format(table)}')
    way = f"is it of this grid, and in the same axes? mask = [] in {table} reads none at all"
    return [oddity("masks", f"{path.name} {fault}: {way}")]


def _classes_of(
    channels: NDArray[Any], mask: NDArray[np.bool_] | None, path: Place, warnings: list[str]
) -> NDArray[np.int8]:
    """Return the class of each voxel from the channels behind the properties: an id, or scores."""
    if len(channels) == 4:
        return _classes_of_ids(channels[3], path)
    return _classes_of_scores(channels[3:], mask, path, warnings)


def _classes_of_ids(ids: NDArray[Any], path: Place) -> NDArray[np.int8]:
    ids = np.ascontiguousarray(ids)  # In a raw grid they are strided, and they are read often.
    with np.errstate(invalid="ignore"):  # values that int8 cannot hold change
        classes = ids.astype(np.int8)
    known = (classes == ids) & (classes >= UNLABELLED) & (classes <= BACKGROUND)
    if not known.all():
        voxel = _first(~known)
        expected = f"whole class ids from {UNLABELLED} to {BACKGROUND}"
        raise InputError(path, f"unknown class {ids[voxel]:g} at voxel {voxel}", expected)
    return classes


def _classes_of_scores(
    scores: NDArray[Any], mask: NDArray[np.bool_] | None, path: Place, warnings: list[str]
) -> NDArray[np.int8]:
    """Return the class of the highest score; voxels outside the mask are background."""
    where = np.ones(_CUBE, dtype=bool) if mask is None else mask
    inside = scores[:, where]
    finite = np.isfinite(inside).all(axis=0)
    if not finite.all():
        voxel = tuple(np.argwhere(where)[np.argmin(finite)].tolist())
        fault = f"a class score is NaN or infinite at voxel {voxel}"
        raise InputError(path, fault, "finite scores")
    top = inside.max(axis=0)
    best = inside.argmax(axis=0).astype(np.int8)
    # If several classes share the highest score (all zero, say), taking the first would label the
    # voxel jelly for no reason.
    tied = (inside == top).sum(axis=0) > 1
    best[tied] = np.where(inside[BACKGROUND, tied] == top[tied], BACKGROUND, UNLABELLED)
    no_single = tied & (best == UNLABELLED)
    _note(warnings, no_single, "voxels have no single highest class score; not annotated")
    material = np.full(_CUBE, BACKGROUND, dtype=np.int8)
    material[where] = best
    return material


def _annotated(
    occupancy: NDArray[np.bool_], material: NDArray[np.int8], path: Place, warnings: list[str]
) -> NDArray[np.bool_]:
    background = material == BACKGROUND
    unlabelled = occupancy & (material == UNLABELLED)
    annotated: NDArray[np.bool_] = occupancy & ~background & ~unlabelled
    if not annotated.any():
        fault = f"none of the {np.count_nonzero(occupancy)} occupied voxels is annotated"
        raise InputError(path, fault, "an occupied voxel of class 0 to 6")
    _note(warnings, unlabelled, "occupied voxels have no class (-1); not annotated")
    # Without a mask, background voxels are not occupied, and both of these are empty.
    empty, outside = occupancy & background, ~occupancy & ~background
    _note(warnings, empty, "voxels of the mask are background; not annotated")
    _note(warnings, outside, "voxels with a class lie outside the mask; left out")
    return annotated


def _note(warnings: list[str], voxels: NDArray[np.bool_], what: str) -> None:
    if voxels.any():
        warnings.append(f"{np.count_nonzero(voxels)} {what}")


def _gather(channels: NDArray[Any], cells: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return the properties (K, 3) at `cells` of the flattened grid, ordered as PROPERTY_COLUMNS.

    They lie in memory column by column, as the checks read them.
    """
    with np.errstate(over="ignore"):  # values beyond float32 become infinite, an error later
        planes = [channels[k].reshape(-1)[cells].astype(np.float32) for k in _CHANNEL_ORDER]
    return np.stack(planes).T


def _to_si(values: NDArray[np.float32], warnings: list[str]) -> NDArray[np.float32]:
    outside = np.count_nonzero(np.abs(values) > 1, axis=0)
    for name, count in zip(PROPERTY_COLUMNS, outside, strict=True):
        if count:
            warnings.append(f"prediction: {count} values of {name} clipped to [-1, 1]")
    return normalize.denormalize_properties(np.clip(values, -1, 1), normalize.PIXIE_RANGES)


def _read_bounds(
    path: Place, root: Place, sources: list[SourceFile], warnings: list[str]
) -> dict[str, object] | None:
    """Return the content of ``clip_features.npz``, JSON-ready; a fault is only a warning.

    Only exports to world coordinates need the bounds.
    """
    try:
        data, source = files.load_source(path, root, "bounds")
        sources.append(source)
        arrays, faults = files.npz_small_arrays(data, path, BOUND)
    except InputError as error:
        warnings.append(f"bounds not read: {error.below(root)}")
        return None
    warnings += [f"bounds: {fault.below(root)}" for fault in faults]
    bounds: dict[str, object] = {}
    for name, value in arrays.items():
        # JSON knows no number longer than a double, and no text beyond Unicode.
        plain = value.astype(np.float64) if value.dtype.kind == "f" else value
        if plain.dtype.kind == "f" and not np.isfinite(plain).all():
            warnings.append(f"bounds: {source.path} [{name}] is not finite; left out")
        elif plain.dtype.kind == "U" and not files.is_text(plain):
            warnings.append(f"bounds: {source.path} [{name}] is no text; left out")
        else:
            bounds[name] = plain.tolist()
    return bounds


def _first(bad: NDArray[np.bool_]) -> tuple[int, ...]:
    """Return the index of the first true entry, in C order."""
    return tuple(np.argwhere(bad)[0].tolist())

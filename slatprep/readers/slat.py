"""Reading structured latents (SLAT) as TRELLIS and its users save them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.geometry.voxels import flat_index
from slatprep.readers.contents import in_words, look_standardised
from slatprep.readers.files import ArraySpec, load_source, npz_arrays
from slatprep.readers.hdf5 import SUFFIXES, hdf5_arrays, load_group
from slatprep.readers.plausible import ENOUGH, coarse_places
from slatprep.records import (
    RESOLUTION,
    TRELLIS,
    LatentSpace,
    Place,
    SourceFile,
    StructuredLatents,
    oddity,
)
from slatprep.records.encoders import LATENTS
from slatprep.storage.place import storage_of


def texture_of(path: Place, space: LatentSpace) -> Place | None:
    """Return the file of texture latents that belongs to a file of shape latents.

    None if the encoder has no texture latents; InputError if the folders are not TRELLIS.2's.
    """
    if not space.encoder.startswith("trellis2-shape-pbr"):
        return None
    return _textures_of(path.parent) / path.name


@lru_cache(maxsize=64)
def _textures_of(shapes: Place) -> Place:
    """Return the folder of texture latents of a folder of shape latents; listed once a process."""
    model, home = shapes.name, shapes.parent
    textures = home.parent / "pbr_latents"
    like = "".join(model.rpartition("_")[1:])  # such as _1024
    try:
        folders = storage_of(textures).names()[1] if home.name == "shape_latents" else []
    except OSError as error:
        fault = f"cannot be listed ({error.strerror})"
        raise InputError(textures, fault, "the folder of texture latents") from None
    found = [name for name in folders if name.endswith(like)]
    if len(found) != 1:
        wanted = (
            f"shape_latents/MODEL{like}/ID.npz and one pbr_latents/MODEL{like}/ below slat.root"
        )
        raise InputError(shapes, f"{len(found)} folders of texture latents go with it", wanted)
    return textures / found[0]


COORDS = ArraySpec(shapes=((None, 3), (None, 4)), kinds="iu")
"""Coordinates, with or without a leading batch column."""

_LARGEST = 1e4
"""Largest usual latent: the latents of known encoders have a spread of some units."""

_SPREADS = 0.2, 1.4
"""Usual spreads of an asset's latents over the encoder's: real ones have 0.5 to 1, those that were
standardised once 0.3, twice 0.12, and those that were scaled back once too often 1.6."""

_MANY_EMPTY = 0.05
"""Largest usual share of rows of zeros; encoders give none."""


def read_slat(
    path: Place, root: Place, group: str = "", space: LatentSpace = TRELLIS
) -> StructuredLatents:
    """Read one SLAT from npz or HDF5.

    The file holds integer ``coords``, (N, 3) or (N, 4) with a leading batch column of zeros, and
    float ``feats``, (N, C) with the encoder's channels C. Other arrays are ignored. If the encoder
    has texture latents behind those of the shape, they are read from a second file.

    Parameters
    ----------
    path : Place
        The npz, or the HDF5 file.
    root : Place
        The folder that must contain `path`; the recorded name is relative to it.
    group : str
        The SLAT's group in an HDF5 file with several; empty for the root.
    space : LatentSpace
        The space of the encoder's latents.

    Returns
    -------
    StructuredLatents
        Coordinates and latents in the order of the file.

    Raises
    ------
    InputError
        If the file cannot be used; the message names file, value and row.
    """
    feats = ArraySpec(((None, space.channels),), "f", note=f" (slat.encoder: {space.encoder})")
    specs = {"coords": COORDS, "feats": feats}
    if texture := texture_of(path, space):
        return _with_texture(path, texture, root, space)
    if group:
        arrays, source = load_group(path, root, group, specs)
    else:
        data, source = load_source(path, root, "slat")
        read = hdf5_arrays if path.suffix.lower() in SUFFIXES else npz_arrays
        arrays = read(data, path, specs)
    where = f"{path} [{group}]" if group else path
    return checked_latents(arrays["coords"], arrays["feats"], where, (source,), space)


def _with_texture(
    path: Place, texture: Place, root: Place, space: LatentSpace
) -> StructuredLatents:
    """Read shape and texture latents of the same voxels as one SLAT."""
    half = replace(space, encoder="trellis2", channels=space.channels // 2, mean=(), std=())
    shape, pbr = read_slat(path, root, "", half), read_slat(texture, root, "", half)
    ours, theirs = (flat_index(one.coords, space.resolution) for one in (shape, pbr))
    order = np.argsort(theirs)
    at = order[np.minimum(np.searchsorted(theirs, ours, sorter=order), len(order) - 1)]
    if len(ours) != len(theirs) or (theirs[at] != ours).any():
        fault = f"has other voxels than {path.name} of the shape"
        raise InputError(texture, fault, "latents of the same voxels")
    (file,) = pbr.sources
    return replace(
        shape,
        feats=np.concatenate([shape.feats, pbr.feats[at]], axis=1),
        sources=(*shape.sources, replace(file, role="texture")),
        warnings=(*shape.warnings, *pbr.warnings),
    )


def checked_latents(
    coords: NDArray[Any],
    feats: NDArray[Any],
    where: str | Place,
    sources: tuple[SourceFile, ...] = (),
    space: LatentSpace = TRELLIS,
) -> StructuredLatents:
    """Return coordinates (N, 3) or (N, 4) and latents (N, C) from any origin as a checked SLAT.

    Raises InputError that names place, value and row if they are not valid.
    """
    if len(coords) != len(feats):
        fault = f"{len(coords)} rows of coords but {len(feats)} of feats"
        raise InputError(where, fault, "one latent per voxel")
    if len(coords) == 0:
        raise InputError(where, "the SLAT is empty", "at least one voxel")
    warnings: list[str] = []
    latents = StructuredLatents(
        check_coords(coords, where, space.resolution, f" (slat.encoder: {space.encoder})"),
        _check_feats(feats, where, warnings),
        sources,
        resolution=space.resolution,
    )
    fits = [name for name, own in LATENTS.items()
            if own.channels == space.channels and own.resolution < space.resolution]  # fmt: skip
    way = (
        "a small object has that; else the grid is coarser: name its encoder as slat.encoder "
        f"({', '.join(fits) or 'a JSON file that describes it'}). That holds for all objects, so "
        "give those of another grid a dataset of their own"
    )
    warnings += coarse_places(latents.coords, space.resolution, way)
    enough = len(coords) >= ENOUGH and not space.standardised
    if enough and look_standardised(latents.moments, space):
        warnings.append(
            f"feats look standardised already ({in_words(latents.moments)}); "
            "slat.standardised says whether they are"
        )
    if len(coords) >= ENOUGH and space.mean:
        usual = np.ones(space.channels) if space.standardised else np.array(space.std)
        spread = float(np.median(np.array(latents.moments.std) / usual))
        alike = _SPREADS[0] <= spread <= _SPREADS[1] or look_standardised(latents.moments, space)
        if spread > 0.0 and not alike:
            what = f"feats spread {spread:.2g} times as far as those of {space.encoder} do"
            warnings.append(oddity("latents", f"{what}: were they standardised or scaled twice?"))
    return replace(latents, warnings=tuple(warnings))


def check_coords(
    coords: NDArray[Any], where: str | Place, side: int = RESOLUTION, whose: str = ""
) -> NDArray[np.uint8]:
    """Return SLAT coordinates as (N, 3) uint8, without a batch column.

    `side` is the number of voxels along an axis; `whose` explains it in errors. InputError if a
    coordinate is out of range or occurs twice, or the batch has more than one asset.
    """
    if coords.shape[1] == 4:
        batch = coords[:, 0]
        if batch.any():
            row = int(np.argmax(batch != 0))
            fault = f"batch index {batch[row]} in row {row}: more than one asset, or not the first"
            raise InputError(where, fault, "one asset per file, batch index 0 throughout")
        coords = coords[:, 1:]
    outside = ((coords < 0) | (coords >= side)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        fault = f"coordinate {tuple(coords[row].tolist())} in row {row} is out of range"
        raise InputError(where, fault, f"coordinates in 0..{side - 1}{whose}")
    voxels = np.ascontiguousarray(coords).astype(np.uint8)
    flat = flat_index(voxels, side)
    counts = np.bincount(flat)
    if (counts > 1).any():
        rows = np.flatnonzero(counts[flat] > 1)
        first, second = np.flatnonzero(flat == flat[rows[0]])[:2]
        place = tuple(voxels[first].tolist())
        fault = f"coordinate {place} occurs twice, in rows {first} and {second}"
        raise InputError(where, fault, "each coordinate once")
    return voxels


def _check_feats(
    feats: NDArray[Any], where: str | Place, warnings: list[str]
) -> NDArray[np.float32]:
    if feats.dtype.itemsize > 4:
        warnings.append(f"feats: {feats.dtype.name} rounded to float32")
    with np.errstate(over="ignore"):  # values beyond float32 become infinite, an error later
        latents = np.ascontiguousarray(feats, dtype=np.float32)
    finite = np.isfinite(latents)
    if not finite.all():
        row, column = np.argwhere(~finite)[0].tolist()
        fault = f"feats is {feats[row, column]} in row {row}, channel {column}"
        raise InputError(where, fault, "finite latents that float32 can hold")
    largest = float(np.abs(latents).max())
    still, empty = (latents == latents[0]).all(axis=0), ~latents.any(axis=1)
    odd = []
    if largest > _LARGEST:
        odd.append(f"feats reach {largest:.3g}, and known encoders' lie within some tens of 0")
    if len(latents) < ENOUGH:
        pass  # A few rows may be alike by chance.
    elif still.all():
        odd.append(f"feats are the same in all {len(latents):,} rows")
    elif still.any():
        channels = ", ".join(map(str, np.flatnonzero(still)))
        odd.append(f"channel {channels} of feats is the same in all rows")
    elif empty.mean() > _MANY_EMPTY:
        odd.append(f"feats are 0 in {empty.mean():.0%} of the rows")
    warnings += [oddity("latents", f"{text}; encode the object again") for text in odd]
    return latents

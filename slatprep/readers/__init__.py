"""Find the pairs by the names of their files, and read and check, or hash, each side."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.geometry.frames import split_transform
from slatprep.parameters import SampleParameters
from slatprep.readers.adapters import latent_adapter, made_by, source_adapter
from slatprep.readers.contents import contents_of
from slatprep.readers.files import ArraySpec, load_source, npy_array, refusing, require_complete
from slatprep.readers.pairing import discover
from slatprep.readers.slat import read_slat, texture_of
from slatprep.readers.slat_files import discover_slats
from slatprep.records import (
    TRELLIS,
    AssetPair,
    MaterialField,
    Place,
    SourceFile,
    SourceRoots,
    StructuredLatents,
    Units,
)

__all__ = [
    "contents_of",
    "discover",
    "discover_slats",
    "hash_sources",
    "read_field",
    "read_latents",
    "read_slat",
    "reading_of",
    "source_digests",
]


def read_field(
    pair: AssetPair, max_unphysical: float = SampleParameters.max_unphysical
) -> MaterialField:
    """Read the annotated side of a pair by the adapter of its source.

    Parameters
    ----------
    pair : AssetPair
        A pair without a problem.
    max_unphysical : float
        See `slatprep.parameters.SampleParameters`.

    Returns
    -------
    MaterialField
        Occupancy, and class and SI properties of the annotated voxels.
        `slatprep.readers.pixieverse.PixieVerse` says what counts as annotated in PixieVerse.

    Raises
    ------
    InputError
        If a file cannot be used; the message names file, value and voxel.
    """
    field = source_adapter(pair.roots.adapter).read(pair, max_unphysical)
    if pair.transform is not None:
        frame, source = _read_transform(pair.transform, pair.roots.pixieverse)
        field = replace(field, frame=frame, sources=(*field.sources, source))
    return replace(field, sources=pair.roots.numbered(field.sources))


def read_latents(pair: AssetPair) -> StructuredLatents:
    """Read the SLAT side of a pair by the adapter of its encoder.

    Parameters
    ----------
    pair : AssetPair
        A pair without a problem.

    Returns
    -------
    StructuredLatents
        Coordinates and latents in the order of the file; see `slatprep.readers.slat.read_slat`.

    Raises
    ------
    InputError
        If the file cannot be used; the message names file, value and row.
    """
    _, path = require_complete(pair)
    space = pair.roots.contents.latents
    adapter = latent_adapter(space.encoder)
    read = read_slat if adapter is None else adapter.read
    return read(path, pair.roots.slat, pair.slat_group, space)


_MATRIX = ArraySpec(shapes=((4, 4),), kinds="fiu")
_EXPECTED = "a 4x4 matrix, source frame to SLAT frame, as numpy.save writes it or as JSON"

_FAR = 100.0
"""Bound on scale and shift of a transform: both sides lie in unit cubes, so more is a mistake."""


def _read_transform(path: Place, root: Place) -> tuple[NDArray[np.float64], SourceFile]:
    """Read a (4, 4) similarity from a JSON list of rows or an npy file below `root`.

    The matrix maps points of the source's unit cube to the SLAT's. The file is returned as a source
    of role ``transform``. InputError if the matrix is not a similarity.
    """
    data, source = load_source(path, root, "transform")
    if path.suffix.lower() == ".json":
        with refusing(path, "holds no matrix", _EXPECTED):
            matrix = np.array(json.loads(data), dtype=np.float64)
    else:
        matrix = npy_array(data, path, _MATRIX).astype(np.float64)
    try:
        _, shift, scale = split_transform(matrix)
        if not (1 / _FAR < scale < _FAR and np.abs(shift).max() < _FAR):
            raise ValueError(f"scale {scale:g} and shift {shift.tolist()} lead out of a unit cube")
    except ValueError as error:
        raise InputError(path, str(error), _EXPECTED) from None
    return matrix, source


def hash_sources(pair: AssetPair) -> tuple[tuple[SourceFile, ...], dict[str, str]]:
    """Hash the files of a pair, in the order in which the readers name them.

    Return the sources that `read_field` and `read_latents` would record, and their digests by
    role. An annotation that cannot be read has the digest ``unreadable``. InputError if no
    annotation can be read.
    """
    sources: list[SourceFile] = []
    digests: dict[str, str] = {}
    faults: list[InputError] = []
    found: Place | None = None
    for one in pair.annotations:
        label = f" {one.sample}" if pair.others else ""
        try:
            _, slat = require_complete(one)
            own, found = _hash_annotation(one), slat
        except InputError as error:
            faults.append(error)
            digests[f"grid{label}"] = "unreadable"
            continue
        for role, digest in (source_digests(own) | reading_of(one.roots)).items():
            digests[role + label] = digest
        sources += [file for file in own if file not in sources]
    if found is None:
        raise faults[0]
    files, shared = _hash_slat(pair, found)
    return (*sources, *files), digests | source_digests(files, shared)


def _hash_annotation(pair: AssetPair) -> tuple[SourceFile, ...]:
    sources = []
    for role, path in pair.files:
        # A fault in the bounds is no error: the reader goes on without them, too.
        with suppress(*([InputError] if role == "bounds" else [])):
            sources.append(load_source(path, pair.roots.pixieverse, role)[1])
    return pair.roots.numbered(sources)


def _hash_slat(
    pair: AssetPair, slat: Place
) -> tuple[tuple[SourceFile, ...], StructuredLatents | None]:
    """Return the files of the latents, and the latents too if their file holds many assets."""
    space, root = pair.roots.contents.latents, pair.roots.slat
    if pair.slat_group:
        latents = read_slat(slat, root, pair.slat_group, space)
        return latents.sources, latents
    files = [("slat", slat), ("texture", texture_of(slat, space))]
    return tuple(load_source(path, root, role)[1] for role, path in files if path), None


def reading_of(roots: SourceRoots) -> dict[str, str]:
    """Return by name the options that change how files are read; empty if all are at default."""
    space, reading = roots.contents.latents, {}
    if roots.adapter != SourceRoots.adapter:
        reading["adapter"] = f"{roots.adapter} {made_by('slatprep.sources', roots.adapter)}"
    if space != TRELLIS:  # Warnings of latents depend on all of it.
        reading["encoder"] = f"{space} {made_by('slatprep.latents', space.encoder)}"
    if roots.units != Units():
        reading["units"] = f"{roots.units.youngs_modulus}, {roots.units.density}"
    if roots.plausibility != SourceRoots.plausibility:
        reading["plausibility"] = roots.plausibility
    return reading


def source_digests(
    sources: Iterable[SourceFile], shared: StructuredLatents | None = None
) -> dict[str, str]:
    """Return the digest of the content of each role.

    `shared` are an asset's latents if their file holds many assets. Their digest replaces the
    file's, which changes with every asset added.
    """
    digests: dict[str, str] = {}
    for source in sources:
        before = digests.get(source.role)
        # A role may have several files, such as the meshes of parts: chain their digests.
        several = f"{before} {source.sha256}".encode()
        digests[source.role] = hashlib.sha256(several).hexdigest() if before else source.sha256
    if shared is not None:
        digest = hashlib.sha256(shared.coords.tobytes())
        digest.update(shared.feats.tobytes())
        digests["slat"] = digest.hexdigest()
    return digests

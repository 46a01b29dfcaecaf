"""Digests of an asset's sources, parsed only where one file holds several assets."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from contextlib import suppress

from slatprep.errors import InputError
from slatprep.readers.adapters import made_by
from slatprep.readers.files import load_source, require_complete
from slatprep.readers.slat import read_slat, texture_of
from slatprep.records import (
    TRELLIS,
    AssetPair,
    Place,
    SourceFile,
    SourceRoots,
    StructuredLatents,
    Units,
)


def hash_sources(pair: AssetPair) -> tuple[tuple[SourceFile, ...], dict[str, str]]:
    """Hash the files of a pair, in the order in which the readers name them.

    Returns what `read_field` and `read_latents` would record as sources, and their digests by
    role. Of several annotations of an object, those that can be read are hashed. InputError if
    there is none.
    """
    sources: list[SourceFile] = []
    digests: dict[str, str] = {}
    faults: list[InputError] = []
    found: Place | None = None
    for one in pair.annotations:
        label = f" {one.sample}" if pair.others else ""
        try:
            grid, slat = require_complete(one)
            own, found = _hash_annotation(one, grid), slat
        except InputError as error:
            faults.append(error)
            digests[f"grid{label}"] = "unreadable"
            continue
        for role, digest in (source_digests(own) | reading_of(one.roots)).items():
            digests[role + label] = digest
        sources += [file for file in own if file not in sources]
    if found is None:
        raise faults[0]
    latents, files = _hash_slat(pair, found)
    return (*sources, *files), digests | source_digests(files, latents)


def _hash_annotation(pair: AssetPair, grid: Place) -> tuple[SourceFile, ...]:
    files = [(grid, "grid"), (pair.mask, "mask"), (pair.bounds, "bounds")]
    files += [(path, "description") for path in pair.beside]
    sources = []
    for path, role in (*files, (pair.transform, "transform")):
        # Bounds are not needed: the reader goes on without them, too.
        with suppress(*([InputError] if role == "bounds" else [])):
            if path:
                sources.append(load_source(path, pair.roots.pixieverse, role)[1])
    return pair.roots.numbered(sources)


def _hash_slat(
    pair: AssetPair, slat: Place
) -> tuple[StructuredLatents | None, tuple[SourceFile, ...]]:
    """Return the latents, where their file holds those of others as well, and their file."""
    space, root = pair.roots.contents.latents, pair.roots.slat
    if not pair.slat_group:
        files = [(slat, "slat"), (texture_of(slat, space), "texture")]
        return None, tuple(load_source(path, root, role)[1] for path, role in files if path)
    latents = read_slat(slat, root, pair.slat_group, space)
    return latents, latents.sources


def reading_of(roots: SourceRoots) -> dict[str, str]:
    """Return which options, besides the bytes, decide how files are read; empty by default."""
    space, reading = roots.contents.latents, {}
    if roots.adapter != SourceRoots.adapter:
        reading["adapter"] = f"{roots.adapter} {made_by('slatprep.sources', roots.adapter)}"
    if (space.channels, space.resolution) != (TRELLIS.channels, TRELLIS.resolution):
        own = made_by("slatprep.latents", space.encoder)
        reading["encoder"] = f"{space.encoder} {space.channels} {space.resolution} {own}"
    if roots.units != Units():
        reading["units"] = f"{roots.units.youngs_modulus}, {roots.units.density}"
    if roots.plausibility != SourceRoots.plausibility:
        reading["plausibility"] = roots.plausibility
    return reading


def source_digests(
    sources: Iterable[SourceFile], shared: StructuredLatents | None = None
) -> dict[str, str]:
    """Return the digest of the content by role.

    `shared` is given where a file holds the latents of many assets. Their digest then replaces
    the file's, which changes with every asset added.
    """
    digests: dict[str, str] = {}
    for source in sources:
        before = digests.get(source.role)
        # Of several files of a role, such as the meshes of parts, every one counts.
        several = f"{before} {source.sha256}".encode()
        digests[source.role] = hashlib.sha256(several).hexdigest() if before else source.sha256
    if shared is not None:
        digest = hashlib.sha256(shared.coords.tobytes())
        digest.update(shared.feats.tobytes())
        digests["slat"] = digest.hexdigest()
    return digests

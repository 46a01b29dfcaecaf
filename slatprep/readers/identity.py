"""What the sources of an asset are, by content, without parsing what need not be parsed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from contextlib import suppress

from slatprep.errors import InputError
from slatprep.readers.files import load_source, require_complete
from slatprep.readers.slat import read_latents
from slatprep.records import AssetPair, SourceFile, StructuredLatents


def hash_sources(pair: AssetPair) -> tuple[tuple[SourceFile, ...], dict[str, str]]:
    """Hash the files of a pair, in the order in which the readers name them.

    Parameters
    ----------
    pair : AssetPair
        A pair without a problem.

    Returns
    -------
    sources : tuple of SourceFile
        What `read_field` and `read_latents` would name as theirs.
    digests : dict of str to str
        What `source_digests` makes of them.

    Raises
    ------
    InputError
        If a file cannot be read.
    """
    grid, slat = require_complete(pair)
    files = [(grid, "grid")] + ([(pair.mask, "mask")] if pair.mask else [])
    sources = [load_source(path, pair.roots.pixieverse, role)[1] for path, role in files]
    if pair.bounds:
        with suppress(InputError):  # The supervision does without, and so does the reader.
            sources.append(load_source(pair.bounds, pair.roots.pixieverse, "bounds")[1])
    latents = read_latents(pair) if pair.slat_group else None
    sources += latents.sources if latents else [load_source(slat, pair.roots.slat, "slat")[1]]
    return tuple(sources), source_digests(sources, latents)


def source_digests(
    sources: Iterable[SourceFile], shared: StructuredLatents | None = None
) -> dict[str, str]:
    """Return a digest of the content by role.

    Parameters
    ----------
    sources : iterable of SourceFile
        The files of an asset.
    shared : StructuredLatents, optional
        The latents, where one file holds those of many assets: it changes
        with every asset added, theirs do not.

    Examples
    --------
    >>> source_digests([SourceFile("grid", "a.npy", 8, "9f86d081")])
    {'grid': '9f86d081'}
    """
    digests = {source.role: source.sha256 for source in sources}
    if shared is not None:
        digest = hashlib.sha256(shared.coords.tobytes())
        digest.update(shared.feats.tobytes())
        digests["slat"] = digest.hexdigest()
    return digests

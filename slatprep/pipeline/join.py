"""Stores made of stores: some assets of one, or those of several, without aligning again.

Rows and records are taken over as they are. Ranges stay too, so a subset keeps
the ranges of the dataset that it was chosen from; only stores that each have
ranges of their own dataset are brought to the ranges of all of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from slatprep.errors import ConfigError
from slatprep.pipeline.pack import resolved_contents
from slatprep.pipeline.rewrite import NO_EXTENT, Source, places_of_sources, write_rows
from slatprep.pipeline.spool import spooled
from slatprep.pipeline.summary import BuildSummary
from slatprep.provenance.stored import StoredRecords
from slatprep.records import Contents, LatentSpace, Normalization, Place, PropertyRange
from slatprep.store import open_store
from slatprep.workers import Progress


def subset_store(
    store: str | Place,
    out: str | Place,
    assets: Iterable[str | int],
    *,
    manifests: str | Place | None = None,
    progress: Progress | None = None,
) -> BuildSummary:
    """Make a store of some assets of another.

    Its bytes are those of a build of the same assets with the same given ranges.

    Parameters
    ----------
    store : str or Place
        The store to choose from; it stays as it is.
    out : str or Place
        The new store, a path or URL; an existing one is replaced in one step.
    assets : iterable of str or int
        Ids, beginnings of ids that no other has, or numbers; see `Store.match`.
    manifests : str or Path, optional
        Folder of its records; by default beside it.
    progress : callable, optional
        Called with the shards written and those there are.

    Returns
    -------
    BuildSummary
        What the new store holds.

    Raises
    ------
    ConfigError
        If no asset is named, or `out` is the store itself.
    StoreError
        If the store lacks an asset, cannot be read, or the disk does not take the new one.
    """
    source = _source(store)
    chosen = {source.store.match(name) for name in assets}
    rows = [(source, row) for row in sorted(chosen, key=source.store.ids.__getitem__)]
    if not rows:
        raise ConfigError(f"no asset of {source.store.path} is chosen; expected one at least")
    contents = source.store.contents
    ranges = source.store.normalization
    return write_rows(rows, ranges, source.build, out, manifests, progress, contents)


def concat_stores(
    stores: Iterable[str | Place],
    out: str | Place,
    *,
    manifests: str | Place | None = None,
    progress: Progress | None = None,
) -> BuildSummary:
    """Make one store of the assets of several.

    Stores with the same ranges are joined byte by byte. Where each has those
    of its own dataset, properties are brought to the ranges that span all of
    them, by way of SI units in float32: right to 1e-6 of a range.

    Parameters
    ----------
    stores : iterable of str or Place
        Two or more; they stay as they are.
    out, manifests, progress
        As for `subset_store`.

    Returns
    -------
    BuildSummary
        What the new store holds.

    Raises
    ------
    ConfigError
        If there are fewer than two, or they do not go together: an id is in two
        of them, parameters of alignment or look-up differ, or ranges differ
        that do not come from the datasets.
    StoreError
        If one cannot be read, or the disk does not
        take the new one.
    """
    sources = [_source(store) for store in stores]
    if len(sources) < 2:
        raise ConfigError(f"{len(sources)} stores to join; expected two or more")
    rows = [(source, row) for source in sources for row in range(len(source.store))]
    times = Counter(source.store.ids[row] for source, row in rows)
    twice = sorted(asset_id for asset_id, count in times.items() if count > 1)
    if twice:
        raise ConfigError(
            f"{len(twice)} ids are in more than one store, such as {', '.join(twice[:3])}; "
            "expected each once: leave them out of one with `slatprep subset`"
        )
    build, contents = _common_build(sources), _common_contents(sources)
    normalization = _common_ranges(sources)
    rows.sort(key=lambda row: row[0].store.ids[row[1]])
    return write_rows(rows, normalization, build, out, manifests, progress, contents)


def _source(place: str | Place) -> Source:
    store = open_store(place)
    return Source(store, StoredRecords(store), store.attributes["build"], places_of_sources(store))


def _common_build(sources: Sequence[Source]) -> dict[str, Any]:
    """Return the attribute ``build`` of the joined store; versions that differ are all named."""
    first = sources[0]
    for other in sources[1:]:
        both = first.build["parameters"], other.build["parameters"]
        for group in sorted({*both[0], *both[1]} - {"store", "normalize"}):
            ours, theirs = (parameters.get(group) for parameters in both)
            if theirs != ours:
                raise ConfigError(
                    f"{other.store.path} was built with [{group}] {theirs}, {first.store.path} "
                    f"with {ours}; expected the same: build one of them again"
                )
    versions: dict[str, list[str]] = {}
    for source in sources:
        for name, version in source.build["versions"].items():
            versions.setdefault(name, []).append(version)
    return {
        **first.build,
        "name": " + ".join(dict.fromkeys(s.build["name"] for s in sources if s.build["name"])),
        "versions": {name: ", ".join(dict.fromkeys(found)) for name, found in versions.items()},
    }


def _common_ranges(sources: Sequence[Source]) -> Normalization:
    """Return the ranges that all have, or those that span all datasets'."""
    ranges = [source.store.normalization for source in sources]
    if all(one == ranges[0] for one in ranges):
        return ranges[0]
    for source, one in zip(sources, ranges, strict=True):
        if one.source != "dataset":
            raise ConfigError(
                f"{source.store.path} has ranges from {one.source!r}, not those of the others; "
                "expected the same in all, or in each those of its dataset: build with --ranges"
            )
    spans = (
        PropertyRange(same[0].name, same[0].log10, min(r.lo for r in same), max(r.hi for r in same))
        for same in zip(*(one.ranges for one in ranges), strict=True)
    )
    return Normalization(tuple(spans), "dataset")


def _in_words(space: LatentSpace) -> str:
    grid = f"{space.channels} channels, {space.resolution}^3 voxels"
    return f"{space.encoder!r} ({grid}, standardised: {space.standardised})"


def _common_contents(sources: Sequence[Source]) -> Contents:
    """Return what all stores hold; moments of latents that a build measured are pooled."""
    first = sources[0].store.contents
    for source in sources[1:]:
        other = source.store.contents
        for name in ("properties", "classes"):
            if getattr(other, name) != getattr(first, name):
                raise ConfigError(
                    f"{source.store.path} has other {name} than {sources[0].store.path}; "
                    "expected the same tables in both"
                )
        if replace(other.latents, mean=(), std=()) != replace(first.latents, mean=(), std=()):
            raise ConfigError(
                f"{source.store.path} has latents of {_in_words(other.latents)}, "
                f"{sources[0].store.path} of {_in_words(first.latents)}; expected the same"
            )
    if all(source.store.contents == first for source in sources):
        return first
    unknown = replace(first, latents=replace(first.latents, mean=(), std=()))
    rows = (spooled(record, NO_EXTENT) for source in sources for record in source.records)
    return resolved_contents(rows, unknown, "as said")

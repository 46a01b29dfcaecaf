"""Make a store from stores, a subset of one or a join of several, without aligning again.

Rows and records are taken over as they are. Ranges stay too, so a subset keeps
the ranges of the dataset from which it was chosen. Only joined stores that each
have the ranges of their own dataset are converted to common ranges.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.errors import ConfigError, StoreError, amount, tally
from slatprep.normalize import ranges_from_bounds, ranges_from_extents
from slatprep.parameters import BuildParameters
from slatprep.pipeline.destination import Destination
from slatprep.pipeline.notices import moved_ranges
from slatprep.pipeline.pack import pack_store
from slatprep.pipeline.publish import BuildSummary, publish_build
from slatprep.pipeline.rows import NextStore, Row, SourceStore, in_order
from slatprep.pipeline.settle import resolved_contents
from slatprep.pipeline.work import work_beside
from slatprep.records import Contents, LatentSpace, Normalization, Place, words_of
from slatprep.storage.atomic import telling_if_stopped
from slatprep.storage.documents import read_as
from slatprep.storage.place import storage_of
from slatprep.storage.versions import is_version
from slatprep.store import Store, open_store
from slatprep.store.reader import open_again
from slatprep.store.records import build_in, found_manifests
from slatprep.workers import Progress
from slatprep.workers.local import Jobs, at_most

NO_ROOT, APART = "unknown", " | "
"""The root that a build's record gives for unknown sources, and what separates several roots."""

_ROWS_A_JOB = 256
"""Least number of rows for each process that is started."""


def subset_store(
    store: Store | str | Place,
    out: str | Place,
    assets: Iterable[str | int] = (),
    *,
    verdicts: Iterable[str] = (),
    categories: Iterable[str] = (),
    manifests: str | Place | None = None,
    jobs: Jobs = 1,
    progress: Progress | None = None,
) -> BuildSummary:
    """Make a store of some assets of another store.

    Its bytes are those of a build of these assets, if that build has the same ranges and moments
    of latents.

    Parameters
    ----------
    store : Store, str or Place
        The store to choose from, open, or its path or URL; it stays as it is.
    out : str or Place
        The new store, a path or URL; an existing one is replaced in one step.
    assets : str, or iterable of str or int
        Ids, unique beginnings of ids, or numbers; see `Store.match`.
    verdicts, categories : str or iterable of str
        Take also the assets that have one of the verdicts and one of the categories, whichever is
        given; the verdict ``all`` takes every asset.
    manifests : str or Path, optional
        Folder of its records; by default beside it.
    jobs : int or Workers
        Worker processes, or a `slatprep.workers.dask.Cluster`.
    progress : callable, optional
        Called with the number of shards written, and of all shards.

    Returns
    -------
    BuildSummary
        What the new store holds.

    Raises
    ------
    ConfigError
        If no asset is named, or `out` is the store itself.
    StoreError
        If the store lacks an asset, or cannot be read, or the new store cannot be written.
    """
    source = _source(store)
    everything = _rows([source])
    chosen = {source.match(name) for name in words_of(assets)}
    verdicts, categories = words_of(verdicts), words_of(categories)
    if verdicts or categories:
        chosen |= set(np.flatnonzero(source.having(verdicts, categories)).tolist())
    rows = in_order([everything[row] for row in chosen], None, compact=True)
    if not rows:
        there = tally(source.column("verdict"))
        raise ConfigError(
            f"no asset of {source.path} is chosen; expected one at least: there are {there}"
        )
    place, parameters = Destination(out, manifests), _parameters([source], source.build)
    ranges, contents = source.normalization, source.contents
    new = NextStore(rows, (source,), ranges, contents, source.build, parameters.store)
    return _write(new, parameters, place, jobs, progress)


def concat_stores(
    stores: Iterable[Store | str | Place],
    out: str | Place,
    *,
    manifests: str | Place | None = None,
    jobs: Jobs = 1,
    progress: Progress | None = None,
) -> BuildSummary:
    """Make one store of the assets of several stores.

    Stores with the same ranges are joined byte by byte. If each store has the
    ranges of its own dataset, properties are converted to ranges that span all
    of them. This goes through SI units in float32 and is right to 1e-6 of a range.

    Parameters
    ----------
    stores : iterable of Store, str or Place
        Two or more; they stay as they are.
    out, manifests, jobs, progress
        As for `subset_store`.

    Returns
    -------
    BuildSummary
        What the new store holds.

    Raises
    ------
    ConfigError
        If there are fewer than two, or they do not fit together: an id is in two
        of them, parameters of alignment or lookup differ, or ranges differ and
        do not come from the datasets.
    StoreError
        If a store cannot be read, or the new store cannot be written.
    """
    single = isinstance(stores, str | Store) or not isinstance(stores, Iterable)
    given = [] if single else list(stores)
    if len(given) < 2:
        count = amount(len(given) or int(single), "store")
        raise ConfigError(f"{count} to join; expected two or more")
    sources = [_source(store) for store in given]
    rows = _rows(sources)
    times = Counter(row.asset_id for row in rows)
    if twice := sorted(asset_id for asset_id, count in times.items() if count > 1):
        raise ConfigError(
            f"the stores share {amount(len(twice), 'id')}, such as {', '.join(twice[:3])}; "
            "expected each once: name the others with `slatprep subset --asset`"
        )
    build, contents = _common_build(sources), _common_contents(sources, rows)
    place, parameters = Destination(out, manifests), _parameters(sources, build)
    rows, ranges = in_order(rows, None, compact=True), _common_ranges(sources)
    new = NextStore(rows, tuple(sources), ranges, contents, build, parameters.store)
    return _write(new, parameters, place, jobs, progress)


def _source(store: Store | str | Place) -> SourceStore:
    # Opened anew, as workers do: an open store may hold data of a store that was replaced since.
    opened = open_store(store)
    return SourceStore(open_again(opened.path, opened.identity))


def _rows(sources: Sequence[SourceStore]) -> list[Row]:
    """Return all rows of stores."""
    return [
        Row(asset_id, size, store=number, row=row)
        for number, source in enumerate(sources)
        for row, (asset_id, size) in enumerate(
            zip(source.ids, np.diff(source.offsets).tolist(), strict=True)
        )
    ]


def _write(
    new: NextStore,
    parameters: BuildParameters,
    place: Destination,
    jobs: Jobs,
    progress: Progress | None,
) -> BuildSummary:
    """Write a store from rows of other stores."""
    begin = time.perf_counter()
    for source in new.stores:
        if _same_place(source.path, place.store):
            raise ConfigError(f"{place.out} is a store to take assets from; choose another path")
    _require_unclipped(new)
    folder = work_beside(place.store, look=place.look)
    with telling_if_stopped(place.if_stopped), folder as work:
        pack_store(work, place, new, at_most(len(new.rows) // _ROWS_A_JOB, jobs), progress)
        sources = {str(source.path): source.normalization for source in new.stores}
        told = moved_ranges(new.normalization, sources)
        return publish_build(place, place.in_place(), parameters, begin, warnings=told)


def _require_unclipped(new: NextStore) -> None:
    """Raise StoreError if a row needs other ranges, but lost values to its own ranges."""
    clipped = (new.column("clipped") + new.column("clipped_grid")).any(axis=1)
    for row, lost in zip(new.rows, clipped, strict=True):
        source = new.stores[row.store]
        if lost and source.normalization.ranges != new.normalization.ranges:
            raise StoreError(
                f"{source.path}: values of {row.asset_id} were clipped to its ranges, "
                "so it cannot be brought to others; build it again"
            )


def _same_place(one: Place, other: Place) -> bool:
    """Return whether a store, or a version of it, lies at another place, also through links."""
    a, b = storage_of(one).local, storage_of(other).local
    one = one.parent.parent if is_version(one) else one
    return one == other if a is None or b is None else a.resolve() == b.resolve()


def _places_of_sources(store: SourceStore) -> dict[str, Any]:
    """Return the places of a store's sources; empty if no record beside it is of its build."""
    folder = found_manifests(store.path, store.about.manifest)
    with suppress(StoreError):  # The store does not need it, and `slatprep verify` names it.
        record = folder and build_in(folder)
        if record and record.id == store.about.manifest:
            names = ("pixieverse", "also", "slat", "pairing")
            named = {name: getattr(record.parameters, name) for name in names}
            return dict(orjson.loads(orjson.dumps(named, default=str)))
    return {}


def _shared(documents: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the entries of a document that all have."""
    first, *others = documents
    return {k: value for k, value in first.items() if all(one.get(k) == value for one in others)}


def _once(texts: Iterable[str], apart: str) -> str:
    """Join texts, some of which may be joined already, with each part once."""
    return apart.join(dict.fromkeys(part for text in texts for part in text.split(apart) if part))


def _parameters(sources: Sequence[SourceStore], build: dict[str, Any]) -> BuildParameters:
    """Return the parameters for the build's record: all roots, and what all sources share."""
    encoder = sources[0].contents.latents.encoder
    unknown = {"pixieverse": {"root": NO_ROOT}, "slat": {"root": NO_ROOT, "encoder": encoder}}
    named = [unknown | _places_of_sources(source) for source in sources]
    places = _shared(named)
    for side, known in unknown.items():
        each = [own[side] for own in named]
        root = _once((own["root"] for own in each), APART)
        places[side] = {**known, **_shared(each), "root": root}
    document = {"name": build["name"], **places, **build["parameters"]}
    try:
        return read_as(BuildParameters, orjson.dumps(document))
    except ValueError as error:
        path = sources[0].path
        raise StoreError(
            f"{path}: its attribute build does not say how it was built ({error}); build it again"
        ) from None


def _common_build(sources: Sequence[SourceStore]) -> dict[str, Any]:
    """Return the attribute ``build`` of the joined store, with all versions that differ."""
    first = sources[0]
    for other in sources[1:]:
        both = first.build["parameters"], other.build["parameters"]
        for group in sorted({*both[0], *both[1]} - {"store", "normalize"}):
            ours, theirs = (parameters.get(group) for parameters in both)
            if theirs != ours:
                raise ConfigError(
                    f"{other.path} was built with [{group}] {theirs}, {first.path} "
                    f"with {ours}; expected the same: build one of them again"
                )
    versions: dict[str, list[str]] = {}
    for source in sources:
        for name, version in source.build["versions"].items():
            versions.setdefault(name, []).append(version)
    return {
        **first.build,
        "name": _once((source.build["name"] for source in sources), " + "),
        "versions": {name: _once(found, ", ") for name, found in versions.items()},
    }


def _common_ranges(sources: Sequence[SourceStore]) -> Normalization:
    """Return the ranges that all stores have, or ranges that span those of all datasets."""
    ranges = [source.normalization for source in sources]
    if all(one.ranges == ranges[0].ranges for one in ranges):
        return next((one for one in ranges if one.source != "dataset"), ranges[0])
    for source, one in zip(sources, ranges, strict=True):
        if one.source != "dataset":
            raise ConfigError(
                f"{source.path} has ranges from {one.source!r}, not those of the others; "
                "expected the same in all, or in each those of its dataset: build with --ranges"
            )
    bounds = np.array([_bounds(source) for source in sources])
    lo, hi = bounds[:, :, 0].min(axis=0), bounds[:, :, 1].max(axis=0)
    return ranges_from_bounds(lo, hi, "dataset", sources[0].contents.properties)


def _bounds(source: SourceStore) -> NDArray[np.float64]:
    """Return the bounds (P, 2) of a store's ranges, without the width given to a single value."""
    extents = source.column("extent")
    own = ranges_from_extents(extents, "dataset", source.contents.properties).ranges
    extent = zip(extents[:, :, 0].min(axis=0), extents[:, :, 1].max(axis=0), strict=True)
    held = zip(source.normalization.ranges, own, extent, strict=True)
    return np.array([ends if one == same else (one.lo, one.hi) for one, same, ends in held])


def _in_words(space: LatentSpace) -> str:
    grid = f"{space.channels} channels, {space.resolution}^3 voxels"
    by = f" by mean {space.mean} and std {space.std}" if space.standardised and space.mean else ""
    return f"{space.encoder!r} ({grid}, standardised: {space.standardised}{by})"


def _on_one_scale(space: LatentSpace) -> LatentSpace:
    """Return what latents must share to be joined; raw ones need no mean and std."""
    return space if space.standardised else replace(space, mean=(), std=())


def _common_contents(sources: Sequence[SourceStore], rows: Sequence[Row]) -> Contents:
    """Return the contents of all stores; pool the moments of latents that builds measured."""
    first = sources[0].contents
    for source in sources[1:]:
        other = source.contents
        for name in ("properties", "classes"):
            if getattr(other, name) != getattr(first, name):
                raise ConfigError(
                    f"{source.path} has other {name} than {sources[0].path}; "
                    "expected the same tables in both"
                )
        if _on_one_scale(other.latents) != _on_one_scale(first.latents):
            raise ConfigError(
                f"{source.path} has latents of {_in_words(other.latents)}, "
                f"{sources[0].path} of {_in_words(first.latents)}; expected the same"
            )
    if all(source.contents == first for source in sources):
        return first
    unknown = replace(first, latents=replace(first.latents, mean=(), std=()))
    return resolved_contents(rows, sources, unknown, "as said")

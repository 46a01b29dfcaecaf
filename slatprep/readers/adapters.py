"""Adapters: how slatprep finds and reads sources and latents of any form.

A *source adapter* finds the fields below a root, reads each, and describes what all of them
hold. A *latent adapter* reads a SLAT and describes the space of its latents. Each has a name
that stands for ``module:object``. The tables here name slatprep's own; other packages name
theirs as entry points of the groups ``slatprep.sources`` and ``slatprep.latents``.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import metadata
from typing import Any, Protocol

from slatprep import records
from slatprep.errors import ConfigError, InputError
from slatprep.parameters import PixieverseSource
from slatprep.readers.foreign import ForeignLatents, ForeignSource
from slatprep.readers.patterns import find_files, list_below, tried_names
from slatprep.records.encoders import LATENTS
from slatprep.storage.files import Listing


@dataclass(frozen=True, slots=True)
class FoundField:
    """The name of a field and its file, relative to the root.

    The adapter also reads the files `beside`. `problem` says why the field cannot be used.
    """

    object_id: str
    path: str
    sample: str = ""
    problem: str = ""
    beside: tuple[str, ...] = ()


@dataclass(frozen=True)
class Holding:
    """Properties that all fields of a source have, and their classes; empty if they have none."""

    properties: tuple[records.Property, ...] = records.PROPERTIES
    classes: tuple[str, ...] = records.MATERIAL_CLASSES


class SourceAdapter(Protocol):
    """Interface to a source of annotated voxels."""

    @property
    def patterns(self) -> Sequence[str]:
        """Patterns of the fields' paths below the root; the dataset definition may replace them."""

    def describe(self, source: PixieverseSource) -> Holding:
        """Return what the source holds; a build asks once, before anything is read."""

    def find(self, source: PixieverseSource, listing: Listing) -> Iterator[FoundField]:
        """Yield the fields of a source; this default finds them by their names alone."""
        return find_by_pattern(patterns_of(self, source), listing, chosen_sample(source))

    def read(self, pair: records.AssetPair, max_unphysical: float) -> records.MaterialField:
        """Read the field at ``pair.grid``; raise `InputError` if that fails.

        Its values are in SI units; those of a field that is not `converted` may be in stated units.
        """


class LatentAdapter(Protocol):
    """Interface to the latents of an encoder."""

    @property
    def space(self) -> records.LatentSpace:
        """Channels, grid and moments of the latents."""

    def read(
        self, path: records.Place, root: records.Place, group: str, space: records.LatentSpace
    ) -> records.StructuredLatents:
        """Read one SLAT; `space` says whether it has been standardised."""

    # An adapter may also have `patterns` of its files' paths below the root, which the dataset
    # definition may replace.


SOURCES = {
    "pixieverse": "slatprep.readers.pixieverse:PixieVerse",
    "voxels": "slatprep.readers.voxels:PlainVoxels",
    "vomp": "slatprep.readers.voxels:VoMP",
    "physxnet": "slatprep.readers.physxnet:PhysXNet",
    "parts": "slatprep.readers.physxnet:Parts",
}
"""slatprep's own source adapters."""

LIBRARIES = {"parts": ("trimesh",)}
"""Packages whose version decides what slatprep's own source adapters read."""


def source_adapter(name: str) -> SourceAdapter:
    """Return the source adapter of this name; ConfigError if there is none or it does not load."""
    adapter: SourceAdapter = _loaded("slatprep.sources", name)
    return adapter


def latent_adapter(name: str) -> LatentAdapter | None:
    """Return another package's adapter of this name, or None; ConfigError if it does not load."""
    if name in LATENTS or name not in _known("slatprep.latents"):
        return None
    adapter: LatentAdapter = _loaded("slatprep.latents", name)
    return adapter


def adapter_names(group: str) -> tuple[str, ...]:
    """Return the names of a group, ``slatprep.sources`` or ``slatprep.latents``."""
    return tuple(_known(group))


def made_by(group: str, name: str) -> str:
    """Return the package of an adapter and its version; of slatprep's own, its `LIBRARIES`."""
    if group == "slatprep.sources" and name in SOURCES:
        return " ".join(f"{one} {_version(one)}" for one in LIBRARIES.get(name, ()))
    return _known(group).get(name, ("", None))[1] or ""


_version = cache(metadata.version)  # Each asset asks for it.


@lru_cache(maxsize=64)
def _loaded(group: str, name: str) -> Any:
    if name not in _known(group):
        known = ", ".join(adapter_names(group))
        raise ConfigError(f"there is no adapter {name!r}; expected {known}, or install its package")
    where, package = _known(group)[name]
    try:
        made: Callable[[], Any] = pkgutil.resolve_name(where)
        adapter = made()
    except (Exception, SystemExit) as error:  # Another package's code may raise anything.
        raise ConfigError(f"adapter {name!r} ({where}) cannot be loaded: {error!r}") from error
    if package is None:
        return adapter
    guarded = ForeignSource if group == "slatprep.sources" else ForeignLatents
    return guarded(adapter, name, package or where)


@lru_cache(maxsize=2)
def _known(group: str) -> dict[str, tuple[str, str | None]]:
    """Return where each adapter of a group lies, and its package; None for slatprep's own."""
    own = SOURCES if group == "slatprep.sources" else dict.fromkeys(LATENTS, "")
    known: dict[str, tuple[str, str | None]] = {name: (own[name], None) for name in own}
    for point in metadata.entry_points(group=group):
        package = f"{point.dist.name} {point.dist.version}" if point.dist else ""
        known.setdefault(point.name, (point.value, package))
    return known


def patterns_of(adapter: SourceAdapter, source: PixieverseSource) -> Sequence[str]:
    """Return the dataset definition's patterns of fields, or the adapter's if it states none."""
    return source.grid if source.grid != PixieverseSource.grid else adapter.patterns


def chosen_sample(source: PixieverseSource) -> dict[str, str]:
    """Return the field of patterns that the dataset definition fixes, if it chooses a sample."""
    return {"sample": source.sample} if source.sample else {}


def find_by_pattern(
    patterns: Sequence[str], listing: Listing, known: Mapping[str, str], first: bool = True
) -> Iterator[FoundField]:
    """Yield the fields whose names match.

    If `first`, yield only those of an object's first matching pattern. Raises ConfigError if a
    pattern has no ``{id}``.
    """
    done: set[str] = set()
    for pattern in patterns:
        if "{id}" not in pattern:
            raise ConfigError(f"grid pattern {pattern!r} names no {{id}}")
        found = [
            FoundField(fields.get("id", path), path, fields.get("sample", ""), problem)
            for fields, path, problem in find_files(
                listing, pattern, known, skip=done if first else ()
            )
        ]
        done |= {one.object_id for one in found}
        yield from found


def find_grids(
    source: PixieverseSource, listing: Listing | None = None
) -> dict[str, list[FoundField]]:
    """Return the grids of each object, as the source's adapter finds them.

    Raises ConfigError if the folder cannot be listed or a pattern makes no sense.
    """
    grids: dict[str, list[FoundField]] = {}
    found = source_adapter(source.adapter).find(source, listing or list_below(source.root))
    for grid in found:
        grids.setdefault(grid.object_id, []).append(grid)
    return grids


def one_grid(
    root: records.Place, found: Sequence[FoundField], object_id: str, tried: Iterable[str]
) -> records.Place:
    """Return the only grid of an object from `find_grids`; InputError if it has none or several."""
    if not found:
        looked = tried_names(tried, {"id": object_id})
        raise InputError(root, f"no grid for id {object_id!r}", f"one of {looked}")
    if len(found) > 1:
        raise InputError(root, several_grids(object_id, found, ""), "one grid of every object")
    if found[0].problem:
        raise InputError(root, found[0].problem, "a grid")
    return root / found[0].path


_CHOOSE = (
    "; choose one with `sample` in the table [pixieverse] of the dataset definition, or say with "
    "--samples what becomes of them: first, all or merge"
)


def several_grids(object_id: str, grids: Sequence[FoundField], samples: str = _CHOOSE) -> str:
    """Say that an object has several grids, and what to do if they are `samples`."""
    files = ", ".join(grid.path for grid in grids)
    if len({grid.sample for grid in grids}) > 1:
        return f"id {object_id!r} has {len(grids)} samples ({files}){samples}"
    return f"{len(grids)} grids for one id {object_id!r} ({files}); expected one"

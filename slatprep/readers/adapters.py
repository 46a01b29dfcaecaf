"""Adapters: how sources and latents of any form are found and read.

A *source adapter* finds the fields below a root, reads one, and describes what
all of them hold; a *latent adapter* reads one SLAT and describes the space of
its latents. Those of slatprep and those of other packages are found alike, by
a name that stands for ``module:object``: slatprep's in the tables here, others
as entry points of the groups ``slatprep.sources`` and ``slatprep.latents``.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import entry_points
from typing import Any, Protocol

from slatprep.errors import ConfigError
from slatprep.parameters import PixieverseSource
from slatprep.readers.foreign import guarded
from slatprep.readers.patterns import find_files
from slatprep.records import (
    MATERIAL_CLASSES,
    PROPERTIES,
    AssetPair,
    LatentSpace,
    MaterialField,
    Place,
    Property,
    StructuredLatents,
)
from slatprep.storage.listing import Listing


@dataclass(frozen=True, slots=True)
class FoundField:
    """A field by its name and its file below the root.

    `beside` is another file that is read for it, below the root too; `problem`
    says why it cannot be used.
    """

    object_id: str
    path: str
    sample: str = ""
    problem: str = ""
    beside: str = ""


@dataclass(frozen=True)
class Holding:
    """What all fields of a source hold: properties, and classes or none."""

    properties: tuple[Property, ...] = PROPERTIES
    classes: tuple[str, ...] = MATERIAL_CLASSES


class SourceAdapter(Protocol):
    """What a source of annotated voxels offers."""

    @property
    def patterns(self) -> Sequence[str]:
        """Where its fields lie below the root, unless the dataset definition says otherwise."""

    def describe(self, source: PixieverseSource) -> Holding:
        """Return what the source holds; a build asks once, before anything is read."""

    def find(self, source: PixieverseSource, listing: Listing) -> Iterator[FoundField]:
        """Yield its fields; `find_by_pattern` does where a name is all there is to it."""

    def read(self, pair: AssetPair, max_unphysical: float) -> MaterialField:
        """Read the field at ``pair.grid``, in SI units; raise `InputError` if it cannot be."""


class LatentAdapter(Protocol):
    """What reads the latents of an encoder."""

    @property
    def space(self) -> LatentSpace:
        """Their width, grid and moments."""

    def read(self, path: Place, root: Place, group: str, space: LatentSpace) -> StructuredLatents:
        """Read one SLAT; `space` says whether it has been standardised."""

    # An adapter may also have `patterns`, where its files lie below the root unless the dataset
    # definition says otherwise.


SOURCES = {
    "pixieverse": "slatprep.readers.pixieverse:PixieVerse",
    "voxels": "slatprep.readers.voxels:PlainVoxels",
    "vomp": "slatprep.readers.vomp:VoMP",
    "physxnet": "slatprep.readers.physxnet:PhysXNet",
}
"""slatprep's own source adapters."""

LATENTS = {
    "trellis": "slatprep.readers.slat:trellis",
    "sam3d": "slatprep.readers.slat:sam3d",
    "trellis2": "slatprep.readers.slat:trellis2",
    "trellis2-512": "slatprep.readers.slat:trellis2_512",
}
"""slatprep's own latent adapters."""


def source_adapter(name: str) -> SourceAdapter:
    """Return a source adapter by its name.

    Raises
    ------
    ConfigError
        If there is none, or it cannot be loaded.
    """
    adapter: SourceAdapter = _loaded("slatprep.sources", name)
    return adapter


def latent_adapter(name: str) -> LatentAdapter | None:
    """Return a latent adapter by its name, None where there is none of it.

    Raises
    ------
    ConfigError
        If it cannot be loaded.
    """
    if name not in {**LATENTS, **_others("slatprep.latents")}:
        return None
    adapter: LatentAdapter = _loaded("slatprep.latents", name)
    return adapter


def adapter_names(group: str) -> tuple[str, ...]:
    """Return the names of a group, ``slatprep.sources`` or ``slatprep.latents``."""
    return (*_OWN[group], *_others(group))


def made_by(group: str, name: str) -> str:
    """Return the package of an adapter and its version; empty for slatprep's own."""
    return "" if name in _OWN[group] else _others(group).get(name, ("", ""))[1]


_OWN: Mapping[str, Mapping[str, str]] = {"slatprep.sources": SOURCES, "slatprep.latents": LATENTS}


@lru_cache(maxsize=64)
def _loaded(group: str, name: str) -> Any:
    others = {} if name in _OWN[group] else _others(group)
    if name not in _OWN[group] and name not in others:
        known = ", ".join(adapter_names(group))
        raise ConfigError(f"there is no adapter {name!r}; expected {known}, or install its package")
    where = _OWN[group].get(name) or others[name][0]
    try:
        made: Callable[[], Any] = pkgutil.resolve_name(where)
        adapter = made()
    except (Exception, SystemExit) as error:  # Another package's code may raise anything.
        raise ConfigError(f"adapter {name!r} ({where}) cannot be loaded: {error!r}") from error
    if name in _OWN[group]:
        return adapter
    return guarded(group, adapter, name, others[name][1] or where)


@lru_cache(maxsize=2)
def _others(group: str) -> dict[str, tuple[str, str]]:
    """Return where the adapters of other packages are, and which version of what they are."""
    return {
        point.name: (point.value, f"{point.dist.name} {point.dist.version}" if point.dist else "")
        for point in entry_points(group=group)
        if point.name not in _OWN[group]
    }


def patterns_of(adapter: SourceAdapter, source: PixieverseSource) -> Sequence[str]:
    """Return the patterns of the dataset definition, or the adapter's where it has none."""
    return source.grid if source.grid != PixieverseSource.grid else adapter.patterns


def find_by_pattern(
    patterns: Sequence[str], listing: Listing, known: Mapping[str, str], beside: str = ""
) -> Iterator[FoundField]:
    """Yield the fields whose names match; of an object, those of the first pattern that does.

    Raises
    ------
    ConfigError
        If a pattern names no ``{id}``.
    """
    done: dict[str, object] = {}
    for pattern in patterns:
        if "{id}" not in pattern:
            raise ConfigError(f"grid pattern {pattern!r} names no {{id}}")
        found = [
            FoundField(fields.get("id", path), path, fields.get("sample", ""), problem, beside)
            for fields, path, problem in find_files(listing, pattern, known, skip=done)
        ]
        done |= dict.fromkeys(one.object_id for one in found)
        yield from found

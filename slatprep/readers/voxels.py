"""Plain voxels: an npz, HDF5, Zarr or PLY per object, and a file that describes the columns.

``source.json`` in the root describes them all::

    {"properties": [{"name": "yield_stress", "unit": "Pa", "scale": "log10"}, ...],
     "classes": ["wood", "steel"], "resolution": 64, "aligned": true}

VoMP's dataset needs no such file: it has voxels with materials as a structured array, no classes.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Le, MaxLen, MinLen
from numpy.typing import NDArray

from slatprep import records
from slatprep.errors import ConfigError, InputError
from slatprep.parameters import PixieverseSource
from slatprep.readers import files
from slatprep.readers.adapters import (
    FoundField,
    Holding,
    SourceAdapter,
    chosen_sample,
    find_by_pattern,
    patterns_of,
)
from slatprep.readers.hdf5 import SUFFIXES, hdf5_arrays
from slatprep.readers.points import ply_points
from slatprep.readers.voxel_sets import MAX_RESOLUTION, field_of_voxels
from slatprep.storage.documents import adapter_of, read_bounded, unique
from slatprep.storage.files import Listing

DESCRIPTION = "source.json"
_MAX_BYTES = 2**16

_MAX_VOXELS = 2**21
"""Most voxels of one object: all of a grid of 128^3."""

_COLUMN = files.ArraySpec(shapes=((None,),), kinds="fiu", max_rows=_MAX_VOXELS)
_VOXELS = files.ArraySpec(shapes=((None, 3),), kinds="fiu", max_rows=_MAX_VOXELS)
_GROUP = "/zarr.json"


@dataclass(frozen=True)
class _Column:
    """A property in ``source.json``."""

    name: records.PropertyName
    unit: str
    scale: Literal["log10", "linear"]
    least: float = -np.inf
    most: float = np.inf

    @property
    def record(self) -> records.Property:
        """The property; a known one has the usual bounds unless others are stated."""
        least, most = self.least, self.most
        for usual in (one for one in records.PROPERTIES if one.name == self.name):
            least = usual.least if least == -np.inf else least
            most = usual.most if most == np.inf else most
        return records.Property(self.name, self.unit, self.scale == "log10", least, most)


@dataclass(frozen=True)
class _Description:
    """The content of ``source.json``; see the documentation of the format."""

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid"}

    properties: Annotated[tuple[_Column, ...], MinLen(1), MaxLen(records.MAX_PROPERTIES)]
    classes: bool | tuple[str, ...] = True
    resolution: Annotated[int, Ge(2), Le(MAX_RESOLUTION)] = 64
    aligned: bool = False
    empty_chunks: tuple[str, ...] = ()

    @property
    def table(self) -> tuple[records.Property, ...]:
        """The properties, as records."""
        return tuple(one.record for one in self.properties)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the classes; PhysGaussian's include the background."""
        known = records.MATERIAL_CLASSES
        if isinstance(self.classes, bool):
            return known if self.classes else ()
        return known if self.classes == known[: records.BACKGROUND] else self.classes


class PlainVoxels(SourceAdapter):
    """``<id>.npz``, ``.h5``, ``.hdf5`` or ``.zarr``: ``voxels`` (K, 3), a column per property.

    Sources with classes also have ``material``. In an ``<id>.ply`` the voxels are the vertices.
    """

    patterns = ("{id}.npz", "{id}.h5", "{id}.hdf5", f"{{id}}.zarr{_GROUP}", "{id}.ply")

    def describe(self, source: PixieverseSource) -> Holding:
        """Read ``source.json``."""
        said = _description(source.root)
        return Holding(said.table, said.names)

    def find(self, source: PixieverseSource, listing: Listing) -> Iterator[FoundField]:
        """Find the fields by the names of their files."""
        # Unlike a grid and a prediction, two forms of an object are equal, and none precedes.
        patterns, chosen = patterns_of(self, source), chosen_sample(source)
        stated = patterns is not self.patterns  # A person's own patterns are in their order.
        for found in find_by_pattern(patterns, listing, chosen, first=stated):
            yield replace(found, path=found.path.removesuffix(_GROUP), beside=(DESCRIPTION,))

    def read(self, pair: records.AssetPair, max_unphysical: float) -> records.MaterialField:
        """Read a field; see `slatprep.readers.adapters.SourceAdapter`."""
        path, _ = files.require_complete(pair)
        root = pair.roots.pixieverse
        text, about = files.load_source(root / DESCRIPTION, root, "description")
        said = _parsed(text, str(root / DESCRIPTION))
        specs = {"voxels": _VOXELS}
        for one in said.properties:
            specs[one.name] = replace(_COLUMN, unit=pair.roots.units.of(one.name) or one.unit)
        specs |= {"material": _COLUMN} if said.classes else {}
        data, file = files.load_source(path, root, "grid")
        kind = path.suffix.lower()
        if kind in SUFFIXES:
            arrays = hdf5_arrays(data, path, specs)
        elif files.is_hierarchy(path):
            arrays = _group_arrays(data, path, specs, said.empty_chunks)
        else:
            read = _ply_arrays if kind == ".ply" else files.npz_arrays
            arrays = read(data, path, specs)
        columns: list[Any] = [arrays[one.name] for one in said.properties]
        lengths = {len(column) for column in arrays.values()}
        if len(lengths) > 1:
            raise InputError(path, f"has columns of {sorted(lengths)} rows", "a row a voxel")
        return field_of_voxels(
            path,
            arrays["voxels"],
            np.stack(columns, axis=1),
            resolution=said.resolution,
            material=arrays.get("material"),
            table=said.table,
            max_unphysical=max_unphysical,
            sources=(file, about),
            frame=np.eye(4) if said.aligned else None,
            roots=pair.roots,
            description=DESCRIPTION,
        )


def _ply_arrays(
    data: bytes, where: str | records.Place, specs: Mapping[str, files.ArraySpec]
) -> dict[str, NDArray[Any]]:
    vertices, _ = ply_points(data, where)
    names = set(vertices.dtype.names or ())
    if missing := [name for name in specs if name != "voxels" and name not in names]:
        raise InputError(where, f"has no property {missing[0]!r}", "one for each of source.json")
    arrays = {name: vertices[name] for name in specs if name != "voxels"}
    arrays["voxels"] = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    for name, array in arrays.items():
        specs[name].check(f"{where} [{name}]", array.shape, array.dtype)
    return arrays


@lru_cache(maxsize=4)
def _parsed(text: bytes, where: str) -> _Description:
    expected = (
        "properties with name, unit and scale, and classes, resolution and aligned where they are "
        "not true, 64, false"
    )
    with files.refusing(where, "does not describe plain voxels", expected, ConfigError):
        read: _Description = adapter_of(_Description).validate_json(text, strict=True)
        json.loads(text, object_pairs_hook=unique)  # pydantic takes the last of two keys.
        if len({one.name for one in read.properties}) < len(read.properties):
            raise ValueError("a property has two columns")
        named = read.classes if isinstance(read.classes, tuple) else ("any",)
        if not all(map(records.CLASS_NAME.fullmatch, named)) or "background" in named:
            raise ValueError(f"the names of classes are {', '.join(named)}")
        if not 1 <= len(set(named)) == len(named) <= records.MANY_BACKGROUND:
            raise ValueError(
                f"there are {len(named)} classes, not 1 to {records.MANY_BACKGROUND} of a name each"
            )
    return read


def _description(root: records.Place) -> _Description:
    path = root / DESCRIPTION
    expected = "a file that says what the columns are"
    with files.refusing(path, "cannot be read", expected, ConfigError):
        text = read_bounded(path, _MAX_BYTES)
    return _parsed(text, str(path))


_ZARR_EXPECTED = (
    "a Zarr group of format 3 with an array for each of {}, packed with zstd, blosc or "
    "nothing; or npz, HDF5 or PLY"
)

_ALL_CHUNKS = (
    'all chunks, as zarr writes them with config={{"write_empty_chunks": True}}; where those left '
    'out hold the fill value, say "empty_chunks": ["{}"] in source.json'
)


def _group_arrays(
    data: bytes,
    where: str | records.Place,
    specs: Mapping[str, files.ArraySpec],
    empty: Collection[str] = (),
) -> dict[str, NDArray[Any]]:
    """Read the named arrays of a group from the archive of `slatprep.readers.files.load_source`.

    Errors call the group `where`. Arrays in `empty` may lack chunks, which then hold the fill
    value. InputError if an array is missing, not as specified, lacks a chunk, or uses another
    compression.
    """
    expected, arrays = _ZARR_EXPECTED.format(", ".join(specs)), {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        there = set(archive.namelist())

        def fetch(name: str, key: str, most: int) -> bytes | None:
            path = f"{name}/{key}"
            if path not in there:
                return None
            if archive.getinfo(path).file_size > most:
                raise ValueError(f"{key} has {archive.getinfo(path).file_size} bytes")
            return archive.read(path)

        def missing(name: str, key: str) -> None:
            if name not in empty:
                fault = f"its chunk {name}/{key} is missing"
                raise InputError(f"{where} [{name}]", fault, _ALL_CHUNKS.format(name))

        for name, spec in specs.items():
            here = f"{where} [{name}]"
            if f"{name}/zarr.json" not in there:
                raise InputError(here, "is not in it", expected)
            lacks = partial(missing, name)
            arrays[name] = files.zarr_array(partial(fetch, name), here, spec, expected, lacks)
    return arrays


_VOMP = {"voxel_data": files.ArraySpec(shapes=((None,),), kinds="V")}


class VoMP(SourceAdapter):
    """``voxels/<id>_with_materials.npz``: x, y, z in the unit cube, E, density and nu in SI units.

    A SLAT encoded from the same mesh lies in the same frame. The field records this frame, and
    the engine ``known`` uses it.
    """

    patterns = ("voxels/{id}_with_materials.npz", "{id}_with_materials.npz")

    def describe(self, source: PixieverseSource) -> Holding:
        """Return PixieVerse's three properties and no classes."""
        return Holding(records.PROPERTIES, ())

    def read(self, pair: records.AssetPair, max_unphysical: float) -> records.MaterialField:
        """Read a field; see `slatprep.readers.adapters.SourceAdapter`."""
        path, _ = files.require_complete(pair)
        data, file = files.load_source(path, pair.roots.pixieverse, "grid")
        rows = files.npz_arrays(data, path, _VOMP)["voxel_data"]
        columns = tuple(one.name for one in records.PROPERTIES)
        missing = {"x", "y", "z", *columns} - set(rows.dtype.names or ())
        if missing or any(rows.dtype[name].kind not in "fiu" for name in (*"xyz", *columns)):
            wanted = f"numbers named x, y, z, {', '.join(columns)}"
            raise InputError(f"{path} [voxel_data]", f"has the columns {rows.dtype}", wanted)
        positions = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
        if not (finite := np.isfinite(positions).all(axis=1)).all():
            row = int(np.argmin(finite))
            fault = f"position {positions[row].tolist()} in row {row} is not finite"
            raise InputError(f"{path} [voxel_data]", fault, "x, y and z in [-0.5, 0.5]")
        return field_of_voxels(
            path,
            # The dataset states lower corners, i / 64 - 0.5; predictions state centres.
            np.floor((positions + 0.5) * records.RESOLUTION + 0.25).astype(np.int64),
            np.stack([rows[name] for name in columns], axis=1),
            max_unphysical=max_unphysical,
            sources=(file,),
            frame=np.eye(4),
            roots=pair.roots,
        )

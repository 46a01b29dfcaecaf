"""Contract for a store's metadata, on which readers rely.

A store may come from a stranger. These checks read nothing but the root's
``zarr.json``, and limit how much any later read can allocate.

zarr-python resolves codecs and data types by the names that it finds, including some that
unpickle, and takes arrays of format 2 from consolidated metadata. So all names in the metadata are
compared with lists of allowed names before zarr-python sees them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from slatprep.errors import StoreError
from slatprep.parameters import MAX_GRID_SHARD, MAX_VOXEL_CHUNK, MAX_VOXEL_SHARD
from slatprep.records import MAX_CHANNELS, MAX_PROPERTIES, RESOLUTION, Place
from slatprep.storage.documents import read_document
from slatprep.store.layout import ASSET_CHUNK, COORDINATES, FILE, FIXED_SIZES, LAYOUTS, ArrayLayout
from slatprep.store.shard_reader import UnreachableError, is_out_of_reach

MAX_METADATA_BYTES = 16 * 2**20
"""Largest size of a zarr.json; all metadata of a store take about 50 kB."""

MAX_VOXELS = RESOLUTION**3
"""Largest number of rows of one asset: each coordinate occurs once."""

MAX_ASSETS, MAX_FILES = 2**24, 2**20

DEFINING = ("asset/id", "voxel/coords", "voxel/feats", "voxel/properties")
"""Arrays whose shapes give the numbers of assets, voxels, channels and properties."""

MIN_ASSET_BYTES = 256
"""Least size of an asset in a store's files: its packed record alone is larger. It limits how many
assets a store may claim for the size of its files."""

_MAX_CHUNK_ROWS = {"asset": ASSET_CHUNK, "voxel": MAX_VOXEL_CHUNK, "grid": 16, FILE: MAX_FILES}
_MAX_SHARD_ROWS = {**_MAX_CHUNK_ROWS, "voxel": MAX_VOXEL_SHARD, "grid": MAX_GRID_SHARD}
_ZARR_NAMES = {"str": "string"}


@dataclass(frozen=True, order=True)
class Finding:
    """One fault, and what is expected instead.

    `file` lies below the store, or is one of the records or sources. `asset` is empty if the fault
    concerns the whole store. `what` tells the fault with the value.
    """

    file: str
    asset: str
    what: str
    expected: str

    def __str__(self) -> str:
        of = f" (asset {self.asset})" if self.asset else ""
        return f"{self.file}{of}: {self.what}; expected {self.expected}"


def read_metadata(path: Place) -> dict[str, Any]:
    """Read a ``zarr.json``; StoreError if it is missing, too large or not a JSON object."""
    try:
        return read_document(path, MAX_METADATA_BYTES)
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and is_out_of_reach(path, error):
            raise UnreachableError(path.parent, path.name, str(error.strerror)) from None
        raise StoreError(f"{path}: cannot be read as metadata ({error})") from None


def array_findings(
    layout: ArrayLayout, metadata: Mapping[str, Any], sizes: Mapping[str, int]
) -> Iterator[Finding]:
    """Yield what is wrong with the ``zarr.json`` of an array; `sizes` are `dimension_sizes`."""
    yield from size_findings(layout.name, metadata, sizes)
    empty = layout.fill_value
    wanted = {
        "data_type": _ZARR_NAMES.get(layout.dtype, layout.dtype),
        "dimension_names": list(layout.dimensions),
        "zarr_format": 3,
        "fill_value": empty if empty == empty else "NaN",  # NaN differs from itself.
    }
    yield from _misformed(f"{layout.name}/zarr.json", metadata, wanted)


def size_findings(name: str, metadata: object, sizes: Mapping[str, int]) -> Iterator[Finding]:
    """Yield what is wrong with the sizes that the metadata of one array claim.

    `sizes` are `dimension_sizes`. Arrays outside the contract are not checked. An array without
    findings may be read: reading allocates no more memory than its files account for.
    """
    if (layout := LAYOUTS.get(name)) is None:
        return
    where = f"{name}/zarr.json"
    if not isinstance(metadata, dict) or metadata.get("node_type") != "array":
        yield Finding(where, "", "describes no array", "the metadata of an array")
        return
    shape = tuple(sizes[dimension] for dimension in layout.dimensions)
    yield from _misformed(where, metadata, {"shape": list(shape)})
    yield from _chunk_findings(where, layout, metadata, shape)


def dimension_sizes(metadata: Mapping[str, Any]) -> dict[str, int]:
    """Return the size of every dimension, from the array that defines it; else StoreError."""
    sizes = dict(FIXED_SIZES)
    for name, dimension, limit in (
        ("asset/id", "asset", MAX_ASSETS),
        ("voxel/coords", "voxel", 2**40),
        (f"{FILE}/name", "file", MAX_FILES),
        ("voxel/feats", "latent", MAX_CHANNELS),
        ("voxel/properties", "property", MAX_PROPERTIES),
    ):
        if dimension == "file" and name not in metadata:
            continue
        at, what = (1, "columns") if dimension in ("latent", "property") else (0, "rows")
        try:
            size = metadata[name]["shape"][at]
        except (KeyError, TypeError, IndexError):
            raise StoreError(f"{name}/zarr.json: is missing or has no shape") from None
        if type(size) is not int or not at <= size <= limit:
            raise StoreError(f"{name}/zarr.json: {size!r} {what}; expected {at} to {limit}")
        sizes[dimension] = size
    sizes["asset_edge"] = sizes["asset"] + 1
    return sizes


def _chunk_findings(
    where: str, layout: ArrayLayout, metadata: Mapping[str, Any], shape: tuple[int, ...]
) -> Iterator[Finding]:
    group = layout.name.partition("/")[0]
    try:
        outer = metadata["chunk_grid"]["configuration"]["chunk_shape"]
        codec = metadata["codecs"][0]
        sharded = codec["name"] == "sharding_indexed"
        inner = codec["configuration"]["chunk_shape"] if sharded else outer
    except (KeyError, TypeError, IndexError):
        yield Finding(where, "", "has no chunk sizes", "a regular chunk grid and codecs")
        return
    for kind, sizes, limit in (
        ("chunk", inner, _MAX_CHUNK_ROWS[group]),
        ("shard", outer, _MAX_SHARD_ROWS[group] if sharded else _MAX_CHUNK_ROWS[group]),
    ):
        fits = isinstance(sizes, list) and len(sizes) == len(shape)
        pairs = zip(sizes, (limit, *shape[1:]), strict=True) if fits else ()
        if not fits or not all(type(n) is int and 1 <= n <= most for n, most in pairs):
            expected = f"1 to {limit} rows of at most {list(shape[1:])}"
            yield Finding(where, "", f"{kind} shape is {sizes!r}", expected)


GROUPS = ("asset", "voxel", "grid", FILE)

NAMES = frozenset(
    (*LAYOUTS, *(f"{group}/{name}" for group, names in COORDINATES.items() for name in names))
)
"""Every array that a store may have."""

DATA_TYPES = ("bool", "uint8", "int64", "float32", "float64", "string")

CODECS = ("bytes", "vlen-utf8", "blosc", "zstd", "crc32c", "sharding_indexed")
"""Codecs that a store may use; none of them can run code."""

_KEYS = frozenset(
    ("zarr_format", "node_type", "shape", "data_type", "chunk_grid", "chunk_key_encoding",
     "fill_value", "codecs", "attributes", "dimension_names", "storage_transformers")
)  # fmt: skip
_FORMS: dict[str, Any] = {
    "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list}},
    "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
}
_SETTINGS: dict[str, Any] = {
    "bytes": {"endian": "little"},
    "zstd": {"level": range(23), "checksum": bool},
    "blosc": {
        "typesize": range(1, 256),
        "cname": ("lz4", "lz4hc", "blosclz", "snappy", "zlib", "zstd"),
        "clevel": range(10),
        "shuffle": ("noshuffle", "shuffle", "bitshuffle"),
        "blocksize": int,
    },
    "sharding_indexed": {
        "chunk_shape": list,
        "codecs": list,
        "index_codecs": list,
        "index_location": "end",
    },
}
"""Forms (see `_has_form`) of codecs' configurations; other codecs have empty ones."""

_GATE: dict[str, Any] = {"zarr_format": 3, "attributes": dict}
_ARRAY_GATE: dict[str, Any] = {
    "storage_transformers": (None, []),
    "data_type": DATA_TYPES,
    "dimension_names": (list[str], None),
}


def gate_findings(name: str, metadata: object) -> Iterator[Finding]:
    """Yield what is not allowed in the ``zarr.json`` of an array or group, or in its root copy."""
    where, kinds = f"{name}/zarr.json", {"array": NAMES, "group": GROUPS}
    kind = str(metadata.get("node_type")) if isinstance(metadata, Mapping) else ""
    if not isinstance(metadata, Mapping) or name not in kinds.get(kind, ()):
        what = "is no array or group of a store"
        yield Finding(where, "", what, "those that docs/formats.md has")
        return
    yield from _misformed(where, {"attributes": {}, **metadata}, _GATE)
    if kind == "group":
        # zarr-python would take unchecked arrays from here.
        nested = metadata.get("consolidated_metadata")
        empty = isinstance(nested, Mapping) and nested.get("metadata") == {}
        if not (nested is None or empty):
            yield Finding(where, "", "has consolidated metadata of its own", "the root's alone")
        return
    yield from _misformed(where, metadata, _ARRAY_GATE)
    for codec in _codecs(metadata.get("codecs")):
        used = codec.get("name")
        if used not in CODECS:
            yield Finding(where, "", f"has the codec {used!r}", f"some of {', '.join(CODECS)}")


def form_findings(name: str, metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield differences of an array's ``zarr.json`` from the form that Zarr writes."""
    if metadata.get("node_type") != "array":
        return
    where = f"{name}/zarr.json"
    for key in metadata.keys() - _KEYS:
        yield Finding(where, "", f"has {key!r}", f"none but {', '.join(sorted(_KEYS))}")
    yield from _misformed(where, metadata, _FORMS)
    for codec in _codecs(metadata.get("codecs")):
        name, settings = str(codec.get("name")), codec.get("configuration", {})
        wanted = _SETTINGS.get(name, {})
        if not (_has_form(settings, wanted) or (name == "bytes" and settings == {})):
            what = f"the codec {name} has the configuration {settings!r}"
            yield Finding(where, "", what, _in_words(wanted))


def _misformed(
    where: str, metadata: Mapping[str, Any], forms: Mapping[str, Any]
) -> Iterator[Finding]:
    """Yield a finding for each entry that lacks its form; see `_has_form`."""
    for key, form in forms.items():
        if not _has_form(metadata.get(key), form):
            yield Finding(where, "", f"{key} is {metadata.get(key)!r}", _in_words(form))


def _has_form(value: Any, form: Any) -> bool:
    """Return whether a JSON value has a form: a type, a value, alternatives or an object."""
    if isinstance(form, dict):
        whole = isinstance(value, dict) and value.keys() == form.keys()
        return whole and all(_has_form(value[key], form[key]) for key in form)
    if isinstance(form, tuple | range):
        return any(_has_form(value, one) for one in form)
    if form == list[str]:
        return isinstance(value, list) and all(isinstance(one, str) for one in value)
    return type(value) is form or (type(value) is type(form) and value == form)


def _in_words(form: Any) -> str:
    if isinstance(form, dict):
        return f"{{{', '.join(f'{key}: {_in_words(one)}' for key, one in form.items())}}}"
    if isinstance(form, range):
        return f"{form[0]} to {form[-1]}"
    if isinstance(form, tuple):
        return " or ".join(map(_in_words, form))
    words = ((list[str], "a name for each dimension"), (dict, "a JSON object"), (None, "none"))
    told = [word for one, word in words if form == one]
    return told[0] if told else form.__name__ if isinstance(form, type) else repr(form)


def _codecs(codecs: Any) -> Iterator[Mapping[str, Any]]:
    """Yield codecs and the codecs within them; an empty mapping replaces a malformed codec."""
    for codec in codecs if isinstance(codecs, list) else [None]:
        known = codec if isinstance(codec, Mapping) else {}
        yield known
        if known.get("name") == "sharding_indexed":
            inner = known.get("configuration")
            for key in ("codecs", "index_codecs"):
                yield from _codecs(inner.get(key) if isinstance(inner, Mapping) else None)

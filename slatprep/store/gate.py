"""What the metadata of a store may name: lists of arrays, data types and codecs that are allowed.

zarr-python looks codecs and data types up by the names that it finds, among them
some that unpickle, and takes arrays of format 2 from consolidated metadata. A
stranger's store is held against these lists before zarr-python sees any of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from slatprep.store.contract import Finding
from slatprep.store.layout import COORDINATES, FILE, LAYOUTS

GROUPS = ("asset", "voxel", "grid", FILE)

NAMES = frozenset(
    (*LAYOUTS, *(f"{group}/{name}" for group, names in COORDINATES.items() for name in names))
)
"""Every array that a store may have."""

DATA_TYPES = ("bool", "uint8", "int64", "float32", "float64", "string")

CODECS = ("bytes", "vlen-utf8", "blosc", "zstd", "crc32c", "sharding_indexed")
"""What a store is packed with; none of these can run code."""

_KEYS = frozenset(
    ("zarr_format", "node_type", "shape", "data_type", "chunk_grid", "chunk_key_encoding",
     "fill_value", "codecs", "attributes", "dimension_names", "storage_transformers")
)  # fmt: skip
_FORMS: dict[str, Any] = {
    "chunk_grid": {"name": ("regular",), "configuration": {"chunk_shape": list}},
    "chunk_key_encoding": {"name": ("default",), "configuration": {"separator": ("/",)}},
}
_SETTINGS: dict[str, Any] = {
    "bytes": {"endian": ("little",)},
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
        "index_location": ("end",),
    },
}
"""Configurations of codecs, see `_has_form`; those of others are empty."""


def gate_findings(name: str, metadata: object) -> Iterator[Finding]:
    """Yield what is not allowed in the ``zarr.json`` of an array or group, or the root's copy."""
    where = f"{name}/zarr.json"
    kinds = {"array": NAMES, "group": GROUPS}
    if not isinstance(metadata, Mapping) or name not in kinds.get(
        str(metadata.get("node_type")), ()
    ):
        yield Finding(
            where, "", "is no array or group of a store", "those that docs/formats.md has"
        )
        return
    found = metadata.get("zarr_format")
    if type(found) is not int or found != 3:
        yield Finding(where, "", f"zarr_format is {found!r}", "3")
    attributes = metadata.get("attributes", {})
    if not isinstance(attributes, Mapping):
        yield Finding(where, "", f"attributes is {attributes!r}", "a JSON object")
    if metadata["node_type"] == "group":
        # zarr-python would take arrays from here that nobody has looked at.
        nested = metadata.get("consolidated_metadata")
        if nested is not None and not (
            isinstance(nested, Mapping) and nested.get("metadata") == {}
        ):
            yield Finding(where, "", "has consolidated metadata of its own", "the root's alone")
        return
    transformers = metadata.get("storage_transformers")
    if transformers not in (None, []):
        yield Finding(where, "", f"storage_transformers is {transformers!r}", "none")
    data_type = metadata.get("data_type")
    if data_type not in DATA_TYPES:
        yield Finding(where, "", f"data_type is {data_type!r}", f"one of {', '.join(DATA_TYPES)}")
    axes = metadata.get("dimension_names") or []
    if not isinstance(axes, list) or not all(isinstance(axis, str) for axis in axes):
        yield Finding(where, "", f"dimension_names is {axes!r}", "a name for each dimension")
    for codec in _codecs(metadata.get("codecs")):
        used = codec.get("name")
        if used not in CODECS:
            yield Finding(where, "", f"has the codec {used!r}", f"some of {', '.join(CODECS)}")


def form_findings(name: str, metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield what the ``zarr.json`` of an array says otherwise than Zarr writes it."""
    if metadata.get("node_type") != "array":
        return
    where = f"{name}/zarr.json"
    for key in metadata.keys() - _KEYS:
        yield Finding(where, "", f"has {key!r}", f"none but {', '.join(sorted(_KEYS))}")
    for key, form in _FORMS.items():
        if not _has_form(metadata.get(key), form):
            yield Finding(where, "", f"{key} is {metadata.get(key)!r}", _in_words(form))
    for codec in _codecs(metadata.get("codecs")):
        name, settings = str(codec.get("name")), codec.get("configuration", {})
        wanted = _SETTINGS.get(name, {})
        if not (_has_form(settings, wanted) or (name == "bytes" and settings == {})):
            what = f"the codec {name} has the configuration {settings!r}"
            yield Finding(where, "", what, _in_words(wanted))


def _has_form(value: Any, form: Any) -> bool:
    """Whether a value of JSON has a form: a type, one of several values, or an object of forms."""
    if isinstance(form, dict):
        whole = isinstance(value, dict) and value.keys() == form.keys()
        return whole and all(_has_form(value[key], form[key]) for key in form)
    if isinstance(form, type):
        return type(value) is form
    return any(type(value) is type(one) and value == one for one in form)


def _in_words(form: Any) -> str:
    if isinstance(form, dict):
        return f"{{{', '.join(f'{key}: {_in_words(one)}' for key, one in form.items())}}}"
    if isinstance(form, range):
        return f"{form[0]} to {form[-1]}"
    return form.__name__ if isinstance(form, type) else " or ".join(map(repr, form))


def _codecs(codecs: Any) -> Iterator[Mapping[str, Any]]:
    """Yield codecs and those within them; an empty one where there is none."""
    for codec in codecs if isinstance(codecs, list) else [None]:
        known = codec if isinstance(codec, Mapping) else {}
        yield known
        if known.get("name") == "sharding_indexed":
            inner = known.get("configuration")
            for key in ("codecs", "index_codecs"):
                yield from _codecs(inner.get(key) if isinstance(inner, Mapping) else None)

"""What the metadata of a store may name: lists of arrays, data types and codecs that are allowed.

zarr-python looks codecs and data types up by the names that it finds, among them
some that unpickle, and takes arrays of format 2 from consolidated metadata. A
stranger's store is held against these lists before zarr-python sees any of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from slatprep.store.contract import Finding
from slatprep.store.layout import FILE, LAYOUTS

GROUPS = ("asset", "voxel", "grid", FILE)

COORDINATES = (
    "asset/property",
    "voxel/axis",
    "voxel/property",
    "grid/property",
    *(f"grid/{axis}" for axis in "xyz"),
)

NAMES = frozenset((*LAYOUTS, *COORDINATES))
"""Every array that a store may have."""

DATA_TYPES = ("bool", "uint8", "int64", "float32", "float64", "string")

CODECS = ("bytes", "vlen-utf8", "blosc", "zstd", "crc32c", "sharding_indexed")
"""What a store is packed with; none of these can run code."""


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
        if codec not in CODECS:
            yield Finding(where, "", f"has the codec {codec!r}", f"some of {', '.join(CODECS)}")


def _codecs(codecs: Any) -> Iterator[object]:
    """Yield the names of codecs and of those within them; None where there is no name."""
    for codec in codecs if isinstance(codecs, list) else [None]:
        known = codec if isinstance(codec, Mapping) else {}
        yield known.get("name")
        if known.get("name") == "sharding_indexed":
            inner = known.get("configuration")
            for key in ("codecs", "index_codecs"):
                yield from _codecs(inner.get(key) if isinstance(inner, Mapping) else None)

"""What a store's metadata must say, so that whoever reads it can rely on it.

A store may come from a stranger. These checks cost no read beyond the root's
``zarr.json`` and bound what any later read can claim.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from slatprep.errors import StoreError
from slatprep.parameters import MAX_GRID_SHARD, MAX_VOXEL_CHUNK, MAX_VOXEL_SHARD
from slatprep.records import MAX_CHANNELS, MAX_PROPERTIES, RESOLUTION, Place
from slatprep.storage.documents import read_document
from slatprep.store.layout import ASSET_CHUNK, FILE, FIXED_SIZES, LAYOUTS, ArrayLayout

MAX_METADATA_BYTES = 16 * 2**20
"""No zarr.json is larger: all metadata of a store take about 50 kB."""

MAX_VOXELS = RESOLUTION**3
"""Rows of one asset: each coordinate occurs once."""

MAX_ASSETS, MAX_FILES = 2**24, 2**20

DEFINING = ("asset/id", "voxel/coords", "voxel/feats", "voxel/properties")
"""Arrays whose shapes say how many assets, voxels, channels and properties there are."""

MIN_ASSET_BYTES = 256
"""No asset takes less of a store's files: its record alone, packed, has more. By this the number
of assets that a store claims is held against the bytes of its files."""

_MAX_CHUNK_ROWS = {"asset": ASSET_CHUNK, "voxel": MAX_VOXEL_CHUNK, "grid": 16, FILE: MAX_FILES}
_MAX_SHARD_ROWS = {**_MAX_CHUNK_ROWS, "voxel": MAX_VOXEL_SHARD, "grid": MAX_GRID_SHARD}
_ZARR_NAMES = {"str": "string"}


@dataclass(frozen=True, order=True)
class Finding:
    """One thing that is wrong.

    Attributes
    ----------
    file : str
        File below the store, or a file of the records or sources.
    asset : str
        Asset concerned; empty where it is the store as a whole.
    what : str
        What is wrong, with the value at fault.
    expected : str
        What should be there.
    """

    file: str
    asset: str
    what: str
    expected: str

    def __str__(self) -> str:
        of = f" (asset {self.asset})" if self.asset else ""
        return f"{self.file}{of}: {self.what}; expected {self.expected}"


def read_metadata(path: Place) -> dict[str, Any]:
    """Read a ``zarr.json``; StoreError if it is missing, or no JSON object within bounds."""
    try:
        return read_document(path, MAX_METADATA_BYTES)
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: cannot be read as metadata ({error})") from None


def array_findings(name: str, metadata: object, sizes: Mapping[str, int]) -> Iterator[Finding]:
    """Yield what is wrong with the ``zarr.json`` of an array of the contract, by its name.

    `sizes` are what `dimension_sizes` gave. Of other arrays nothing is asked.
    """
    layout = LAYOUTS.get(name)
    if layout is None:
        return
    yield from size_findings(name, metadata, sizes)
    if isinstance(metadata, dict):
        empty = layout.fill_value
        wanted = {
            "data_type": _ZARR_NAMES.get(layout.dtype, layout.dtype),
            "dimension_names": list(layout.dimensions),
            "zarr_format": 3,
            "fill_value": empty if empty == empty else "NaN",  # which differs from itself
        }
        yield from _differences(f"{name}/zarr.json", metadata, wanted)


def size_findings(name: str, metadata: object, sizes: Mapping[str, int]) -> Iterator[Finding]:
    """Yield what is wrong with the sizes that the metadata of one array claim.

    Parameters are those of `array_findings`. An array without findings may be
    read: no more memory is set aside than its files account for.
    """
    layout = LAYOUTS.get(name)
    if layout is None:
        return
    where = f"{name}/zarr.json"
    if not isinstance(metadata, dict) or metadata.get("node_type") != "array":
        yield Finding(where, "", "describes no array", "the metadata of an array")
        return
    shape = tuple(sizes[dimension] for dimension in layout.dimensions)
    yield from _differences(where, metadata, {"shape": list(shape)})
    yield from _chunk_findings(where, layout, metadata, shape)


def dimension_sizes(metadata: Mapping[str, Any]) -> dict[str, int]:
    """Return the size of every dimension from the arrays that define it, else StoreError."""
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


def _differences(
    where: str, metadata: Mapping[str, Any], wanted: Mapping[str, object]
) -> Iterator[Finding]:
    for key, expected in wanted.items():
        if metadata.get(key) != expected:
            yield Finding(where, "", f"{key} is {metadata.get(key)!r}", repr(expected))


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
        whole = isinstance(sizes, list) and all(type(n) is int for n in sizes)
        rows = list(shape[1:])
        fits = (
            whole
            and len(sizes) == len(shape)
            and all(n <= m for n, m in zip(sizes[1:], rows, strict=True))
        )
        if not fits or min(sizes) < 1 or sizes[0] > limit:
            expected = f"1 to {limit} rows of at most {rows}"
            yield Finding(where, "", f"{kind} shape is {sizes!r}", expected)

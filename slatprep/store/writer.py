"""Write the store: one task a shard, each shard by exactly one task.

Two writers of one shard lose data, because a shard is rewritten as a whole.
So `shards` cuts the store into tasks that share none, which
`slatprep.pipeline.pack` runs; small arrays are written by the parent.
"""

from __future__ import annotations

import warnings
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from slatprep.parameters import StoreParameters
from slatprep.records import PIXIEVERSE, Contents, Normalization, Place
from slatprep.store.attributes import root_attributes
from slatprep.store.contract import read_metadata
from slatprep.store.coordinates import write_coordinates
from slatprep.store.digests import write_digests
from slatprep.store.layout import (
    ASSET_CHUNK,
    FIXED_SIZES,
    MERGED,
    RECORD_ARRAY,
    RECORDS,
    RECORDS_IN_CHUNK,
    RECORDS_IN_SHARD,
    ArrayLayout,
    arrays_with,
    overlaps,
    row_ranges,
    rows_per_shard,
)
from slatprep.store.runs import Piece, Runs

GROUPS = ("voxel", "grid", "record")
"""What is cut into shards: arrays below ``voxel`` and ``grid``, and the records."""


@dataclass(frozen=True)
class Shard:
    """One shard of every array of a group: a single task's work.

    Attributes
    ----------
    group : str
        One of `GROUPS`.
    start, stop : int
        First row and end in the store.
    first : int
        Index of the first asset that has rows in it.
    rows : sequence
        Where the arrays of the assets lie that have rows in it, in a form that the writer knows.
    offsets : sequence of int
        ``voxel`` alone: first row of each of them in the store, and the last
        one's end.
    pieces : sequence of Piece
        Its rows, and which of them an older store has in whole chunks.
    """

    group: str
    start: int
    stop: int
    first: int
    rows: Sequence[Any]
    offsets: Sequence[int]
    pieces: Sequence[Piece]


def create_store(
    path: Path,
    n_assets: int,
    n_voxels: int,
    parameters: StoreParameters,
    contents: Contents = PIXIEVERSE,
    merged: bool = False,
) -> None:
    """Create a store at a new path with every array in place, empty.

    It has `n_assets` rows, `n_voxels` voxels, and the arrays of `merged` labels if there are any;
    `contents` says how many properties and channels there are.
    """
    import zarr

    root = zarr.create_group(path, zarr_format=3)
    sizes = {
        "asset": n_assets,
        "asset_edge": n_assets + 1,
        "voxel": n_voxels,
        "property": len(contents.properties),
        "latent": contents.latents.channels,
        **FIXED_SIZES,
    }
    chunk_and_shard = {
        "asset": (ASSET_CHUNK, None),
        "voxel": (parameters.voxel_chunk, rows_per_shard(parameters, n_voxels)),
        "grid": (1, parameters.grid_assets_per_shard),
        RECORD_ARRAY: (RECORDS_IN_CHUNK, RECORDS_IN_SHARD),
    }
    for layout in (*arrays_with(merged), RECORDS):
        shape = tuple(sizes[dimension] for dimension in layout.dimensions)
        group = layout.name.partition("/")[0]
        chunk, shard = chunk_and_shard.get(layout.name, chunk_and_shard[group])
        if shard is None:
            chunk = min(chunk, shape[0])
        attributes: dict[str, Any] = {"description": layout.description}
        if layout.unit:
            attributes["units"] = layout.unit
        root.create_array(
            layout.name,
            shape=shape,
            dtype=str if layout.dtype == "str" else layout.dtype,
            chunks=(chunk, *shape[1:]),
            shards=None if shard is None else (shard, *shape[1:]),
            **_codecs(layout, parameters.compression_level),
            fill_value=layout.fill_value,
            dimension_names=layout.dimensions,
            attributes=attributes,
        )


def _codecs(layout: ArrayLayout, level: int) -> dict[str, Any]:
    """Return the codecs of an array, chosen by measurement; each chunk ends with a checksum."""
    from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec

    compressors = {
        "zstd": ZstdCodec(level=level),
        "repeats": BloscCodec(typesize=1, cname="lz4hc", clevel=5, shuffle="noshuffle"),
        "columns": BloscCodec(typesize=3, cname="lz4hc", clevel=5, shuffle="shuffle"),
        "exponents": BloscCodec(typesize=4, cname="lz4hc", clevel=1, shuffle="shuffle"),
    }
    return {"compressors": (compressors[layout.packing], Crc32cCodec())}


def merges(path: Place) -> bool:
    """Whether a store that `create_store` made has arrays of merged labels."""
    return all((path / layout.name).is_dir() for layout in MERGED)


def packing_of(array: Place) -> object:
    """Return how an array is cut into chunks, and how those are packed."""
    document = read_metadata(array / "zarr.json")
    names = ("data_type", "fill_value", "codecs")
    data_type, fill_value, codecs = (document.get(name) for name in names)
    inner = codecs[0]["configuration"] if codecs else {}
    return data_type, fill_value, inner.get("chunk_shape"), inner.get("codecs")


def shard_rows(parameters: StoreParameters, n_voxels: int) -> dict[str, int]:
    """Return how many rows one shard of each group holds."""
    grids = parameters.grid_assets_per_shard
    return {
        "voxel": rows_per_shard(parameters, n_voxels),
        "grid": grids,
        "record": RECORDS_IN_SHARD,
    }


def shards(
    rows: Sequence[Any],
    offsets: Sequence[int],
    parameters: StoreParameters,
    runs: Mapping[str, Runs] = MappingProxyType({}),
    taken: Container[tuple[str, int]] = (),
) -> Iterator[Shard]:
    """Yield the shards of a store whose assets begin at rows `offsets`, but those that are taken.

    `rows` say where the arrays of each asset lie, `runs` by group which rows older stores have in
    chunks of the same bytes, and `taken` which shards, by group and number, are left out.
    """
    chunks = {"voxel": parameters.voxel_chunk, "grid": 1, "record": RECORDS_IN_CHUNK}
    for group, per_shard in shard_rows(parameters, offsets[-1]).items():
        own, total = runs.get(group, Runs()), offsets[-1] if group == "voxel" else len(rows)
        for number, (start, stop) in enumerate(row_ranges(total, per_shard)):
            if (group, number) in taken:
                continue
            pieces = tuple(own.pieces(start, stop, chunks[group]))
            first, last = start, stop
            begins: Sequence[int] = ()
            if group == "voxel":
                owners = [asset for asset, _ in overlaps(offsets, start, stop)]
                first, last = owners[0], owners[-1] + 1
                begins = tuple(offsets[first : last + 1])
            yield Shard(group, start, stop, first, rows[first:last], begins, pieces)


def finish_store(
    path: Path,
    normalization: Normalization,
    build_id: str,
    build: Mapping[str, object],
    contents: Contents = PIXIEVERSE,
    known: Mapping[str, str] = MappingProxyType({}),
    elsewhere: Mapping[str, int] = MappingProxyType({}),
) -> None:
    """Write the root's attributes and all files' digests; gather all metadata in one file.

    `build` are parameters and versions that made the content, `known` digests of files as they were
    written or have been seen to be true, `elsewhere` bytes of files that are not at `path`.
    """
    import zarr

    root = open_for_writing(path)
    ids = root["asset/id"][:]
    root.attrs.update(root_attributes(normalization, build_id, build, contents, ids))
    write_coordinates(path, [one.name for one in contents.properties])
    write_digests(path, known, elsewhere)
    with warnings.catch_warnings():
        # Zarr says that consolidated metadata are not in format 3's text yet.
        # They only save reads: a reader that ignores them finds every array.
        warnings.filterwarnings("ignore", message="Consolidated metadata", category=UserWarning)
        zarr.consolidate_metadata(str(path), zarr_format=3)


def open_for_writing(path: Path) -> Any:
    """Open a new store's root, without its consolidated metadata."""
    import zarr

    return zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)

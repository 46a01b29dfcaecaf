"""Write the store: one task a shard, each shard by exactly one task.

Two writers of one shard lose data, because a shard is rewritten as a whole.
So `shards` cuts the store into tasks that share none, which
`slatprep.pipeline.pack` runs; small arrays are written by the parent.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import Any

from slatprep.parameters import StoreParameters
from slatprep.records import PIXIEVERSE, Contents, Normalization, Place
from slatprep.store.attributes import root_attributes
from slatprep.store.coordinates import write_coordinates
from slatprep.store.digests import write_digests
from slatprep.store.layout import (
    ASSET_CHUNK,
    FIXED_SIZES,
    MERGED,
    ArrayLayout,
    arrays_with,
    overlaps,
    row_ranges,
    rows_per_shard,
)
from slatprep.store.records import create_record_array
from slatprep.store.unmoved import Piece, Unmoved


@dataclass(frozen=True)
class Shard:
    """One shard of every array of a group: a single task's work.

    Attributes
    ----------
    group : str
        ``voxel`` or ``grid``.
    rows : (int, int)
        First row and end in the store.
    first : int
        Index of the first asset that has rows in it.
    keys : sequence of str or int
        Of the assets that have rows in it: keys in the spool, or rows in the
        existing store.
    offsets : sequence of int
        ``voxel`` alone: first row of each of them in the store, and the last
        one's end.
    pieces : sequence of Piece
        Its rows, and which of them the existing store has as chunks, rows of voxels at the same
        place; empty where none may be.
    """

    group: str
    rows: tuple[int, int]
    first: int
    keys: Sequence[str | int]
    offsets: Sequence[int] = ()
    pieces: Sequence[Piece] = ()


def create_store(
    path: Path,
    n_assets: int,
    n_voxels: int,
    parameters: StoreParameters,
    contents: Contents = PIXIEVERSE,
    merged: bool = False,
) -> None:
    """Create a store with every array in place, empty.

    Parameters
    ----------
    path : Path
        The new store.
    n_assets, n_voxels : int
        A and N.
    parameters : StoreParameters
        Sizes of chunks and shards, and the compression level.
    contents : Contents
        How many properties and channels there are.
    merged : bool
        Whether labels are merged of several annotations.
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
    }
    for layout in arrays_with(merged):
        shape = tuple(sizes[dimension] for dimension in layout.dimensions)
        chunk, shard = chunk_and_shard[layout.name.partition("/")[0]]
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
    create_record_array(root, n_assets, parameters.compression_level)


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


def shards(
    keys: Sequence[str | int],
    offsets: Sequence[int],
    parameters: StoreParameters,
    same: Mapping[str, Unmoved] | None = None,
) -> Iterator[Shard]:
    """Yield every shard of a store whose assets, by key, begin at rows `offsets`.

    `same` has, by group, the rows that are the same in the existing store;
    shards that are the same as a whole are left out.
    """
    of_voxels, of_grids = (
        same[group] if same else Unmoved((), 0, 0) for group in ("voxel", "grid")
    )
    per_shard = rows_per_shard(parameters, offsets[-1])
    for start, stop in row_ranges(offsets[-1], per_shard):
        if of_voxels.holds_shard(start, start + per_shard):
            continue
        owners = [asset for asset, _ in overlaps(offsets, start, stop)]
        first, last = owners[0], owners[-1] + 1
        pieces = tuple(of_voxels.pieces(start, stop, parameters.voxel_chunk)) if same else ()
        own, at = keys[first:last], offsets[first : last + 1]
        yield Shard("voxel", (start, stop), first, own, at, pieces)
    per_shard = parameters.grid_assets_per_shard
    for start, stop in row_ranges(len(keys), per_shard):
        if not of_grids.holds_shard(start, start + per_shard):
            own = keys[start:stop]
            pieces = tuple(_grid_pieces(own, start)) if same else ()
            yield Shard("grid", (start, stop), start, own, pieces=pieces)


def _grid_pieces(keys: Sequence[str | int], start: int) -> Iterator[Piece]:
    """Yield the grids that follow one another in the existing store, which are chunks, and others.

    Of the first the rows are those of the existing store.
    """

    def place(one: tuple[int, str | int]) -> tuple[bool, int]:
        row, key = one
        return (True, key - row) if isinstance(key, int) else (False, 0)

    for (held, moved), own in groupby(enumerate(keys, start), place):
        rows = [row for row, _ in own]
        yield held, rows[0] + moved, rows[-1] + moved + 1


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

    Parameters
    ----------
    path : Path
        The store.
    normalization : Normalization
        Ranges of the properties.
    build_id : str
        Id of the build.
    build : mapping
        Parameters and versions that made the content.
    contents : Contents
        What it holds.
    known : mapping of str to str
        Digests of files, as they were written or have been seen to be true.
    elsewhere : mapping of str to int
        Bytes of files that are not at `path`; see `write_digests`.
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

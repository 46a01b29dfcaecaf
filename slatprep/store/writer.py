"""Write the store: each shard by exactly one task.

Two writers of one shard lose data, because a shard is rewritten as a whole.
So `shards` cuts the store into tasks that share no shard, and
`slatprep.pipeline.pack` runs them. The parent writes the small arrays.
"""

from __future__ import annotations

import warnings
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from slatprep.geometry.frames import voxel_centres
from slatprep.parameters import StoreParameters
from slatprep.records import PIXIEVERSE, RESOLUTION, Contents, Normalization, Place
from slatprep.store import layout
from slatprep.store.attributes import segments_of, store_attributes
from slatprep.store.contract import read_metadata
from slatprep.store.integrity import add_array, open_for_writing, write_digests
from slatprep.store.runs import Piece, Runs

GROUPS = ("voxel", "grid", "record")
"""Groups that are cut into shards: arrays below ``voxel`` and ``grid``, and the records."""


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
        For each asset with rows in the shard, where its arrays lie, in a form the writer knows.
    offsets : sequence of int
        First row of each of these assets in the store, and the end of the last one.
    pieces : sequence of Piece
        The rows of the shard, with the runs of whole chunks that older stores have.
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
    """Create a store at a new path, with all arrays, still empty.

    It has `n_assets` rows and `n_voxels` voxels; `contents` gives its properties and channels.
    `merged` adds the arrays of merged labels.
    """
    import zarr

    root = zarr.create_group(path, zarr_format=3)
    sizes = {
        "asset": n_assets,
        "asset_edge": n_assets + 1,
        "voxel": n_voxels,
        "property": len(contents.properties),
        "latent": contents.latents.channels,
        **layout.FIXED_SIZES,
    }
    cuts = cuts_of(parameters, n_voxels)
    for array in (*layout.arrays_with(merged), layout.RECORDS):
        shape = tuple(sizes[dimension] for dimension in array.dimensions)
        group = array.name.partition("/")[0]
        group = "record" if array is layout.RECORDS else group
        chunk, shard = cuts.get(group, (min(layout.ASSET_CHUNK, shape[0]), None))
        attributes: dict[str, Any] = {"description": array.description}
        if array.unit:
            attributes["units"] = array.unit
        root.create_array(
            array.name,
            shape=shape,
            dtype=str if array.dtype == "str" else array.dtype,
            chunks=(chunk, *shape[1:]),
            shards=None if shard is None else (shard, *shape[1:]),
            **_codecs(array, parameters.compression_level),
            fill_value=array.fill_value,
            dimension_names=array.dimensions,
            attributes=attributes,
        )


def _codecs(array: layout.ArrayLayout, level: int) -> dict[str, Any]:
    """Return the codecs of an array, chosen by measurement; each chunk ends with a checksum."""
    from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec

    compressors = {
        "zstd": ZstdCodec(level=level),
        "repeats": BloscCodec(typesize=1, cname="lz4hc", clevel=5, shuffle="noshuffle"),
        "columns": BloscCodec(typesize=3, cname="lz4hc", clevel=5, shuffle="shuffle"),
        "exponents": BloscCodec(typesize=4, cname="lz4hc", clevel=1, shuffle="shuffle"),
    }
    return {"compressors": (compressors[array.packing], Crc32cCodec())}


def packing_of(array: Place) -> object:
    """Return how an array's chunks are cut and packed: type, fill value, shape and codecs."""
    document = read_metadata(array / "zarr.json")
    names = ("data_type", "fill_value", "codecs")
    data_type, fill_value, codecs = (document.get(name) for name in names)
    inner = codecs[0]["configuration"] if codecs else {}
    return data_type, fill_value, inner.get("chunk_shape"), inner.get("codecs")


def cuts_of(parameters: StoreParameters, n_voxels: int) -> dict[str, tuple[int, int]]:
    """Return the number of rows of a chunk and of a shard, by group."""
    return {
        "voxel": (parameters.voxel_chunk, layout.rows_per_shard(parameters, n_voxels)),
        "grid": (1, parameters.grid_assets_per_shard),
        "record": (layout.RECORDS_IN_CHUNK, layout.RECORDS_IN_SHARD),
    }


def shards(
    rows: Sequence[Any],
    offsets: Sequence[int],
    parameters: StoreParameters,
    runs: Mapping[str, Runs] = MappingProxyType({}),
    taken: Container[tuple[str, int]] = (),
) -> Iterator[Shard]:
    """Yield the shards of a store whose assets begin at rows `offsets`.

    `rows` say where the arrays of each asset lie. `runs` are, by group, the rows that older stores
    have in chunks of the same bytes. `taken` has the group and number of each shard to leave out.
    """
    for group, (chunk, per_shard) in cuts_of(parameters, offsets[-1]).items():
        own, edges = runs.get(group, Runs()), layout.edges_of(group, offsets)
        for number, (start, stop) in enumerate(layout.row_ranges(edges[-1], per_shard)):
            if (group, number) in taken:
                continue
            pieces = tuple(own.pieces(start, stop, chunk))
            owners = [asset for asset, _ in layout.overlaps(edges, start, stop)]
            first, last = owners[0], owners[-1] + 1
            begins = tuple(edges[first : last + 1])
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
    """Write the root's attributes and all files' digests, then consolidate the metadata.

    `build` has the parameters and versions that made the content. `known` has digests of files
    that were computed on writing or verified, `elsewhere` sizes [byte] of files not at `path`.
    """
    import zarr

    root = open_for_writing(path)
    rows = {"manifest": build_id, "segments": segments_of(root["asset/id"][:])}
    root.attrs.update(store_attributes(normalization, build, contents) | rows)
    _write_coordinates(root, [one.name for one in contents.properties])
    write_digests(path, known, elsewhere)
    with warnings.catch_warnings():
        # Zarr warns that the specification of format 3 has no consolidated metadata yet.
        # They only save reads: a reader that ignores them finds every array.
        warnings.filterwarnings("ignore", message="Consolidated metadata", category=UserWarning)
        zarr.consolidate_metadata(str(path), zarr_format=3)


def _write_coordinates(root: Any, properties: Sequence[str]) -> None:
    """Write coordinates of dimensions, so that xarray can name rows, columns and places.

    In xarray an array with the name of its dimension becomes an index:
    ``xarray.open_zarr(store, group="voxel").sel(property="density")`` works. For Zarr itself the
    array has no meaning.
    """
    centres = voxel_centres(np.repeat(np.arange(RESOLUTION)[:, None], 3, axis=1))[:, 0]
    texts = {"property": properties, "axis": list("xyz")}
    for group, dimensions in layout.COORDINATES.items():
        for dimension in dimensions:
            values = np.array(texts[dimension], object) if dimension in texts else centres
            description = f"coordinate of the dimension {dimension}"
            add_array(root[group], dimension, values, dimension, description)
    # This CF attribute names the arrays that label the rows of ``asset``.
    root["asset"].attrs["coordinates"] = "id object_id view category"

"""Write the store: one task a shard, each shard by exactly one task.

Two writers of one shard lose data, because a shard is rewritten as a whole.
So `shards` cuts the store into tasks that share none, and `write_shard` does
one; what is small the parent writes itself.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry import flat_index
from slatprep.normalize import normalize, normalize_change
from slatprep.parameters import StoreParameters
from slatprep.records import Normalization
from slatprep.store.asset_records import create_record_array
from slatprep.store.coordinates import write_coordinates
from slatprep.store.digests import write_digests
from slatprep.store.layout import (
    ARRAYS,
    create_arrays,
    overlaps,
    root_attributes,
    row_ranges,
    rows_per_shard,
)
from slatprep.store.shard_writer import ShardWriter
from slatprep.store.spool import Spool, SpooledAsset

Rows = tuple[int, dict[str, NDArray[Any]], NDArray[np.int64]]
"""An asset by its place in the shard, its rows of the group's arrays, and the values clipped."""


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
    keys : sequence of str
        Keys, in the spool, of the assets that have rows in it.
    offsets : sequence of int
        ``voxel`` alone: first row of each of them in the store, and the last
        one's end.
    """

    group: str
    rows: tuple[int, int]
    first: int
    keys: Sequence[str]
    offsets: Sequence[int] = ()


def create_store(path: Path, n_assets: int, n_voxels: int, parameters: StoreParameters) -> None:
    """Create an empty store with every array in place."""
    import zarr

    root = zarr.create_group(path, zarr_format=3)
    create_arrays(root, n_assets, n_voxels, parameters)
    create_record_array(root, n_assets, parameters.compression_level)


def shards(
    keys: Sequence[str], offsets: Sequence[int], parameters: StoreParameters
) -> Iterator[Shard]:
    """Yield every shard of a store whose assets, by key, begin at rows `offsets`."""
    for start, stop in row_ranges(offsets[-1], rows_per_shard(parameters)):
        owners = [asset for asset, _ in overlaps(offsets, start, stop)]
        first, last = owners[0], owners[-1] + 1
        yield Shard("voxel", (start, stop), first, keys[first:last], offsets[first : last + 1])
    for start, stop in row_ranges(len(keys), parameters.grid_assets_per_shard):
        yield Shard("grid", (start, stop), start, keys[start:stop])


def write_shard(
    path: Path, spool: Spool, shard: Shard, normalization: Normalization
) -> tuple[Shard, NDArray[np.int64]]:
    """Normalise and write one shard of every array of its group.

    Parameters
    ----------
    path : Path
        The store, made by `create_store`.
    spool : Spool
        Where the assets lie.
    shard : Shard
        What to write; no other task may have it.
    normalization : Normalization
        Ranges of the properties.

    Returns
    -------
    shard : Shard
        The same.
    clipped : ndarray of int64, shape (len(shard.keys), 3)
        How many of the values written lay outside the range, by property.
    """
    clipped = np.zeros((len(shard.keys), 3), dtype=np.int64)
    with ExitStack() as stack:
        writers = {
            layout.name.partition("/")[2]: stack.enter_context(
                ShardWriter(path, layout.name, shard.rows[0])
            )
            for layout in ARRAYS
            if layout.name.startswith(f"{shard.group}/")
        }
        read = _grid_rows if shard.group == "grid" else _voxel_rows
        for asset, arrays, counts in read(spool, shard, normalization):
            clipped[asset] = counts
            for name, rows in arrays.items():
                writers[name].append(rows)
    return shard, clipped


def _voxel_rows(spool: Spool, shard: Shard, normalization: Normalization) -> Iterator[Rows]:
    for asset, own in overlaps(shard.offsets, *shard.rows):
        arrays = {name: array[own] for name, array in spool.voxels(shard.keys[asset]).items()}
        arrays["properties"], clipped = normalize(arrays["properties"], normalization)
        yield asset, arrays, clipped


def _grid_rows(spool: Spool, shard: Shard, normalization: Normalization) -> Iterator[Rows]:
    for asset, key in enumerate(shard.keys):
        material, voxels, values = spool.grid(key)
        properties = np.full((3, material.size), np.nan, dtype=np.float32)
        normalized, clipped = normalize(values, normalization)
        cells = flat_index(voxels)
        for plane, column in zip(properties, normalized.T, strict=True):
            plane[cells] = column
        properties = properties.reshape(1, 3, *material.shape)
        yield asset, {"material": material[None], "properties": properties}, clipped


def write_assets(
    path: Path, assets: Sequence[SpooledAsset], offsets: Sequence[int], normalization: Normalization
) -> None:
    """Write every ``asset/*`` array."""
    rows = [asset.columns or {} for asset in assets]
    columns: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]}
    columns["id"] = [asset.asset_id for asset in assets]
    columns["offset"] = offsets
    columns["property_ambiguity"] = normalize_change(columns["property_ambiguity"], normalization)
    group = _open(path)["asset"]
    for layout in ARRAYS:
        where, _, name = layout.name.partition("/")
        if where == "asset":
            dtype = object if layout.dtype == "str" else layout.dtype
            group[name][:] = np.array(columns[name], dtype=dtype)


def finish_store(
    path: Path, normalization: Normalization, manifest: str, build: Mapping[str, object]
) -> None:
    """Write the root's attributes and all files' digests; gather all metadata in one file.

    Parameters
    ----------
    path : Path
        The store.
    normalization : Normalization
        Ranges of the properties.
    manifest : str
        Id of the build.
    build : mapping
        Parameters and versions that made the content.
    """
    import zarr

    _open(path).attrs.update(root_attributes(normalization, manifest, build))
    write_coordinates(path)
    write_digests(path)
    with warnings.catch_warnings():
        # Zarr says that consolidated metadata are not in format 3's text yet.
        # They only save reads: a reader that ignores them finds every array.
        warnings.filterwarnings("ignore", message="Consolidated metadata", category=UserWarning)
        zarr.consolidate_metadata(str(path), zarr_format=3)


def _open(path: Path) -> Any:
    import zarr

    return zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)

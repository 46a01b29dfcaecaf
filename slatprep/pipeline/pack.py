"""Pack finished assets into the arrays of a store, a shard a task."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.voxels import flat_index
from slatprep.normalize import normalize_and_count, normalize_change
from slatprep.parameters import StoreParameters
from slatprep.pipeline.spool import Spool, SpooledAsset
from slatprep.provenance.record import Clipped, property_counts
from slatprep.records import BACKGROUND, UNANNOTATED, Normalization
from slatprep.storage.faults import reached
from slatprep.store.layout import (
    ARRAYS,
    overlaps,
)
from slatprep.store.shard_writer import ShardWriter
from slatprep.store.writer import Shard, create_store, open_for_writing, shards
from slatprep.workers.local import Jobs, run_unordered

Rows = tuple[int, dict[str, NDArray[Any]], NDArray[np.int64]]
"""An asset by its place in the shard, its rows of the group's arrays, and the values clipped."""


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
    name = f"{shard.group} {shard.rows[0]}"
    reached("shard begun", name)
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
            for array, rows in arrays.items():
                writers[array].append(rows)
        reached("shard filled", name)
    reached("shard written", name)
    return shard, clipped


def _voxel_rows(spool: Spool, shard: Shard, normalization: Normalization) -> Iterator[Rows]:
    for asset, own in overlaps(shard.offsets, *shard.rows):
        arrays = {name: array[own] for name, array in spool.voxels(shard.keys[asset]).items()}
        arrays["properties"], clipped = normalize_and_count(arrays["properties"], normalization)
        yield asset, arrays, clipped


def _grid_rows(spool: Spool, shard: Shard, normalization: Normalization) -> Iterator[Rows]:
    for asset, key in enumerate(shard.keys):
        field = spool.field(key)
        cells = flat_index(field.voxels)
        material = np.where(field.occupancy, np.uint8(UNANNOTATED), np.uint8(BACKGROUND))
        material.reshape(-1)[cells] = field.material
        properties = np.full((3, material.size), np.nan, dtype=np.float32)
        normalized, clipped = normalize_and_count(field.properties, normalization)
        for plane, column in zip(properties, normalized.T, strict=True):
            plane[cells] = column
        properties = properties.reshape(1, 3, *material.shape)
        yield asset, {"material": material[None], "properties": properties}, clipped


def write_assets(
    path: Path, assets: Sequence[SpooledAsset], offsets: Sequence[int], normalization: Normalization
) -> None:
    """Write every ``asset/*`` array."""
    columns: dict[str, Any] = {
        name: [asset.columns[name] for asset in assets] for name in assets[0].columns
    }
    columns["id"] = [asset.asset_id for asset in assets]
    columns["offset"] = offsets
    columns["property_ambiguity"] = normalize_change(columns["property_ambiguity"], normalization)
    group = open_for_writing(path)["asset"]
    for layout in ARRAYS:
        where, _, name = layout.name.partition("/")
        if where == "asset":
            dtype = object if layout.dtype == "str" else layout.dtype
            group[name][:] = np.array(columns[name], dtype=dtype)


def pack_store(
    path: Path,
    spool: Spool,
    assets: Sequence[SpooledAsset],
    normalization: Normalization,
    parameters: StoreParameters,
    jobs: Jobs,
) -> list[Clipped]:
    """Write the store's arrays, a task a shard; return the values clipped, by asset."""
    keys = [asset.key for asset in assets]
    offsets = [0, *accumulate(asset.n_voxels for asset in assets)]
    create_store(path, len(keys), offsets[-1], parameters)
    reached("store created", path.name)
    write_assets(path, assets, offsets, normalization)
    clipped = {group: np.zeros((len(keys), 3), dtype=np.int64) for group in ("voxel", "grid")}
    tasks = ((path, spool, shard, normalization) for shard in shards(keys, offsets, parameters))
    for shard, counts in run_unordered(write_shard, tasks, jobs):
        clipped[shard.group][shard.first : shard.first + len(shard.keys)] += counts
    both = zip(clipped["voxel"], clipped["grid"], strict=True)
    return [Clipped(property_counts(voxel), property_counts(grid)) for voxel, grid in both]

"""Pack finished assets into the arrays of a store, a shard a task."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
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
from slatprep.readers.encoders import ENOUGH, in_words, look_standardised, settle_latents
from slatprep.records import BACKGROUND, UNANNOTATED, Contents, LatentSpace, Normalization
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
    clipped : ndarray of int64, shape (len(shard.keys), P)
        How many of the values written lay outside the range, by property.
    """
    name = f"{shard.group} {shard.rows[0]}"
    reached("shard begun", name)
    clipped = np.zeros((len(shard.keys), len(normalization.ranges)), dtype=np.int64)
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
        normalized, clipped = normalize_and_count(field.properties, normalization)
        properties = np.full((len(clipped), material.size), np.nan, dtype=np.float32)
        for plane, column in zip(properties, normalized.T, strict=True):
            plane[cells] = column
        properties = properties.reshape(1, len(clipped), *material.shape)
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


def settled_contents(
    assets: Iterable[SpooledAsset], declared: Contents, standardised: str
) -> Contents:
    """Return what a store holds, its latents as `settle_latents` finds them to be."""
    moments = [(asset.n_voxels, asset.latents) for asset in assets]
    return replace(declared, latents=settle_latents(declared.latents, standardised, moments))


def latent_warnings(
    assets: Sequence[SpooledAsset], latents: LatentSpace, standardised: str
) -> Iterator[str]:
    """Yield what a person should know about whether the latents of a store are standardised."""
    known = [(a.asset_id, a.latents) for a in assets if a.latents and a.n_voxels >= ENOUGH]
    looks = {name: look_standardised(moments, latents) for name, moments in known}
    if latents.standardised and standardised == "auto":
        yield (
            f"the latents look standardised already ({in_words(known[0][1])} in {known[0][0]}) and "
            'are marked so; say slat.standardised = "yes" if they are, "no" if they are not'
        )
    others = [name for name, look in looks.items() if look != latents.standardised]
    if others and standardised != "no":
        how = "as the encoder gives them" if latents.standardised else "standardised already"
        yield (
            f"the latents of {len(others)} of {len(looks)} assets look {how}, unlike the others "
            f"({', '.join(others[:3])}): look where they come from"
        )


def pack_store(
    path: Path,
    spool: Spool,
    assets: Sequence[SpooledAsset],
    normalization: Normalization,
    parameters: StoreParameters,
    jobs: Jobs,
    contents: Contents,
) -> list[Clipped]:
    """Write the store's arrays, a task a shard; return the values clipped, by asset."""
    keys = [asset.key for asset in assets]
    offsets = [0, *accumulate(asset.n_voxels for asset in assets)]
    create_store(path, len(keys), offsets[-1], parameters, contents)
    reached("store created", path.name)
    write_assets(path, assets, offsets, normalization)
    shape = len(keys), len(contents.properties)
    clipped = {group: np.zeros(shape, dtype=np.int64) for group in ("voxel", "grid")}
    tasks = ((path, spool, shard, normalization) for shard in shards(keys, offsets, parameters))
    for shard, counts in run_unordered(write_shard, tasks, jobs):
        clipped[shard.group][shard.first : shard.first + len(shard.keys)] += counts
    both = zip(clipped["voxel"], clipped["grid"], strict=True)
    return [Clipped(*(property_counts(one, normalization) for one in pair)) for pair in both]

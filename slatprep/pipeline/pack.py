"""Pack finished assets into the arrays of a store, a shard a task."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate, groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.voxels import flat_index
from slatprep.normalize import normalize_and_count, normalize_change
from slatprep.parameters import StoreParameters
from slatprep.pipeline.carry import Carried, KeptAsset, Row
from slatprep.pipeline.previous import PreviousBuild
from slatprep.pipeline.spool import Spool, SpooledAsset
from slatprep.readers.encoders import ENOUGH, in_words, look_standardised, resolve_latents
from slatprep.records import (
    BACKGROUND,
    UNANNOTATED,
    Contents,
    LatentSpace,
    Normalization,
    Place,
)
from slatprep.storage.faults import reached
from slatprep.storage.place import storage_of
from slatprep.storage.remote import put_objects
from slatprep.store import Store
from slatprep.store.layout import ARRAYS, ArrayLayout, arrays_with, overlaps
from slatprep.store.shard_writer import ShardWriter, Written
from slatprep.store.writer import Shard, create_store, merges, open_for_writing, shards
from slatprep.workers.local import Jobs, run_unordered

Arrays = dict[str, NDArray[Any]]
"""Rows of arrays, by their full names."""

_ROWS_MOVED = 65_536
"""Rows of the existing store that are unpacked at a time, 4 MB in all arrays."""


def write_shard(
    path: Place,
    spool: Spool,
    shard: Shard,
    normalization: Normalization,
    previous: PreviousBuild | None = None,
    background: int = BACKGROUND,
) -> tuple[Shard, NDArray[np.int64], dict[str, Written]]:
    """Normalise and write one shard of every array of its group.

    Parameters
    ----------
    path : Place
        Where the store is made; `create_store` wrote the metadata of its arrays.
    spool : Spool
        Where the assets lie.
    shard : Shard
        What to write; no other task may have it.
    normalization : Normalization
        Ranges of the properties.
    previous : PreviousBuild, optional
        Where assets lie that are not in the spool.
    background : int
        Material id of an empty cell.

    Returns
    -------
    shard : Shard
        The same.
    clipped : ndarray of int64, shape (len(shard.keys), P)
        How many of the values of the spool's assets lay outside the range, by property.
    files : dict of str to Written
        What was written, by name.
    """
    name = f"{shard.group} {shard.rows[0]}"
    reached("shard begun", name)
    clipped = np.zeros((len(shard.keys), len(normalization.ranges)), dtype=np.int64)
    held = None if previous is None else previous.store
    arrays_of = _grid_rows if shard.group == "grid" else _voxel_rows
    with ExitStack() as stack:
        writers = {
            name: stack.enter_context(ShardWriter(path, name, shard.rows[0]))
            for name in arrays_in(shard.group, merges(path))
        }
        for same, *rows in shard.pieces or ((False, *shard.rows),):
            if same and held is not None:
                for array, writer in writers.items():
                    reader = held.reader(array)
                    first, last = (-(-row // reader.chunk_rows) for row in rows)
                    for data, lengths in reader.packed(first, last):
                        writer.append_packed(data, lengths)
                continue
            for there, assets in groupby(owners(shard, *rows), partial(_row_there, shard.keys)):
                if there is not None and held is not None:
                    _move_rows(writers, held, there, list(assets))
                    continue
                for asset, own in assets:
                    key = str(shard.keys[asset])
                    arrays, counts = arrays_of(spool, key, own, normalization, background)
                    clipped[asset] += counts
                    append_rows(writers, arrays, own.stop - own.start)
        reached("shard filled", name)
    reached("shard written", name)
    return shard, clipped, {writer.file: writer.written() for writer in writers.values()}


def _row_there(keys: Sequence[str | int], one: tuple[int, slice]) -> int | None:
    """Return what assets have in common whose rows follow one another in the existing store."""
    key = keys[one[0]]
    return key - one[0] if isinstance(key, int) else None


def _move_rows(
    writers: Mapping[str, ShardWriter],
    held: Store,
    there: int,
    assets: Sequence[tuple[int, slice]],
) -> None:
    """Write rows of voxels that follow one another in a store; `there` is the row of asset 0."""
    (first, begin), (last, end) = assets[0], assets[-1]
    start = int(held.offsets[there + first]) + begin.start
    stop = int(held.offsets[there + last]) + end.stop
    for at in range(start, stop, _ROWS_MOVED):
        rows = min(_ROWS_MOVED, stop - at)
        append_rows(writers, {name: held.read_rows(name, at, at + rows) for name in writers}, rows)


def append_rows(writers: Mapping[str, ShardWriter], arrays: Arrays, rows: int) -> None:
    """Give each writer the rows of its array; fill values where there is no such array."""
    for name, writer in writers.items():
        if name in arrays:
            writer.append(arrays[name])
        else:
            writer.append_fill(rows)


def arrays_in(group: str, merged: bool) -> list[str]:
    """Return the full names of a group's arrays; those of merged labels where there are any."""
    layouts = arrays_with(merged)
    return [layout.name for layout in layouts if layout.name.startswith(f"{group}/")]


def owners(shard: Shard, start: int, stop: int) -> Iterator[tuple[int, slice]]:
    """Yield the assets that own rows of a shard, and which of their own those are."""
    if shard.group == "voxel":
        yield from overlaps(shard.offsets, start, stop)
    else:
        first = shard.rows[0]
        yield from ((asset, slice(0, 1)) for asset in range(start - first, stop - first))


def _voxel_rows(
    spool: Spool, key: str, own: slice, normalization: Normalization, background: int
) -> tuple[Arrays, NDArray[np.int64]]:
    del background  # no voxel of a SLAT is empty
    arrays = {name: array[own] for name, array in spool.voxels(key).items()}
    arrays["properties"], clipped = normalize_and_count(arrays["properties"], normalization)
    if "spread" in arrays:
        arrays["spread"] = normalize_change(arrays["spread"], normalization).astype(np.float32)
    return {f"voxel/{name}": array for name, array in arrays.items()}, clipped


def _grid_rows(
    spool: Spool, key: str, own: slice, normalization: Normalization, background: int
) -> tuple[Arrays, NDArray[np.int64]]:
    del own  # a grid is one row
    field = spool.field(key)
    cells = flat_index(field.voxels)
    material = np.where(field.occupancy, np.uint8(UNANNOTATED), np.uint8(background))
    material.reshape(-1)[cells] = field.material
    normalized, clipped = normalize_and_count(field.properties, normalization)
    properties = np.full((len(clipped), material.size), np.nan, dtype=np.float32)
    for plane, column in zip(properties, normalized.T, strict=True):
        plane[cells] = column
    properties = properties.reshape(1, len(clipped), *material.shape)
    return {"grid/material": material[None], "grid/properties": properties}, clipped


def write_assets(
    path: Path,
    assets: Sequence[Row],
    offsets: Sequence[int],
    normalization: Normalization,
    store: Store | None = None,
) -> None:
    """Write every ``asset/*`` array; `store` is the one that has the kept assets."""
    made = [(row, asset) for row, asset in enumerate(assets) if isinstance(asset, SpooledAsset)]
    kept = [(row, asset) for row, asset in enumerate(assets) if isinstance(asset, KeptAsset)]
    ids = [asset.asset_id for asset in assets]
    group = open_for_writing(path)["asset"]
    for layout in ARRAYS:
        where, _, name = layout.name.partition("/")
        if where != "asset":
            continue
        if name in ("id", "offset"):
            values: Any = ids if name == "id" else offsets
        else:
            own: Any = [asset.columns[name] for _, asset in made]
            if name == "property_ambiguity" and made:
                own = normalize_change(own, normalization)
            values = np.empty((len(assets), *group[name].shape[1:]), _dtype(layout))
            if made:
                values[[row for row, _ in made]] = own
            if kept and store is not None:
                held = store.column(name)
                values[[row for row, _ in kept]] = held[[asset.row for _, asset in kept]]
                for row, asset in kept:
                    if asset.names is not None and hasattr(asset.names, name):
                        values[row] = getattr(asset.names, name)
        group[name][:] = np.array(values, _dtype(layout))


def _dtype(layout: ArrayLayout) -> Any:
    return object if layout.dtype == "str" else layout.dtype


def resolved_contents(assets: Iterable[Row], declared: Contents, standardised: str) -> Contents:
    """Return what a store holds, its latents as `resolve_latents` finds them to be."""
    moments = [(asset.n_voxels, asset.latents) for asset in assets]
    return replace(declared, latents=resolve_latents(declared.latents, standardised, moments))


def latent_warnings(
    assets: Sequence[Row], latents: LatentSpace, standardised: str
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


@dataclass(frozen=True)
class Packed:
    """What became of packing.

    Attributes
    ----------
    clipped : dict of str to ndarray of int64, shape (A, P)
        Values outside the ranges, by group.
    digests : dict of str to str
        Of the shards, by file.
    records : frozenset of int
        Shards of records that were taken over.
    elsewhere : dict of str to int
        Bytes of the files that do not lie where the store is made, but on an object store.
    copied : frozenset of str
        Names of those that lie in the version that is there.
    """

    clipped: Mapping[str, NDArray[np.int64]]
    digests: Mapping[str, str]
    records: frozenset[int]
    elsewhere: Mapping[str, int]
    copied: frozenset[str]


def pack_store(
    path: Path,
    spool: Spool,
    assets: Sequence[Row],
    normalization: Normalization,
    parameters: StoreParameters,
    jobs: Jobs,
    contents: Contents,
    carried: Carried | None = None,
    at: Place | None = None,
) -> Packed:
    """Write the store's arrays, a task a shard; take over what `carried` has.

    Shards go to `at`, if given, a place on an object store that all workers reach.
    """
    keys = [asset.row if isinstance(asset, KeptAsset) else asset.key for asset in assets]
    offsets = [0, *accumulate(asset.n_voxels for asset in assets)]
    merged = any(asset.merged for asset in assets)
    create_store(path, len(keys), offsets[-1], parameters, contents, merged)
    reached("store created", path.name)
    previous = carried.previous if carried else None
    write_assets(path, assets, offsets, normalization, previous.store if previous else None)
    shape = len(keys), len(contents.properties)
    clipped = {group: np.zeros(shape, dtype=np.int64) for group in ("voxel", "grid")}
    same = carried.rows if carried else None
    if (remote := None if at is None else storage_of(at).remote) is not None:
        arrays = [*arrays_in("voxel", merged), *arrays_in("grid", merged)]
        put_objects(path, remote, [f"{name}/zarr.json" for name in arrays])
    # Those of grids, which take longest, first: so the last shards keep all workers at work.
    todo = sorted(shards(keys, offsets, parameters, same), key=lambda shard: shard.group != "grid")
    tasks = (
        (remote or path, spool, shard, normalization, previous, contents.background)
        for shard in todo
    )
    written: dict[str, Written] = {}
    for shard, counts, files in run_unordered(write_shard, tasks, jobs):
        clipped[shard.group][shard.first : shard.first + len(shard.keys)] += counts
        written |= files
    for row, asset in enumerate(assets):
        if isinstance(asset, KeptAsset):
            clipped["voxel"][row] = asset.clipped
    taken, records = carried.take_shards(path) if carried else ({}, frozenset())
    copied = taken if previous and storage_of(previous.path).remote else {}
    afar = copied | written if remote else copied
    elsewhere = {name: file.size for name, file in afar.items()}
    digests = {name: file.sha256 for name, file in (written | taken).items()}
    return Packed(clipped, digests, records, elsewhere, frozenset(copied))

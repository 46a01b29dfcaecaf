"""Pack rows into the arrays of a store, one shard per task."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.voxels import flat_index
from slatprep.normalize import (
    denormalize_properties,
    normalize_and_count,
    normalize_change,
    normalize_properties,
)
from slatprep.pipeline.destination import Destination
from slatprep.pipeline.rows import IN_SPOOL, NextStore, SourceStore, Where, record_text
from slatprep.pipeline.spool import Arrays, Spool
from slatprep.pipeline.work import Work
from slatprep.records import UNANNOTATED, Normalization, Place
from slatprep.storage.atomic import writing
from slatprep.storage.faults import reached
from slatprep.storage.files import take_file
from slatprep.storage.place import storage_of
from slatprep.storage.remote import RemotePlace, put_objects
from slatprep.storage.upload import Staged
from slatprep.store.integrity import open_for_writing
from slatprep.store.layout import ARRAYS, RECORD_ARRAY, arrays_with, edges_of, overlaps
from slatprep.store.runs import Run, Runs, runs_of
from slatprep.store.shard_writer import ShardWriter, Written
from slatprep.store.writer import (
    GROUPS,
    Shard,
    create_store,
    cuts_of,
    finish_store,
    packing_of,
    shards,
)
from slatprep.workers import Progress, counted
from slatprep.workers.local import Jobs, run_unordered

Files = dict[str, Written]
"""Size and SHA-256 of files by name."""

_ROWS_MOVED = 65_536
"""Number of rows of an older store that are unpacked at a time, 4 MB in all arrays."""

_CLIPPED = {"voxel": "clipped", "grid": "clipped_grid"}
"""Columns with the number of values that packing clips, by group."""


def pack_store(
    work: Work, place: Destination, new: NextStore, jobs: Jobs, progress: Progress | None = None
) -> frozenset[int]:
    """Write a store and put it in place; return the shards of records that were taken over.

    Equal bytes of an older store are taken over: whole shards as files, if the new store replaces
    it, and packed chunks.
    """
    with writing(str(place.out), storage_of(place.store).work_folder().parent):
        path = work.scratch / "store.zarr"
        staged, taken = _made(path, new, work, jobs, progress)
        place.replace(path, new.ids, staged)
    return taken


def _made(
    path: Path, new: NextStore, work: Work, jobs: Jobs, progress: Progress | None
) -> tuple[Staged, frozenset[int]]:
    """Make a store at `path`; return its files, and its shards of records that were taken over.

    Shards go to `work.shards` if that is on an object store.
    """
    create_store(path, len(new.rows), new.offsets[-1], new.parameters, new.contents, new.merged)
    reached("store created", path.name)
    version = storage_of(work.shards).remote
    if version is not None:
        names = [name for group in GROUPS for name in arrays_in(group, new.merged)]
        put_objects(path, version, [f"{name}/zarr.json" for name in names])
    runs = {group: _runs(path, group, new) for group in GROUPS}
    taken = _taken(new, runs)
    todo = list(shards([row.where for row in new.rows], new.offsets, new.parameters, runs, taken))
    # Shards of grids take longest, so they go first: the last shards keep all workers busy.
    todo.sort(key=lambda shard: shard.group != "grid")
    clipped = {name: new.column(name) for name in _CLIPPED.values()}
    written: Files = {}
    place, ranges, merged = version or path, new.normalization, new.merged
    background = new.contents.background
    tasks = ((place, work.spool, new.stores, shard, ranges, background, merged) for shard in todo)
    made = run_unordered(write_shard, tasks, jobs)
    for shard, counts, files in counted(made, len(todo), progress):
        if name := _CLIPPED.get(shard.group):
            clipped[name][shard.first : shard.first + len(shard.rows)] += counts
        written |= files
    reached("records written", path.name)
    _write_columns(path, new, clipped)
    staged = _staged(new, version, written, _take(path, new, taken))
    finish_store(path, ranges, new.build_id, new.build, new.contents, staged.digests, staged.sizes)
    return staged, frozenset(number for group, number in taken if group == "record")


def _staged(new: NextStore, version: RemotePlace | None, written: Files, taken: Files) -> Staged:
    """Return the digests of all shards, and which are on an object store but not at `path`.

    Those are the shards `written` by workers into a `version` there, and the shards `taken` over
    from an older version, which the server copies. All others lie at `path` already.
    """
    older = storage_of(new.stores[0].path).remote if taken else None
    copied = taken if older else {}
    away = {**copied, **written} if version else copied
    sizes = {name: file.size for name, file in away.items()}
    digests = {name: file.sha256 for name, file in (written | taken).items()}
    return Staged(sizes, digests, version, older, frozenset(copied))


def write_shard(
    path: Place,
    spool: Spool,
    stores: Sequence[SourceStore],
    shard: Shard,
    normalization: Normalization,
    background: int,
    merged: bool,
) -> tuple[Shard, NDArray[np.int64], Files]:
    """Write one shard of every array of its group into the new store at `path`.

    `merged` says whether the store has arrays of merged labels. Return the shard, the number of
    values of spooled assets outside the range, (A, P) by asset of the shard and property, and the
    written files by name. No other task may write the shard.
    """
    name = f"{shard.group} {shard.start}"
    reached("shard begun", name)
    clipped = np.zeros((len(shard.rows), len(normalization.ranges)), dtype=np.int64)
    with ExitStack() as stack:
        writers = {
            array: stack.enter_context(ShardWriter(path, array, shard.start))
            for array in arrays_in(shard.group, merged)
        }
        for run, start, stop in shard.pieces:
            if run is not None:
                _copy_chunks(writers, stores[run.store], start + run.shift, stop + run.shift)
                continue
            assets = overlaps(shard.offsets, start, stop)
            for (store, _), own in groupby(assets, lambda one: _run_of(shard.rows[one[0]], one[0])):
                if store != IN_SPOOL:
                    _move_rows(writers, stores[store], shard, list(own), normalization)
                    continue
                for asset, rows in own:
                    arrays, counts = _spooled(
                        spool, shard.rows[asset], shard.group, rows, normalization, background
                    )
                    clipped[asset] += counts
                    _append(writers, arrays, rows.stop - rows.start)
        reached("shard filled", name)
    reached("shard written", name)
    return shard, clipped, {writer.file: writer.written() for writer in writers.values()}


def arrays_in(group: str, merged: bool) -> list[str]:
    """Return the full names of a group's arrays that are cut into shards."""
    if group == "record":
        return [RECORD_ARRAY]
    return [one.name for one in arrays_with(merged) if one.name.startswith(f"{group}/")]


def _run_of(where: Where, asset: int) -> tuple[int, int]:
    """Return the number of an asset's store, or `IN_SPOOL`, and the shift to its row there.

    Both are the same for assets that are adjacent there too.
    """
    if isinstance(where, str):
        return IN_SPOOL, 0
    store, row, _ = where
    return store, row - asset


def _spooled(
    spool: Spool, key: str, group: str, own: slice, normalization: Normalization, background: int
) -> tuple[Arrays, NDArray[np.int64] | int]:
    """Return rows of a spooled asset in a group's arrays, and numbers of clipped values (P,)."""
    if group == "record":
        return {RECORD_ARRAY: np.array([spool.record_text(key).decode()], object)}, 0
    if group == "voxel":
        arrays = {name: array[own] for name, array in spool.voxels(key).items()}
        arrays["properties"], clipped = normalize_and_count(arrays["properties"], normalization)
        if "spread" in arrays:
            arrays["spread"] = normalize_change(arrays["spread"], normalization).astype(np.float32)
        return {f"voxel/{name}": array for name, array in arrays.items()}, clipped
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


def _copy_chunks(
    writers: Mapping[str, ShardWriter], source: SourceStore, start: int, stop: int
) -> None:
    """Copy whole packed chunks, rows ``start`` to ``stop - 1`` of an older store."""
    for array, writer in writers.items():
        if not source.holds(array):
            writer.append_fill(stop - start)
            continue
        reader = source.reader(array)
        first, last = (-(-row // reader.chunk_rows) for row in (start, stop))
        for data, lengths in reader.packed(first, last):
            writer.append_packed(data, lengths)


def _move_rows(
    writers: Mapping[str, ShardWriter],
    source: SourceStore,
    shard: Shard,
    assets: Sequence[tuple[int, slice]],
    normalization: Normalization,
) -> None:
    """Write rows of assets that are adjacent in an older store, converted to the new ranges."""
    if shard.group == "record":
        for asset, _ in assets:
            _, row, names = shard.rows[asset]
            text = record_text(source, row, names).decode()
            _append(writers, {RECORD_ARRAY: np.array([text], object)}, 1)
        return
    (first, begin), (last, end) = assets[0], assets[-1]
    edges = edges_of(shard.group, source.offsets.tolist())
    (_, first_row, _), (_, last_row, _) = shard.rows[first], shard.rows[last]
    start, stop = edges[first_row] + begin.start, edges[last_row] + end.stop
    change = _renormaliser(source.normalization, normalization)
    names = [name for name in writers if source.holds(name)]
    at_a_time = _ROWS_MOVED if shard.group == "voxel" else 1
    for at in range(start, stop, at_a_time):
        end_row = min(at + at_a_time, stop)
        arrays = {name: change(source.read_rows(name, at, end_row), name) for name in names}
        _append(writers, arrays, end_row - at)


def _append(writers: Mapping[str, ShardWriter], arrays: Arrays, rows: int) -> None:
    """Give each writer the rows of its array, or fill values if there is no such array."""
    for name, writer in writers.items():
        if name in arrays:
            writer.append(arrays[name])
        else:
            writer.append_fill(rows)


def _renormaliser(
    old: Normalization, new: Normalization
) -> Callable[[NDArray[Any], str], NDArray[Any]]:
    """Return a function that converts rows of an array, by its name, to other ranges."""
    before, after = ([span.hi - span.lo for span in ranges.ranges] for ranges in (old, new))
    scale, same = np.divide(before, after), old.ranges == new.ranges

    def change(values: NDArray[Any], name: str) -> NDArray[Any]:
        if not same and name == "voxel/spread":
            return (values * scale).astype(np.float32)
        if same or not name.endswith("/properties"):
            return values
        last = np.moveaxis(values, 1, -1)  # (N, P), or of a grid (1, x, y, z, P)
        changed = normalize_properties(denormalize_properties(last, old), new)
        return np.ascontiguousarray(np.moveaxis(changed, -1, 1))

    return change


def _runs(path: Path, group: str, new: NextStore) -> Runs:
    """Return the rows of a group's arrays that older stores have in chunks of the same bytes."""
    alike = [_packs_alike(path, group, new, source) for source in new.stores]
    if not any(alike):
        return Runs()
    before = [edges_of(group, source.offsets.tolist()) for source in new.stores]
    ends = edges_of(group, new.offsets)
    spans = (
        Run(ends[k], ends[k + 1], row.store, before[row.store][row.row] - ends[k])
        for k, row in enumerate(new.rows)
        if not row.spooled and alike[row.store] and not (row.names and group == "record")
    )
    return runs_of(spans, ends[-1], tuple(rows[-1] for rows in before))


def _packs_alike(path: Path, group: str, new: NextStore, source: SourceStore) -> bool:
    """Return whether a store has a group's values like the new one, in chunks packed alike."""
    if group != "record" and source.normalization.ranges != new.normalization.ranges:
        return False
    held = (name for name in arrays_in(group, new.merged) if source.holds(name))
    return all(packing_of(path / name) == packing_of(source.path / name) for name in held)


def _taken(new: NextStore, runs: Mapping[str, Runs]) -> set[tuple[str, int]]:
    """Return the shards, by group and number, that are files of the replaced store."""
    if not (new.replaces and new.stores):
        return set()
    held, taken = new.stores[0], set()
    for group, (_, rows) in cuts_of(new.parameters, new.offsets[-1]).items():
        names = arrays_in(group, new.merged)
        if not all(held.holds(n) and held.reader(n).shard_rows == rows for n in names):
            continue
        for number in range(-(-runs[group].new // rows)):
            run = runs[group].holds(number * rows, (number + 1) * rows)
            if run is not None and run.shift == 0:
                taken.add((group, number))
    return taken


def _take(path: Path, new: NextStore, taken: Collection[tuple[str, int]]) -> Files:
    """Put the taken shards into the new store; return their files.

    On an object store they are only named; the server copies them when the others are uploaded.
    """
    files: Files = {}
    for group, number in sorted(taken):
        source = new.stores[0]
        local = storage_of(source.path).local
        for name in arrays_in(group, new.merged):
            file = source.reader(name).key(number)
            if local is not None:
                take_file(local / file, path / file)
            files[file] = source.files[file]
    return files


def _write_columns(path: Path, new: NextStore, found: Mapping[str, NDArray[np.int64]]) -> None:
    """Write every ``asset/*`` array; `found` has the columns that packing fills, by last name."""
    group = open_for_writing(path)["asset"]
    for layout in ARRAYS:
        where, _, name = layout.name.partition("/")
        if where == "asset":
            values = found[name] if name in found else new.column(name)
            group[name][:] = np.array(values, object if layout.dtype == "str" else layout.dtype)

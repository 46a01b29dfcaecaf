"""Which rows lie in which shard, and which chunks and shards of a new store are an old one's."""

from dataclasses import replace
from itertools import accumulate, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slatprep.parameters import MAX_VOXEL_SHARD, StoreParameters
from slatprep.store.layout import ARRAYS, MOST_SHARDS, overlaps, row_ranges, rows_per_shard
from slatprep.store.runs import Run, Runs, runs_of
from slatprep.store.shard_reader import OPEN_SHARDS
from slatprep.store.writer import shards


@given(sizes=st.lists(st.integers(0, 40), min_size=1, max_size=30), per_shard=st.integers(1, 50))
def test_shards_take_every_row_of_every_asset_once_and_in_place(sizes, per_shard):
    offsets = [0, *accumulate(sizes)]
    owner = np.repeat(np.arange(len(sizes)), sizes)
    within = np.concatenate([np.arange(size) for size in sizes])

    end = 0
    for start, stop in row_ranges(offsets[-1], per_shard):
        assert start == end and start % per_shard == 0
        assert 0 < stop - start <= per_shard
        end = stop
        found = [
            (asset, row)
            for asset, rows in overlaps(offsets, start, stop)
            for row in range(sizes[asset])[rows]
        ]
        assert found == [*zip(owner[start:stop], within[start:stop], strict=True)]
        # An asset without rows owns none, wherever it lies.
        owners = [asset for asset, _ in overlaps(offsets, start, stop)]
        assert owners == sorted(set(owner[start:stop].tolist()))
    assert end == offsets[-1]


@pytest.mark.parametrize(("rows", "chunk", "chunks"), [
    (0, 4096, 64),  # 262,144 rows at least
    (64 * 32 * 4096, 4096, 64),
    (64 * 32 * 4096 + 1, 4096, 128),  # 32 shards would not take the last row
    (128 * 32 * 4096, 4096, 128),
    (3000 * 32 * 4096, 4096, 4096),
    (10**12, 4096, 4096),  # 16.8 million rows at most
    (64 * 32 * 128 + 1, 128, 128),
    (10**12, 2**20, MAX_VOXEL_SHARD // 2**20),
])  # fmt: skip
def test_a_shard_holds_the_least_power_of_two_of_chunks(rows, chunk, chunks):
    parameters = StoreParameters(voxel_chunk=chunk)
    assert rows_per_shard(parameters, rows) == chunk * chunks
    assert rows_per_shard(replace(parameters, voxel_chunks_per_shard=3), rows) == 3 * chunk
    read_by_row = sum(one.name.startswith("voxel/") for one in ARRAYS)
    assert MOST_SHARDS * read_by_row <= OPEN_SHARDS


Arrays = tuple[list[np.ndarray], np.ndarray, Runs]


@st.composite
def arrays_and_runs(draw: st.DrawFn) -> Arrays:
    """Return the rows of old arrays, no row twice, of a new one, and the runs of the new one."""
    sizes = draw(st.lists(st.integers(1, 30), min_size=1, max_size=3))
    old = [np.arange(size) + 100 * (k + 1) for k, size in enumerate(sizes)]
    new, spans = np.empty(0, int), []
    for _ in range(draw(st.integers(1, 6))):
        at = len(new)
        if draw(st.booleans()):
            store = draw(st.integers(0, len(old) - 1))
            start = draw(st.sampled_from([min(at, sizes[store]), 0, draw(st.integers(0, 30))]))
            own = old[store][start : start + draw(st.integers(1, 30))]
            spans.append(Run(at, at + len(own), store, start - at))
        else:
            own = -np.arange(at, at + draw(st.integers(1, 9))) - 1
        new = np.concatenate([new, own])
    new = new if len(new) else np.array([-1])
    return old, new, runs_of(spans, len(new), tuple(sizes))


def chunk_of(rows: np.ndarray, start: int, size: int) -> list[int]:
    """Return a chunk as it is written: rows beyond the array's end are filled up."""
    chunk = np.zeros(size, dtype=int)
    own = rows[start : start + size]
    chunk[: len(own)] = own
    return chunk.tolist()


@given(drawn=arrays_and_runs(), size=st.integers(1, 9))
def test_chunks_are_held_that_have_the_same_bytes(drawn, size):
    old, new, runs = drawn
    for start in range(0, len(new), size):
        wanted = chunk_of(new, start, size)
        there = {
            (store, at)
            for store, rows in enumerate(old)
            for at in range(0, len(rows), size)
            if chunk_of(rows, at, size) == wanted
        }
        run = runs.holds(start, start + size)
        assert (run is not None) == bool(there)
        if run is not None:
            assert (run.store, start + run.shift) in there


@given(drawn=arrays_and_runs(), chunk=st.integers(1, 4), chunks=st.integers(1, 4))
def test_shards_are_pieced_together_from_what_is_the_same(drawn, chunk, chunks):
    old, new, runs = drawn
    parameters = StoreParameters(chunk, chunks, grid_assets_per_shard=1)
    cut = [
        shard
        for shard in shards(["a"], [0, len(new)], parameters, {"voxel": runs}, {("voxel", 0)})
        if shard.group == "voxel"
    ]
    assert [shard.start for shard in cut] == list(range(0, len(new), chunk * chunks))[1:]
    for shard in cut:
        assert shard.stop == min(shard.start + chunk * chunks, len(new))
        assert [shard.start, *(stop for _, _, stop in shard.pieces)] == [
            *(start for _, start, _ in shard.pieces), shard.stop
        ]  # fmt: skip
        # Pieces are as long as they can be.
        assert all(one[0] != other[0] for one, other in pairwise(shard.pieces))
        for run, start, stop in shard.pieces:
            for begin in range(start, stop, chunk):
                assert run == runs.holds(begin, begin + chunk)
                if run is not None:
                    rows = old[run.store]
                    assert chunk_of(rows, begin + run.shift, chunk) == chunk_of(new, begin, chunk)

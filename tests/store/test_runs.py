"""Which chunks and shards of older stores are those of a new one, against the bytes of all."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slatprep.parameters import StoreParameters
from slatprep.store.runs import Run, Runs, runs_of
from slatprep.store.writer import shards

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
    parameters = StoreParameters(
        voxel_chunk=chunk, voxel_chunks_per_shard=chunks, grid_assets_per_shard=1
    )
    taken = {("voxel", 0)}
    cut = [
        shard
        for shard in shards(["a"], [0, len(new)], parameters, {"voxel": runs}, taken)
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

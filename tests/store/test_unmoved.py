"""Which chunks and shards of a store are the same in the next one, against the bytes of both."""

from __future__ import annotations

from itertools import accumulate, pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slatprep.parameters import StoreParameters
from slatprep.store.unmoved import Unmoved, unmoved
from slatprep.store.writer import shards

Arrays = tuple[np.ndarray, np.ndarray, Unmoved]


@st.composite
def two_arrays(draw: st.DrawFn) -> Arrays:
    """Return the rows of two arrays, no row twice, and which of them are the same."""
    old, new = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    cuts = sorted(draw(st.sets(st.integers(0, min(old, new)), max_size=8)))
    spans = [(start, stop) for start, stop in pairwise(cuts) if draw(st.booleans())]
    before = np.arange(1, old + 1)
    after = -np.arange(1, new + 1)
    for start, stop in spans:
        after[start:stop] = before[start:stop]
    return before, after, unmoved(spans, old, new)


def chunk_of(rows: np.ndarray, start: int, size: int) -> list[int]:
    """Return a chunk as it is written: rows beyond the array's end are filled up."""
    chunk = np.zeros(size, dtype=int)
    own = rows[start : start + size]
    chunk[: len(own)] = own
    return chunk.tolist()


@given(arrays=two_arrays(), size=st.integers(1, 9))
def test_chunks_are_held_that_have_the_same_bytes(arrays: Arrays, size: int) -> None:
    before, after, same = arrays
    assert all(stop < start for (_, stop), (start, _) in pairwise(same.runs))
    for start in range(0, len(after), size):
        alike = chunk_of(before, start, size) == chunk_of(after, start, size)
        assert same.holds(start, start + size) == alike
        assert same.holds_shard(start, start + size) == alike
        other_shards = Unmoved(same.runs, same.old, same.new, shards_alike=False)
        assert not other_shards.holds_shard(start, start + size)


@given(arrays=two_arrays(), chunk=st.integers(1, 4), chunks=st.integers(1, 4), merged=st.booleans())
def test_shards_of_voxels_are_pieced_together_from_what_is_the_same(
    arrays: Arrays, chunk: int, chunks: int, merged: bool
) -> None:
    """What is left out and what is copied has the same bytes, and nothing else has."""
    before, after, same = arrays
    per_shard = chunk * chunks
    if merged:
        same = Unmoved(same.runs, same.old, same.new, shards_alike=False)
    parameters = StoreParameters(
        voxel_chunk=chunk, voxel_chunks_per_shard=chunks, grid_assets_per_shard=1
    )
    grids = Unmoved((), 0, 0)
    written = [
        shard
        for shard in shards(["a"], [0, len(after)], parameters, {"voxel": same, "grid": grids})
        if shard.group == "voxel"
    ]
    starts = [shard.rows[0] for shard in written]
    for start in range(0, len(after), per_shard):
        alike = chunk_of(before, start, per_shard) == chunk_of(after, start, per_shard)
        assert (start in starts) == (merged or not alike)
    for shard in written:
        end = shard.rows[0]
        for held, start, stop in shard.pieces:
            assert start == end < stop
            end = stop
            for begin in range(start, stop, chunk):
                alike = chunk_of(before, begin, chunk) == chunk_of(after, begin, chunk)
                assert held == alike
        assert end == shard.rows[1] == min(shard.rows[0] + per_shard, len(after))


@given(
    keys=st.lists(st.one_of(st.integers(0, 12), st.sampled_from("abc")), min_size=1, max_size=12),
    per_shard=st.integers(1, 5),
)
def test_shards_of_grids_name_the_rows_that_they_are_copied_from(
    keys: list[int | str], per_shard: int
) -> None:
    parameters = StoreParameters(
        voxel_chunk=4, voxel_chunks_per_shard=1, grid_assets_per_shard=per_shard
    )
    offsets = [0, *accumulate([1] * len(keys))]
    moved = {"voxel": Unmoved((), 0, len(keys)), "grid": Unmoved((), 0, len(keys))}
    found = [shard for shard in shards(keys, offsets, parameters, moved) if shard.group == "grid"]
    assert [shard.rows for shard in found] == [
        (start, min(start + per_shard, len(keys))) for start in range(0, len(keys), per_shard)
    ]
    for shard in found:
        assert shard.first == shard.rows[0]
        row = shard.rows[0]
        for held, start, stop in shard.pieces:
            own = keys[row : row + stop - start]
            assert own == list(range(start, stop)) if held else (start == row)
            assert all(isinstance(key, int) == held for key in own)
            row += stop - start
        assert row == shard.rows[1]
        # Pieces are as long as they can be: two of grids that follow one another would be one.
        for (held, _, stop), (next_held, start, _) in pairwise(shard.pieces):
            assert held != next_held or (held and stop != start)


def test_shards_of_grids_that_stay_where_they_are_are_left_out() -> None:
    parameters = StoreParameters(voxel_chunk=4, voxel_chunks_per_shard=1, grid_assets_per_shard=2)
    same = {"voxel": unmoved([(0, 20)], 20, 20), "grid": unmoved([(0, 3)], 5, 5)}
    left = list(shards([0, 1, 2, "new", 4], [0, 4, 8, 12, 16, 20], parameters, same))
    assert [(shard.group, shard.rows) for shard in left] == [("grid", (2, 4)), ("grid", (4, 5))]
    assert [shard.pieces for shard in left] == [((True, 2, 3), (False, 3, 4)), ((True, 4, 5),)]

from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slatprep.parameters import MAX_VOXEL_SHARD, StoreParameters
from slatprep.store.layout import MOST_SHARDS, overlaps, row_ranges, rows_per_shard
from slatprep.store.shard_reader import OPEN_SHARDS


@given(sizes=st.lists(st.integers(0, 40), min_size=1, max_size=30), per_shard=st.integers(1, 50))
def test_shards_take_every_row_of_every_asset_once_and_in_place(sizes, per_shard):
    offsets = [0, *accumulate(sizes)]
    owner = np.repeat(np.arange(len(sizes)), sizes)
    within = np.concatenate([np.arange(size) for size in sizes])

    end = 0
    for start, stop in row_ranges(offsets[-1], per_shard):
        assert start == end
        assert start % per_shard == 0
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


@pytest.mark.parametrize(
    ("rows", "chunk", "chunks"),
    [
        (0, 4096, 64),  # 262,144 rows at least
        (64 * 32 * 4096, 4096, 64),
        (64 * 32 * 4096 + 1, 4096, 128),  # 32 shards would not take the last row
        (128 * 32 * 4096, 4096, 128),
        (3000 * 32 * 4096, 4096, 4096),
        (10**12, 4096, 4096),  # 16.8 million rows at most
        (64 * 32 * 128 + 1, 128, 128),
        (10**12, 2**20, MAX_VOXEL_SHARD // 2**20),
    ],
)
def test_a_shard_holds_the_least_power_of_two_of_chunks(rows, chunk, chunks):
    parameters = StoreParameters(voxel_chunk=chunk)
    assert rows_per_shard(parameters, rows) == chunk * chunks
    assert rows_per_shard(replace(parameters, voxel_chunks_per_shard=3), rows) == 3 * chunk
    assert MOST_SHARDS <= OPEN_SHARDS

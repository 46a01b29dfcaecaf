from itertools import accumulate

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slatprep.store.layout import overlaps, row_ranges


@given(
    sizes=st.lists(st.integers(0, 40), min_size=1, max_size=30),
    per_shard=st.integers(1, 50),
)
def test_shards_take_every_row_of_every_asset_once_and_in_place(
    sizes: list[int], per_shard: int
) -> None:
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
    assert end == offsets[-1]

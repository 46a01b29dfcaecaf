"""Which assets have rows in which shard."""

from __future__ import annotations

from slatprep.parameters import StoreParameters
from slatprep.store.writer import Shard, shards


def test_a_shard_has_the_keys_of_just_those_assets_with_rows_in_it() -> None:
    parameters = StoreParameters(voxel_chunk=4, voxel_chunks_per_shard=2, grid_assets_per_shard=2)
    assert list(shards(["a", "b", "c"], [0, 5, 12, 20], parameters)) == [
        Shard("voxel", (0, 8), 0, ["a", "b"], [0, 5, 12]),
        Shard("voxel", (8, 16), 1, ["b", "c"], [5, 12, 20]),
        Shard("voxel", (16, 20), 2, ["c"], [12, 20]),
        Shard("grid", (0, 2), 0, ["a", "b"]),
        Shard("grid", (2, 3), 2, ["c"]),
    ]

"""Shards written chunk by chunk are those that zarr-python writes from all rows at once."""

from itertools import pairwise

import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.trees import tree

from slatprep.parameters import StoreParameters
from slatprep.store.layout import ARRAYS
from slatprep.store.shard_writer import ShardWriter
from slatprep.store.writer import create_store

PARAMETERS = StoreParameters(voxel_chunk=16, voxel_chunks_per_shard=4, grid_assets_per_shard=2)
NAMES = [layout.name for layout in ARRAYS if not layout.name.startswith("asset/")]


@settings(
    max_examples=30,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    name=st.sampled_from(NAMES),
    total=st.integers(1, 130),
    cuts=st.lists(st.integers(0, 130), max_size=5),
    seed=st.integers(0, 9),
)
def test_a_shard_in_parts_is_zarrs_byte_for_byte(tmp_path_factory, name, total, cuts, seed):
    if name.startswith("grid/"):
        total = total % 3 + 1
    folder = tmp_path_factory.mktemp("shards")
    for store in ("ours", "zarrs"):
        create_store(folder / store, total, total, PARAMETERS)
    array = zarr.open_group(folder / "zarrs", mode="r+")[name]
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 2, array.shape).astype(array.dtype)  # empty chunks, now and then
    values[rng.random(total) < 0.3] = array.fill_value
    with zarr.config.set({"array.write_empty_chunks": True}):
        zarr.open_group(folder / "zarrs", mode="r+")[name][:] = values
    for start in range(0, total, array.shards[0]):
        stop = min(start + array.shards[0], total)
        edges = sorted({start, stop, *(cut for cut in cuts if start < cut < stop)})
        with ShardWriter(folder / "ours", name, start) as writer:
            for first, last in pairwise(edges):
                writer.append(values[first:last])
    ours, theirs = (tree(folder / store / name / "c") for store in ("ours", "zarrs"))
    assert ours == theirs
    assert ours


def test_a_shard_is_there_whole_or_not_at_all(tmp_path):
    create_store(tmp_path / "s", 1, 40, PARAMETERS)
    place = tmp_path / "s" / "voxel" / "valid" / "c"
    with pytest.raises(RuntimeError), ShardWriter(tmp_path / "s", "voxel/valid", 0) as writer:
        writer.append(np.ones(40, bool))
        raise RuntimeError("disk full")
    assert list(place.iterdir()) == []

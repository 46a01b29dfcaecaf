"""The benchmark of reading reads the same by every way."""

from pathlib import Path

import numpy as np
import pytest
import reading as read

from slatprep.errors import StoreError
from slatprep.store import open_store


def test_every_way_reads_every_asset_alike(mixed_build, tmp_path):
    store = open_store(mixed_build.store)
    read.write_forms(store.path, tmp_path, len(store))
    (tmp_path / "store").symlink_to(store.path)
    for way in read.WAYS[:5]:
        reader = way.open(tmp_path)
        for row, asset in enumerate(store):
            arrays = reader(row)
            assert np.array_equal(arrays["coords"], asset.coords)
            assert np.array_equal(arrays["feats"], asset.feats)
            assert np.array_equal(arrays["properties"], asset.properties, equal_nan=True)


def test_a_way_that_reads_something_else_is_not_measured(mixed_build, tmp_path, monkeypatch):
    right = next(way for way in read.WAYS if way.name == "npz")

    def others(directory: Path) -> read.Reader:
        reader = right.open(directory)
        return lambda row: {**reader(row), "coords": reader(row)["coords"] + 1}

    monkeypatch.setattr(read, "WAYS", (read.Way("npz", others, "npz"),))
    with pytest.raises(StoreError, match=r"npz reads other coords of asset \d+ than slatprep does"):
        read.bench_read(mixed_build.store, tmp_path, repeats=1)

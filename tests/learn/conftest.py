"""A small store for everything that learns."""

from pathlib import Path

import pytest
from support.synthetic import Dataset

from slatprep.pipeline.dataset import build_store


@pytest.fixture(scope="session")
def learn_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a store of nine rows: eight objects, of which one has two views."""
    dataset = Dataset(tmp_path_factory.mktemp("learn")).having(*"abcdefg")
    dataset.add("h", 7, views=("front", "side"))
    out = tmp_path_factory.mktemp("learn_store") / "learn.zarr"
    build_store(dataset.parameters(), out)
    return out

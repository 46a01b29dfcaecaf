"""A small store for everything that learns."""

from pathlib import Path

import pytest
import torch
from support.synthetic import Dataset

from slatprep.learn import decoder
from slatprep.pipeline.dataset import build_store

# Nothing but time depends on the size of the decoder that is trained.
decoder.SIZES["tiny"] = decoder.DecoderSize(24, 2, 2)


@pytest.fixture(autouse=True)
def _as_it_was() -> None:
    """Compute on one thread and by any algorithm, whatever a command has set."""
    torch.use_deterministic_algorithms(False)
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def learn_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a store of nine rows: eight objects, of which one has two views."""
    dataset = Dataset(tmp_path_factory.mktemp("learn")).having(*"abcdefg")
    dataset.add("h", 7, views=("front", "side"))
    out = tmp_path_factory.mktemp("learn_store") / "learn.zarr"
    build_store(dataset.parameters(), out)
    return out

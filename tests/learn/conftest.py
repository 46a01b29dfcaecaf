"""A small store for everything that learns."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import support.tiny  # noqa: F401 -- from here on its size is known
import torch
from support.synthetic import Dataset

from slatprep.pipeline.dataset import build_store
from slatprep.store import open_store


@pytest.fixture(autouse=True)
def _as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute on one thread and by any algorithm, whatever a command has set, and on no GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    torch.use_deterministic_algorithms(False)
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def learn_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a store of eight objects, one of two views; 12 voxels of ``b`` are far from labels."""
    dataset = Dataset(tmp_path_factory.mktemp("learn")).having(*"abcdefg")
    whole, corner = dataset.assets["b"], np.argwhere(np.ones((2, 2, 3))).astype(np.uint8)
    coords = np.concatenate([whole.coords, corner])
    dataset.write_slat("b.npz", coords, np.concatenate([whole.feats, whole.feats[:12]]))
    dataset.add("h", 7, views=("front", "side"))
    out = tmp_path_factory.mktemp("learn_store") / "learn.zarr"
    build_store(dataset.parameters(), out)
    assert [int(np.sum(~one.valid)) for one in open_store(out)] == [0, 12, *[0] * 7]
    return out


@pytest.fixture
def learn_copy(learn_store: Path, tmp_path: Path) -> Path:
    """Return a copy of the store that may be changed."""
    return Path(shutil.copytree(learn_store, tmp_path / "s.zarr"))

"""Datasets of small made assets, and a build of one."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from support.deformed import add_deformed
from support.synthetic import Dataset, Made, MakeDataset, make_asset
from support.trees import copied

from slatprep.pipeline import rows
from slatprep.pipeline.dataset import BuildSummary, build_store
from slatprep.storage import states

# Tests must pass however busy the machine is.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

# No test takes the power away, so none can see whether bytes have reached the disk: builds in
# this process need not wait for that. The clock's tick is 10 ms at most.
os.fsync = lambda descriptor: None
states.FINE_NS = 20_000_000


@pytest.fixture
def make_dataset(tmp_path: Path) -> MakeDataset:
    """Make a dataset of good assets: ``make_dataset("a", "b")``."""
    return lambda *ids: Dataset(tmp_path / "sources").having(*ids)


@pytest.fixture
def files_are_old(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trust the states of files wherever they lie, and however shortly ago they were written."""
    monkeypatch.setattr(states, "FINE_NS", 0)
    monkeypatch.setattr(states, "COARSE_NS", 0)
    monkeypatch.setattr(states, "keeps_times", lambda mounts, mount: True)


@pytest.fixture
def few_are_new(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let two new assets of six be few."""
    monkeypatch.setattr(rows, "MOST_BEHIND", 1.0)


@pytest.fixture(scope="session")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Make five good rows, one of an object with two views, one bad file and one lone grid."""
    dataset = Dataset(tmp_path_factory.mktemp("mixed"))
    dataset.add("cup", seed=0)
    dataset.add("bear", seed=1, views=("front", "side"))
    dataset.add("ant", seed=2)
    dataset.add("dog", seed=3)
    dataset.write_grid("lone", make_asset(4).grid)
    dataset.write_grid("torn", make_asset(5).grid)
    dataset.write_slat("torn.npz", np.empty((0, 3), np.uint8), np.empty((0, 8), np.float32))
    return dataset


@pytest.fixture(scope="session")
def mixed_build(mixed: Dataset, tmp_path_factory: pytest.TempPathFactory) -> BuildSummary:
    """Build `mixed` on one core; nobody may change the store."""
    out = tmp_path_factory.mktemp("built") / "mixed.zarr"
    return build_store(mixed.parameters(), out)


@pytest.fixture
def store(mixed_build: BuildSummary) -> Path:
    return Path(str(mixed_build.store))


@pytest.fixture
def copy(mixed_build: BuildSummary, tmp_path: Path) -> Path:
    """Return a copy of the store that may be changed, its records beside it."""
    return copied(Path(str(mixed_build.store)), tmp_path / "copy.zarr")


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return three assets and the store of an undisturbed build; nobody may change them."""
    folder = tmp_path_factory.mktemp("undisturbed")
    dataset = Dataset(folder / "sources").having(*"abc")
    build_store(dataset.parameters("pixie"), folder / "s.zarr")
    return dataset, folder / "s.zarr"


@pytest.fixture(scope="session")
def deformed_build(tmp_path_factory: pytest.TempPathFactory) -> BuildSummary:
    """Build a bent and a stretched asset; nobody may change the store."""
    dataset = Dataset(tmp_path_factory.mktemp("deformed"))
    add_deformed(dataset)
    return build_store(dataset.parameters(), dataset.root / "deformed.zarr")

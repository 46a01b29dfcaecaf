"""Builds whose steps are noted, a store to copy, and the published dataset with the store of it."""

import shutil
from pathlib import Path

import pytest
from support.faults import inject
from support.published import IDS, make_published, parameters
from support.synthetic import Dataset, Made, MakeDataset
from support.trees import tree

from slatprep.pipeline.dataset import build_store


@pytest.fixture
def dataset(make_dataset: MakeDataset) -> Dataset:
    return make_dataset(*"abcdef")


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Collect what the last build has reached since it locked its folder."""
    found: list[tuple[str, str]] = []

    def collect(step: str, name: str) -> None:
        if step.startswith("work folder"):
            found.clear()
        else:
            found.append((step, name))

    inject(monkeypatch, collect)
    return found


@pytest.fixture
def aligned(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Note the assets that are aligned."""
    seen: list[str] = []
    inject(monkeypatch, lambda step, name: step == "asset aligned" and seen.append(name))
    return seen


@pytest.fixture(scope="session")
def three(undisturbed: Made, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return the assets of `undisturbed` and a store with their own ranges, not to be changed."""
    folder = tmp_path_factory.mktemp("three")
    build_store(undisturbed[0].parameters(), folder / "s.zarr")
    return undisturbed[0], folder / "s.zarr"


@pytest.fixture
def built(three: Made, tmp_path: Path) -> Made:
    """Return copies of three assets and of their store: a build knows no file by its state."""
    dataset, out = three
    shutil.copytree(dataset.root, tmp_path / "sources")
    shutil.copytree(out.parent, tmp_path, dirs_exist_ok=True)
    return Dataset(tmp_path / "sources", dict(dataset.assets)), tmp_path / out.name


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the published dataset, with folders beside the grids that hold none."""
    folder = make_published(tmp_path_factory.mktemp("published"))
    for other in ("data", "outputs"):
        (folder / "pixieverse" / other / IDS[0]).mkdir(parents=True)
    return folder


@pytest.fixture(scope="session")
def objects(made: Path) -> Path:
    return made / "pixieverse" / "render_outputs"


@pytest.fixture(scope="session")
def unpacked(made: Path) -> dict[str, str]:
    """Return the files of the store of the unpacked folder."""
    wanted = parameters(made, "pixieverse/render_outputs", categories=True)
    build_store(wanted, made / "unpacked.zarr")
    return tree(made / "unpacked.zarr")

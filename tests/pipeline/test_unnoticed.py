"""Sources that change without a trace at their place are hashed, or found soon."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.faults import inject
from support.first_builds import tree_from_nothing
from support.installed import package
from support.synthetic import Dataset
from support.trees import tree

from slatprep import build_store, readers
from slatprep.pipeline import before, plan, seen
from slatprep.records import AssetPair, SourceRoots
from slatprep.storage import states

WAIT_S = 2 * states.FINE_NS / 1e9


def built(dataset: Dataset, folder: Path, **how: object) -> dict[str, str]:
    return tree(build_store(dataset.parameters(), folder / "s.zarr", **how).store)


@pytest.mark.parametrize("closed", [False, True])
def test_a_mapping_that_is_held_open(tmp_path, closed):
    dataset = Dataset(tmp_path / "d").having("a")
    path = dataset.root / "pixieverse" / "a" / "sample_0" / "material_grid.npy"
    held = np.load(path, mmap_mode="r+")
    at = tuple(np.argwhere(held[..., 3] == 0)[0])
    held[(*at, 0)] *= 1.01
    time.sleep(WAIT_S)
    state = path.stat()
    first = built(dataset, tmp_path, rehash=0)
    held[(*at, 0)] *= 1.01
    assert path.stat().st_mtime_ns == state.st_mtime_ns
    if closed:
        del held
    assert built(dataset, tmp_path, rehash=0) == tree_from_nothing(dataset.parameters())
    assert tree(tmp_path / "s.zarr") != first


@pytest.mark.parametrize("what", ["folder", "root that is a link", "file of an update"])
def test_sources_that_are_exchanged_while_they_are_read_and_put_back(tmp_path, monkeypatch, what):
    dataset, other = (Dataset(tmp_path / name).having("a") for name in ("d", "other"))
    other.change_slat("a")
    place, theirs = dataset.root / "slat", other.root / "slat"
    if what == "file of an update":
        place, theirs = place / "a.npz", theirs / "a.npz"
        built(dataset, tmp_path, rehash=0)
        dataset.change_slat("a", 2)
    elif what == "root that is a link":
        dataset.root.rename(tmp_path / "v1")
        place, theirs = dataset.root, tmp_path / "v2"
        place.symlink_to("v1")
        theirs.symlink_to("other")

    def exchange(step: str, name: str) -> None:
        if step in ("asset begun", "asset read", "asset reused"):
            place.rename(tmp_path / "aside")
            theirs.rename(place)
            (tmp_path / "aside").rename(theirs)

    time.sleep(WAIT_S)
    with monkeypatch.context() as context:
        inject(context, exchange)
        wrong = built(dataset, tmp_path, rehash=0)
    right = tree_from_nothing(dataset.parameters())
    assert wrong != right
    assert built(dataset, tmp_path, rehash=0) == right


@pytest.fixture
def unnoticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files_are_old: None
) -> Callable[[], Dataset]:
    """Return what changes one source while its state stays."""
    dataset = Dataset(tmp_path / "d")
    for k in range(6):
        dataset.add(f"a{k}", seed=0)
    looked = {}

    def same(self: states.States, file: str | int) -> states.State | None:
        found = of(self, file)
        return looked.setdefault(file, found) if isinstance(file, str) else found

    of = states.States.of

    def change() -> Dataset:
        for path in dataset.root.rglob("*.np*"):
            looked[str(path)] = of(states.States(), str(path))
        monkeypatch.setattr(states.States, "of", same)
        dataset.change_slat("a3")
        return dataset

    built(dataset, tmp_path)
    return change


def test_a_share_is_hashed_at_each_build_and_finds_all(unnoticed, tmp_path):
    first, dataset = tree(tmp_path / "s.zarr"), unnoticed()
    assert built(dataset, tmp_path, rehash=0) == first
    for seed in range(100):
        again = build_store(dataset.parameters(), tmp_path / "s.zarr", rehash=0.3, rehash_seed=seed)
        assert again.rehash_seed == seed
        if again.warnings:
            break
        assert tree(tmp_path / "s.zarr") == first
    assert seed < 20  # Two of six are hashed each time.
    assert "the sources of a3 changed" in again.warnings[0]
    assert tree(tmp_path / "s.zarr") == tree_from_nothing(dataset.parameters())


def test_at_least_one_is_hashed_by_default_or_none_if_asked(tmp_path, monkeypatch, files_are_old):
    dataset, hashed = Dataset(tmp_path / "d").having("a", "b"), list[str]()
    built(dataset, tmp_path)
    real = plan.hash_sources
    for module in (before, plan):
        monkeypatch.setattr(module, "hash_sources", lambda p: hashed.append(p.asset_id) or real(p))
    built(dataset, tmp_path)
    assert len(hashed) == 1
    built(dataset, tmp_path, rehash=0)
    assert len(hashed) == 1
    built(dataset, tmp_path, rehash=True)
    assert len(hashed) == 3


def test_another_version_of_an_adapter_changes_no_source(tmp_path, monkeypatch, files_are_old):
    dataset, out = Dataset(tmp_path / "d").having("a", "b"), tmp_path / "s.zarr"
    code = {"mine": "from slatprep.readers.pixieverse import PixieVerse"}
    points = "[slatprep.sources]\nmine = mine:PixieVerse\n"
    with package(tmp_path / "site", "theirs", code, points, monkeypatch):
        parameters = dataset.parameters(pixieverse={"adapter": "mine"})
        first = build_store(parameters, out)
        monkeypatch.setattr(readers, "made_by", lambda group, name: "theirs 2.0")
        second = build_store(parameters, out)
        assert second.build_id != first.build_id
        assert not [text for text in second.warnings if "look as they did" in text]
        monkeypatch.setattr(readers, "made_by", lambda group, name: "theirs 3.0")
        assert build_store(parameters, out, rehash=0).build_id != second.build_id


def test_nothing_is_seen_of_an_asset_whose_reader_reads_what_is_not_known():
    roots = SourceRoots(Path(), Path())
    pair = AssetPair("a", "a", "", "", roots, Path("/g"), None, None, Path("/s"))
    files = {"/s": (1,), "/g": (2,)}
    assert seen.as_read(pair, files) != bytes(16)
    assert seen.as_read(pair, {**files, "/mesh": (3,)}) == bytes(16)
    assert seen.as_read(pair, {**files, "/g": None}) == bytes(16)

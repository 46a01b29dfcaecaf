"""Sources that change without a trace at their place are hashed, or found soon."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from support.faults import inject
from support.first_builds import tree_from_nothing
from support.synthetic import Dataset, make_asset
from support.trees import tree

from slatprep.pipeline import before, plan, seen
from slatprep.pipeline.dataset import build_store
from slatprep.records import AssetPair, SourceRoots
from slatprep.storage import states

WAIT_S = 2 * states.FINE_NS / 1e9


def built(dataset: Dataset, folder: Path, **how: object) -> dict[str, str]:
    summary = build_store(dataset.parameters(), folder / "s.zarr", **how)  # type: ignore[arg-type]
    return tree(summary.store)


def other_slat(dataset: Dataset, name: str = "a.npz") -> None:
    made = make_asset(0)
    dataset.write_slat(name, made.coords, made.feats + 1)


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


@pytest.mark.parametrize(
    ("what", "of"),
    [
        *((what, "first build") for what in ("folder", "file", "link", "root that is a link")),
        ("file", "update"),
    ],
)
def test_sources_that_are_exchanged_while_they_are_read_and_put_back(
    tmp_path, monkeypatch, what, of
):
    dataset, other = (Dataset(tmp_path / name).having("a") for name in ("d", "other"))
    other_slat(other)
    place = dataset.root / "slat" if what == "folder" else dataset.root / "slat" / "a.npz"
    theirs = other.root / place.relative_to(dataset.root)
    if what == "root that is a link":
        place, theirs = dataset.root, other.root
    kept = tmp_path / "v1" if what != "link" else place.with_name("v1")
    if what == "link":  # It may not lead out of the root.
        theirs = theirs.rename(place.with_name("v2"))
    if "link" in what:
        place.rename(kept)
        place.symlink_to(kept)

    def exchange(there: Path) -> None:
        if "link" in what:
            place.unlink()
            place.symlink_to(there)
        else:
            place.rename(tmp_path / "aside")
            there.rename(place)
            (tmp_path / "aside").rename(there)

    def fault(step: str, name: str) -> None:
        if step == "asset begun":
            exchange(theirs)
        elif step in ("asset read", "asset reused"):
            exchange(kept if "link" in what else theirs)

    if of == "update":
        built(dataset, tmp_path, rehash=0)
        with np.load(dataset.root / "slat" / "a.npz") as arrays:
            changed = arrays["coords"], arrays["feats"] + 2
        dataset.write_slat("a.npz", *changed)
    time.sleep(WAIT_S)
    with monkeypatch.context() as context:
        inject(context, fault)
        wrong = built(dataset, tmp_path, rehash=0)
    right = tree_from_nothing(dataset.parameters())
    assert wrong != right
    assert built(dataset, tmp_path, rehash=0) == right


@contextmanager
def mounted(image: Path, place: Path) -> Iterator[None]:
    place.mkdir(exist_ok=True)
    done = subprocess.run(["mount", "-o", "ro,loop", image, place], capture_output=True)
    if done.returncode:
        pytest.skip(f"no image can be mounted here ({done.stderr.decode().strip()})")
    try:
        yield
    finally:
        subprocess.run(["umount", place], check=True)


@pytest.mark.skipif(
    os.geteuid() != 0 or not (shutil.which("mkfs.ext4") and shutil.which("mount")),
    reason="only root mounts images; tests/storage/test_states.py has what is asked of mounts",
)
def test_images_that_are_mounted_in_turn(tmp_path):
    dataset = Dataset(tmp_path / "made").having("a")
    images = [tmp_path / name for name in ("a.img", "b.img")]
    with images[0].open("wb") as file:
        file.truncate(16 << 20)
    subprocess.run(["mkfs.ext4", "-q", "-O", "^metadata_csum", "-d", dataset.root, images[0]],
                   check=True)  # fmt: skip
    content = images[0].read_bytes()
    asset = make_asset(0)
    old = asset.feats[:16].tobytes()
    assert content.count(old) == 1
    # ...of the archive's sums, too, or the reader refuses it.
    other = Dataset(tmp_path / "other")
    changed = asset.feats.copy()
    changed[:16] += 1
    other.write_slat("a.npz", asset.coords, changed)
    before = (dataset.root / "slat" / "a.npz").read_bytes()
    after = (other.root / "slat" / "a.npz").read_bytes()
    assert len(before) == len(after)
    for at in range(0, len(before), 1024):  # blocks, which need not lie in a row
        one, two = before[at : at + 1024], after[at : at + 1024]
        if one != two:
            assert content.count(one) == 1
            content = content.replace(one, two)
    images[1].write_bytes(content)
    there = Dataset(tmp_path / "mounted")
    states_seen, trees = [], []
    time.sleep(states.COARSE_NS / 1e9)  # mkfs.ext4 gives whole seconds.
    for image in images:
        with mounted(image, there.root):
            found = (there.root / "slat" / "a.npz").stat()
            states_seen.append((found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns))
            trees.append(built(there, tmp_path, rehash=0))
            assert trees[-1] == tree_from_nothing(there.parameters())
    assert states_seen[0] == states_seen[1]
    assert trees[0] != trees[1]


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
        other_slat(dataset, "a3.npz")
        return dataset

    built(dataset, tmp_path)
    return change


def test_a_share_is_hashed_at_each_build_and_finds_all(unnoticed, tmp_path):
    first, dataset = tree(tmp_path / "s.zarr"), unnoticed()
    assert built(dataset, tmp_path, rehash=0) == first
    for seed in range(100):
        summary = build_store(
            dataset.parameters(), tmp_path / "s.zarr", rehash=0.3, rehash_seed=seed
        )
        assert summary.rehash_seed == seed
        if summary.warnings:
            break
        assert tree(tmp_path / "s.zarr") == first
    assert seed < 20  # Two of six are hashed each time.
    assert "the sources of a3 changed" in summary.warnings[0]
    assert tree(tmp_path / "s.zarr") == tree_from_nothing(dataset.parameters())


def test_at_least_one_is_hashed_by_default_and_none_if_so_asked(
    tmp_path, monkeypatch, files_are_old
):
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


def test_nothing_is_seen_of_an_asset_whose_reader_reads_what_is_not_known():
    roots = SourceRoots(Path(), Path())
    pair = AssetPair("a", "a", "", "", roots, Path("/g"), None, None, Path("/s"))
    files = {"/s": (1,), "/g": (2,)}
    assert seen.as_read(pair, files) != bytes(16)
    assert seen.as_read(pair, {**files, "/mesh": (3,)}) == bytes(16)
    assert seen.as_read(pair, {**files, "/g": None}) == bytes(16)

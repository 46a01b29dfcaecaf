"""An update of a store on S3: what did not change is copied by the server, and not read."""

import shutil
from pathlib import Path

import pytest
from s3fs.core import S3FileSystem
from support import remote
from support.faults import inject
from support.remote import Dataset, Made, current, put, raising
from support.trees import tree

from slatprep.errors import StoreError
from slatprep.inspect.verify import verify_store
from slatprep.pipeline.dataset import build_store
from slatprep.store import open_store

pytestmark = pytest.mark.usefixtures("files_are_old", "few_are_new")


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Four assets and their store; nobody may change them."""
    return remote.built(tmp_path_factory.mktemp("first"), "a", "c", "e", "g")


@pytest.fixture
def built(first: Made, url: str, tmp_path: Path) -> Made:
    """Four assets; a store of them on S3 that another machine put there, and the same here."""
    sources = shutil.copytree(first[0].root, tmp_path / "sources")
    beside = shutil.copytree(first[1], tmp_path / "s.zarr")
    put(beside, url)
    return Dataset(sources), beside


def below(names: list[str], version: str) -> set[str]:
    return {name.partition(f"{version}/")[2] for name in names} - {""}


def test_shards_that_did_not_change_are_copied_by_the_server(s3, url, built, requests, monkeypatch):
    dataset, beside = built
    before = tree(beside)
    dataset.add("b", seed=1)
    begun: list[str] = []
    inject(monkeypatch, lambda step, name: begun.append(name) if step == "asset begun" else None)
    old = open_store(url).path.name
    requests.made.clear()
    build_store(dataset.parameters("pixie"), url)
    assert begun == ["b"]
    new = open_store(url).path.name
    build_store(dataset.parameters("pixie"), beside)
    after = tree(beside)
    # The same bytes as where the store lies on a disk, which took over the same shards.
    assert current(s3, url) == after
    groups = ("voxel/", "grid/", "asset/record/")
    same = {name for name in before.items() & after.items() if name[0].startswith(groups)}
    # What names the axes is written with every store.
    axes = {"axis", "property", "x", "y", "z"}
    same_shards = {name for name, _ in same if "/c/" in name and name.split("/")[1] not in axes}
    assert len(same_shards) > 20
    copied = below(requests.of("copy_object"), new)
    assert same_shards == copied
    # Of what was copied nothing came here, and nothing went back.
    voxels = {name for name in copied if not name.startswith("asset/")}
    assert voxels
    assert not voxels & below(requests.of("get_object"), old)
    assert not copied & below(requests.of("put_object"), new)
    assert verify_store(url, sources=True).ok


def test_a_shard_that_is_gone_from_the_server_is_made_again(s3, url, built):
    dataset, beside = built
    s3.rm(f"{open_store(url).path}/voxel/feats/c/0/0")
    dataset.add("b", seed=1)
    summary = build_store(dataset.parameters("pixie"), url)
    assert any("voxel/feats/c/0/0" in told for told in summary.damaged)
    build_store(dataset.parameters("pixie"), beside)
    assert current(s3, url) == tree(beside)


def test_where_the_server_does_not_copy_the_old_store_stays(s3, url, built):
    dataset, beside = built
    dataset.add("b", seed=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(S3FileSystem, "_cp_file", raising(PermissionError("Access Denied")))
        with pytest.raises(StoreError, match=r"cannot be written .*nothing was replaced"):
            build_store(dataset.parameters("pixie"), url)
    assert current(s3, url) == tree(beside)
    build_store(dataset.parameters("pixie"), url)
    build_store(dataset.parameters("pixie"), beside)
    assert current(s3, url) == tree(beside)

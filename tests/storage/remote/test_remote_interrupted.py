"""Builds on S3 that are killed, overtaken, spoiled or updated."""

import multiprocessing
import os
import signal
from collections.abc import Callable
from typing import Any

import faulty_s3
import pytest
from s3fs.core import S3FileSystem
from support.faults import inject, kill_self
from support.remote import Dataset, built, current, few_files, put, raising, versions
from support.trees import contents, tree

from slatprep import StoreError, build_store, open_store
from slatprep.storage.place import place_of
from slatprep.storage.upload import published_state, upload_store
from slatprep.storage.versions import read_pointer

Fault = Callable[[str, str], object]


def kill_midway() -> Fault:
    """Let this process be killed at its twentieth object."""
    put_file, left = S3FileSystem._put_file, [20]

    async def dies(*args: Any, **options: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            kill_self()
        return await put_file(*args, **options)

    S3FileSystem._put_file = dies
    return lambda step, name: None


def kill_after() -> Fault:
    return lambda step, name: step == "pointer replaced" and kill_self()


def end_of(run: Callable[[], None]) -> int | None:
    """Call a function in a forked process; return its exit code."""
    child = multiprocessing.get_context("fork").Process(target=run)
    child.start()
    child.join(600)
    return child.exitcode


def build_and_be_killed(fault: Callable[[], Fault], dataset: Dataset, url: str) -> None:
    """Build in a process of its own that kills itself with signal 9 where `fault` has it."""

    def run() -> None:
        inject(pytest.MonkeyPatch(), fault())
        build_store(dataset.parameters("pixie"), url)

    assert end_of(run) == -signal.SIGKILL


@pytest.mark.parametrize(
    ("fault", "shown"),
    [(kill_midway, False), (kill_after, True)],
    ids=["while it uploads", "after the pointer"],
)
def test_a_killed_build_leaves_a_whole_store(s3, url, undisturbed, another, fault, shown, requests):
    (_, old), (dataset, new) = undisturbed, another
    put(old, url)
    build_and_be_killed(fault, dataset, url)
    assert current(s3, url) == tree(new if shown else old)
    there = len(contents(s3, f"{url}/versions"))
    requests.made.clear()
    assert build_store(dataset.parameters("pixie"), url).complete
    assert current(s3, url) == tree(new)
    # Nothing was uploaded twice, and nothing is left but the version before.
    uploaded = [key for key in requests.of("put_object") if "/versions/" in key]
    assert len(uploaded) == len(tree(old)) + len(tree(new)) - there
    pointer = read_pointer(place_of(url))
    assert versions(s3, url) == {pointer.version, pointer.previous}  # type: ignore[union-attr]


def test_what_a_killed_build_uploaded_goes_when_sources_changed(s3, url, undisturbed, another):
    (_, expected), (dataset, _) = undisturbed, another
    build_and_be_killed(kill_midway, dataset, url)
    assert 0 < len(contents(s3, url)) < 30
    assert not s3.exists(f"{url}/current.json")
    with pytest.raises(StoreError, match="does not exist"):
        open_store(url)
    put(expected, url)
    assert current(s3, url) == tree(expected)
    assert len(versions(s3, url)) == 1


def test_an_overtaken_build_is_refused(s3, url, undisturbed, another, monkeypatch, tmp_path):
    """The other runs on another machine: no lock of this one's disk keeps it out."""
    elsewhere = str(tmp_path / "elsewhere")

    def overtaken(step: str, name: str) -> None:
        if step == "store created" and os.environ["SLATPREP_CACHE"] != elsewhere:
            with pytest.MonkeyPatch.context() as there:
                there.setenv("SLATPREP_CACHE", elsewhere)
                build_store(another[0].parameters("pixie"), url)

    inject(monkeypatch, overtaken)
    with pytest.raises(StoreError, match=f"^{url}: another build replaced it while this one ran"):
        build_store(undisturbed[0].parameters("pixie"), url)
    assert current(s3, url) == tree(another[1])


def test_the_second_build_on_one_machine_is_refused_at_once(url, undisturbed, monkeypatch):
    parameters = undisturbed[0].parameters("pixie")

    def twice(step: str, name: str) -> None:
        if step == "store created":
            with pytest.raises(StoreError, match=f"^{url}: another build is writing it"):
                build_store(parameters, url)

    inject(monkeypatch, twice)
    assert build_store(parameters, url).complete


@pytest.mark.parametrize("first", [True, False], ids=["none before", "one before"])
def test_the_server_itself_refuses_a_pointer_that_moved_at_the_last_moment(
    s3, url, change_client, first, tmp_path
):
    old, slow, quick = (few_files(tmp_path / name, name) for name in ("old", "slow", "quick"))
    if not first:
        put(old, url)
    late = upload_store(slow, published_state(place_of(url)))
    early = upload_store(quick, published_state(place_of(url)))
    pipe = S3FileSystem._pipe_file

    async def overtaken(filesystem: Any, path: str, data: bytes, **options: Any) -> Any:
        await pipe(filesystem, path, early.pointer.encode())
        return await pipe(filesystem, path, data, **options)

    change_client("_pipe_file", overtaken)
    with pytest.raises(StoreError, match="another build replaced it"):
        late.publish()
    assert current(s3, url) == tree(quick)


@pytest.mark.parametrize("mute", [False, True], ids=["one answer", "every answer"])
def test_a_lost_answer_makes_no_success_fail(s3, url, change_client, mute, tmp_path):
    old, new = few_files(tmp_path / "old", "old"), few_files(tmp_path / "new", "new")
    put(old, url)
    made = upload_store(new, published_state(place_of(url)))
    pipe, cat, lost = S3FileSystem._pipe_file, S3FileSystem._cat_file, []

    async def deaf(*args: Any, **options: Any) -> Any:
        lost.append(await pipe(*args, **options))
        raise OSError("connection lost")

    async def dead(*args: Any, **options: Any) -> Any:
        if lost and mute:
            raise OSError("connection lost")
        return await cat(*args, **options)

    change_client("_pipe_file", deaf)
    change_client("_cat_file", dead)
    if mute:
        with pytest.raises(StoreError, match="the store is the old one or the new one, whole"):
            made.publish()
    else:
        made.publish()
    assert len(lost) == 1
    lost.clear()
    assert current(s3, url) == tree(new)


def test_spoiled_answers_end_in_the_same_store_or_in_words():
    """The short version of ``benchmarks/faulty_s3.py``."""

    def run() -> None:
        S3FileSystem.clear_instance_cache()
        with faulty_s3.bench_of(seed=1) as bench:
            for number in range(4):
                bench.run(number)
        assert bench.harm == []
        assert bench.faults.told.total() > 0

    assert end_of(run) == 0


def below(names: list[str], version: str) -> set[str]:
    return {name.partition(f"{version}/")[2] for name in names} - {""}


@pytest.mark.usefixtures("files_are_old", "few_are_new")
def test_the_server_copies_shards_and_what_is_gone_is_new(
    s3, url, tmp_path, requests, monkeypatch, new_clients
):
    dataset, beside = built(tmp_path, "a", "c", "e", "g")
    put(beside, url)  # As from another machine: nothing here knows of the sources' states.
    before = tree(beside)
    dataset.add("b", seed=1)
    begun: list[str] = []
    inject(monkeypatch, lambda step, name: begun.append(name) if step == "asset begun" else None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(S3FileSystem, "_cp_file", raising(PermissionError("Access Denied")))
        new_clients()
        with pytest.raises(StoreError, match=r"cannot be written .*nothing was replaced"):
            build_store(dataset.parameters("pixie"), url)
    new_clients()
    assert current(s3, url) == before
    old = open_store(url).path.name
    for noted in (requests.made, begun):
        noted.clear()
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

    s3.rm(f"{open_store(url).path}/voxel/feats/c/0/0")
    dataset.add("d", seed=2)
    summary = build_store(dataset.parameters("pixie"), url)
    assert any("voxel/feats/c/0/0" in told for told in summary.damaged)
    build_store(dataset.parameters("pixie"), beside)
    assert current(s3, url) == tree(beside)

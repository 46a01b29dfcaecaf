"""A cluster whose workers have a disk each writes a store on S3: its bytes, and after kills."""

import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from s3fs.core import S3FileSystem
from support.dask_processes import Processes, end, wait_for_workers
from support.faults import environment as with_fault
from support.faults import wait_until
from support.remote import current, put, raising, versions
from support.synthetic import definition
from support.trees import contents, tree

from slatprep.errors import SlatprepError, StoreError
from slatprep.inspect.verify import verify_store
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.pipeline.work import work_beside
from slatprep.storage.place import place_of
from slatprep.storage.versions import read_pointer
from slatprep.workers.dask import Cluster


@pytest.fixture(scope="module")
def shared(
    environment: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Processes, str]]:
    """A scheduler and two workers, each with a disk of its own."""
    started = Processes(tmp_path_factory.mktemp("dask"))
    address = started.scheduler()
    for _ in range(2):
        started.worker_elsewhere(address, tmp_path_factory.getbasetemp())
    yield started, address
    started.stop()


@pytest.fixture
def address(shared: tuple[Processes, str]) -> str:
    wait_for_workers(shared[1], 2)
    (shared[0].folder / "aligned").unlink(missing_ok=True)
    return shared[1]


def left_behind(s3: Any, url: str) -> set[str]:
    """Return what lies below a store besides the version that is current and the one before."""
    pointer = read_pointer(place_of(url))
    assert pointer is not None
    known = {f"{kind}/{name}" for kind in ("versions", "manifests")
             for name in (pointer.version, pointer.previous)}  # fmt: skip
    found = contents(s3, url).keys() - {"current.json"}
    return {name for name in found if "/".join(name.split("/")[:2]) not in known}


def test_killed_commands_and_workers_with_disks_of_their_own_write_the_bytes_of_one_machine(
    s3, url, uploaded, undisturbed, another, shared, address, tmp_path
):
    faults = shared[0].folder
    put(another[1], url)
    (tmp_path / "dataset.toml").write_text(definition(uploaded))

    def build(fault: str = "") -> subprocess.Popen[bytes]:
        command = ["build-store", "--config", "dataset.toml", "--out", url, "--scheduler", address]
        return subprocess.Popen(
            [sys.executable, "-m", "slatprep", *command],
            cwd=tmp_path, env=with_fault(tmp_path / "faults", fault),
        )  # fmt: skip

    # While one worker holds an asset, and others have been finished.
    (faults / "hold-c").touch()
    first = build()
    wait_until(lambda: len(spooled(s3, url)) == 2)
    first.kill()
    first.wait()
    wait_until((faults / "held").exists)
    os.kill(int((faults / "held").read_text()), 9)
    (faults / "held").unlink()
    assert current(s3, url) == tree(another[1])
    for step in ("store created", "manifests published"):
        assert build(f"if step == {step!r}:\n    kill_self()").wait(900) == -9, step
        assert current(s3, url) == tree(another[1])
    assert len(spooled(s3, url)) == 3
    kills = [faults / f"kill at {step}" for step in ("shard filled", "shard written")]
    for kill in kills:
        kill.touch()
    assert build().wait(900) == 0
    assert not any(kill.exists() for kill in kills)
    assert current(s3, url) == tree(undisturbed[1])
    assert left_behind(s3, url) == set()
    assert len(versions(s3, url)) == 2
    assert verify_store(url).ok
    # No array was on the disk of the machine that ran the command; what it saw stays there.
    stay = [path.name for path in (tmp_path / "cache").rglob("*") if path.is_file()]
    assert stay == ["sources.seen"]
    assert sorted((faults / "aligned").read_text().split()) == ["a", "b", "c"]


def spooled(s3: Any, url: str) -> list[str]:
    return [name for name in s3.find(f"{url}/spool") if name.endswith(".arrays")]


def test_a_worker_without_the_store_is_named(url, uploaded, shared, address, tmp_path_factory):
    lost = shared[0].worker_elsewhere(
        address, tmp_path_factory.getbasetemp(), AWS_ACCESS_KEY_ID="", AWS_SECRET_ACCESS_KEY=""
    )
    try:
        wait_for_workers(address, 3)
        told = rf"worker tcp://.*: sees nothing it may read .*credentials.* {url}/spool/builder"
        with Cluster(address) as cluster, pytest.raises(SlatprepError, match=told):
            build_store(uploaded, url, jobs=cluster)
    finally:
        end(lost)


def test_what_others_keep_beside_a_spool_is_refused_and_stays(s3, url, undisturbed, address):
    s3.pipe_file(f"{url}/spool/notes.txt", b"keep")
    with Cluster(address) as cluster, pytest.raises(SlatprepError, match="holds spool/notes"):
        build_store(undisturbed[0].parameters("pixie"), url, jobs=cluster, fresh=True)
    assert contents(s3, url).keys() == {"spool/notes.txt"}


ASSET = f"ab/ab{'0' * 62}.arrays"


def test_a_build_elsewhere_keeps_its_finished_assets_to_its_end(s3, url, tmp_path, monkeypatch):
    place = place_of(url)
    with work_beside(place, private_disks=True) as running:
        running.shared()
        s3.pipe_file(f"{url}/spool/{ASSET}", b"done")
        before = contents(s3, url)
        monkeypatch.setenv("SLATPREP_CACHE", str(tmp_path / "cache of another machine"))
        with work_beside(place):
            pass
        with pytest.warns(UserWarning, match="another build"), work_beside(
            place, private_disks=True
        ) as other:  # fmt: skip
            other.shared()
        with (
            pytest.raises(StoreError, match=r"spool/builder-[0-9a-f]{16}: another build"),
            work_beside(place, private_disks=True, fresh=True),
        ):
            pass
        assert contents(s3, url) == before
    assert contents(s3, url) == {}
    assert not [path for path in tmp_path.rglob("cache*/**/*") if path.is_file()]


def test_a_build_that_failed_leaves_finished_assets_but_no_mark(s3, url):
    with pytest.raises(RuntimeError), work_beside(place_of(url), private_disks=True) as work:
        work.shared()
        s3.pipe_file(f"{url}/spool/{ASSET}", b"done")
        raise RuntimeError
    assert contents(s3, url).keys() == {f"spool/{ASSET}"}


def test_a_spool_that_cannot_be_emptied_fails_no_build(s3, url, change_client, tmp_path):
    refused = [PermissionError(13, "Access Denied")]
    change_client("_lsdir", raising(refused[0], S3FileSystem._lsdir, lambda *_: bool(refused)))
    with (
        pytest.warns(UserWarning, match="could not be removed .*Access Denied"),
        work_beside(place_of(url), private_disks=True) as work,
    ):
        work.shared()
        work.keep_only(set())
    refused.clear()
    # It holds no lock any more, and its mark is known for that of a build that has ended.
    with work_beside(place_of(url), private_disks=True) as work:
        work.shared()
    assert contents(s3, url) == {}
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]


def test_a_dry_run_on_a_cluster_finds_the_same(s3, url, undisturbed, uploaded, shared, address):
    kill = shared[0].folder / "kill at asset spooled"
    kill.touch()
    with Cluster(address) as cluster:
        assert build_store(uploaded, url, jobs=cluster, keep_work=True).complete
        assert not kill.exists()
        assert current(s3, url) == tree(undisturbed[1])
        s3.rm(f"{url}/current.json")
        plan = plan_build(uploaded, url, jobs=cluster)
        fresh = plan_build(uploaded, url, jobs=cluster, fresh=True)
    assert plan.actions["resume"] == 3 and fresh.actions["align"] == 3

"""Builds on a real Dask cluster: a scheduler and three workers, processes of their own."""

import os
import re
import shutil
import signal
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest
from support.commands import run
from support.dask_processes import Processes, end, threads_for_workers, wait_for_workers
from support.faults import flip, wait_until
from support.synthetic import Dataset, Made, definition
from support.trees import tree

import slatprep
from slatprep.align import engine_versions
from slatprep.errors import SlatprepError
from slatprep.inspect.verify import verify_store
from slatprep.parameters import AlignParameters, BuildParameters, PixieverseSource, SlatSource
from slatprep.pipeline.dataset import align_pairs, build_store, plan_build
from slatprep.readers.adapters import LIBRARIES
from slatprep.workers import dask as module
from slatprep.workers.dask import Cluster
from slatprep.workers.local import run_unordered


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Processes, str]]:
    """One cluster for all tests that leave it as it was."""
    started = Processes(tmp_path_factory.mktemp("dask"))
    address = started.scheduler()
    started.forked(address, "--nworkers", "3")
    wait_for_workers(address, 3)
    yield started, address
    started.stop()


@pytest.fixture
def address(shared: tuple[Processes, str]) -> str:
    wait_for_workers(shared[1], 3)
    return shared[1]


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Six assets, and the store that one process makes of them."""
    folder = tmp_path_factory.mktemp("local")
    dataset = Dataset(folder / "sources").having(*"abcdef")
    build_store(dataset.parameters("pixie"), folder / "s.zarr", jobs=1)
    return dataset, folder / "s.zarr"


# -- a build ----------------------------------------------------------------


def test_a_build_whose_workers_are_killed_gives_the_same_bytes(shared, address, local, tmp_path):
    dataset, expected = local
    faults, once = shared[0].folder, shared[0].folder / "kill at shard filled"
    (faults / "hold-c").touch()
    once.touch()
    parameters = dataset.root.parent / "dataset.toml"
    parameters.write_text(definition(dataset.parameters("pixie")))

    def kill_who_holds() -> None:
        wait_until((faults / "held").exists)
        os.kill(int((faults / "held").read_text()), signal.SIGKILL)
        (faults / "held").unlink()

    with ThreadPoolExecutor(1) as pool:
        killer = pool.submit(kill_who_holds)
        out = ("--out", tmp_path / "s.zarr", "--scheduler", address)
        errors = run("build-store", "--config", parameters, *out).stderr
        killer.result()
    # On a busy machine it takes long enough for a line of progress.
    told = re.sub(r"build: \d of 6 assets, [\w: ]+ left\n", "", errors).splitlines()
    assert told[0] == f"{address}: 3 workers"
    # Some assets have one grid, and values beyond Pixie's ranges; a build tells of both.
    assert "share the same grid" in told[1], told
    assert all("are beyond its range" in line for line in told[2:]), told
    assert not once.exists()
    assert tree(tmp_path / "s.zarr") == tree(expected)
    assert verify_store(tmp_path / "s.zarr").ok


def test_an_asset_that_kills_every_worker_costs_itself_alone(shared, address, local, tmp_path):
    dataset, expected = local
    deadly = shared[0].folder / "deadly-b"
    deadly.touch()
    try:
        with Cluster(address) as cluster:
            summary = build_store(dataset.parameters("pixie"), tmp_path / "s.zarr", jobs=cluster)
    finally:
        deadly.unlink()
    assert summary.statuses == {"ok": 5, "failed": 1, "skipped": 0}
    assert "worker process was killed twice" in dict(summary.problems)["b"]
    # What the cluster left is what this machine goes on from, and the other way round.
    build_store(dataset.parameters("pixie"), tmp_path / "s.zarr", jobs=1)
    assert tree(tmp_path / "s.zarr") == tree(expected)


def test_the_other_commands_find_the_same(address, local, tmp_path):
    dataset, store = local
    parameters, damaged = dataset.parameters("pixie"), tmp_path / "damaged.zarr"
    shutil.copytree(store, damaged)
    flip(max((damaged / "voxel" / "feats").rglob("*"), key=lambda path: path.stat().st_size), 100)
    with Cluster(address) as cluster:
        aligned = align_pairs(parameters, tmp_path / "cluster.jsonl", jobs=cluster)
        plan = plan_build(parameters, store, jobs=cluster)
        findings = verify_store(damaged, jobs=cluster).findings
    assert aligned.build_id == align_pairs(parameters, tmp_path / "here.jsonl").build_id
    assert plan.actions["reuse"] == 6
    assert findings == verify_store(damaged).findings
    run("verify", store, "-q", "--scheduler", address)


# -- what a worker must have ------------------------------------------------


def test_workers_that_do_not_see_the_sources_are_named(address, local, tmp_path, monkeypatch):
    """The folder of this process is not that of a worker, though both have the same path."""
    dataset, _ = local
    monkeypatch.chdir(dataset.root)
    parameters = BuildParameters(
        PixieverseSource(Path("/proc/self/cwd/pixieverse")), SlatSource(Path("/proc/self/cwd/slat"))
    )
    message = r"worker tcp://127.0.0.1:\d+ on .*: sees nothing .* at /proc/self/cwd/pixieverse"
    with Cluster(address) as cluster, pytest.raises(SlatprepError, match=message):
        build_store(parameters, tmp_path / "s.zarr", jobs=cluster)
    assert not list(tmp_path.iterdir())


def test_workers_that_do_not_see_the_folder_of_the_work_are_named(address, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "build-1").mkdir()
    with Cluster(address) as cluster:
        cluster.require_shared([tmp_path / "build-1"])
        with pytest.raises(SlatprepError, match="a folder that may be written to where"):
            cluster.require_shared([Path("/proc/self/cwd/build-1")])
        with pytest.raises(SlatprepError, match="relative path"):
            cluster.require_shared([Path("build-1")])


def test_a_worker_that_is_not_fit_is_refused_even_when_it_joins_late(shared, address):
    with Cluster(address) as cluster:
        results = cluster.run_unordered(time.sleep, ((0.2,) for _ in range(10**6)))
        next(results)
        unfit = shared[0].worker(address, "--nthreads", "2")
        try:
            with pytest.raises(SlatprepError, match=r"worker tcp://.* has 2 threads; expected one"):
                list(results)
            with pytest.raises(SlatprepError, match="has 2 threads"), Cluster(address):
                pass
        finally:
            end(unfit)


def test_every_library_that_makes_numbers_must_be_the_same():
    readers = {one for libraries in LIBRARIES.values() for one in libraries}
    assert readers | set(engine_versions(AlignParameters())) <= dict(module._software()).keys()


def test_a_worker_with_other_code_is_refused(shared, address, tmp_path):
    copy = tmp_path / "other" / "slatprep"
    shutil.copytree(Path(slatprep.__file__).parent, copy)
    with (copy / "sample.py").open("a") as file:
        file.write("\nOTHER = True\n")
    other = shared[0].worker(address, path=str(copy.parent))
    expected = r"worker tcp://.* has slatprep's code [0-9a-f]+, where .* expected the same env"
    try:
        wait_for_workers(address, 4)
        with pytest.raises(SlatprepError, match=expected), Cluster(address):
            pass
    finally:
        end(other)


# -- a scheduler that fails -------------------------------------------------


def test_a_scheduler_that_nobody_reaches(monkeypatch):
    monkeypatch.setattr(module, "ANSWER_SECONDS", 1.5)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        nobody = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        with pytest.raises(SlatprepError, match=f"{nobody}: no Dask scheduler answers there"):
            Cluster(nobody).__enter__()
        free.listen()  # Now somebody takes the call, but does not speak.
        with pytest.raises(SlatprepError, match="did not speak within 2 s"):
            Cluster(nobody).__enter__()
    for wrong in ("", "127.0.0.1", "http://127.0.0.1:80"):
        with pytest.raises(SlatprepError, match="expected an address such as tcp://host:8786"):
            Cluster(wrong).__enter__()


def test_a_scheduler_that_is_killed_ends_the_run_and_nothing_hangs(tmp_path, monkeypatch):
    processes = Processes(tmp_path)
    with ExitStack() as ending:
        ending.callback(processes.stop)
        scheduler = processes.scheduler()
        processes.worker(scheduler, "--no-nanny")
        cluster = ending.enter_context(Cluster(scheduler))
        # Only now: a loaded machine may need longer for the first answer.
        monkeypatch.setattr(module, "ANSWER_SECONDS", 3)
        results = cluster.run_unordered(time.sleep, ((0.2,) for _ in range(10**6)))
        next(results)
        end(processes._started[0])
        with pytest.raises(SlatprepError, match="connection to the scheduler was lost; what was"):
            list(results)
        with pytest.raises(SlatprepError, match="connection to the scheduler was lost"):
            list(cluster.run_unordered(time.sleep, [(0,)]))


def test_the_first_worker_is_waited_for():
    with threads_for_workers(0) as started:
        lines: list[str] = []

        def note(line: str) -> None:
            lines.append(line)
            started.scale(1)

        with Cluster(started.scheduler_address, note) as cluster:
            assert list(run_unordered(divmod, [(7, 2)], cluster)) == [(3, 1)]
        address = started.scheduler_address
    assert lines == [f"{address}: has no worker yet; waiting for the first", f"{address}: 1 worker"]

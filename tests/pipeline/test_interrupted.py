"""Builds that are killed, starved or refused: each by doing it to a real build."""

import json
import random
import shutil
import signal
import time
from pathlib import Path

import pytest
from support.build_process import Build, kill_at
from support.faults import inject, wait_until
from support.rights import BOUND_BY_PERMISSIONS
from support.synthetic import Dataset, Made
from support.trees import tree

from slatprep import StoreError, build_store, open_store
from slatprep.inspect.verify import verify_store
from slatprep.pipeline.work import work_beside
from slatprep.storage import atomic


@pytest.fixture
def reference(undisturbed: Made, tmp_path: Path) -> tuple[Dataset, Path, dict[str, str]]:
    """Three assets that may be changed, where to build, and the hashes of what is to come."""
    dataset, store = undisturbed
    shutil.copytree(dataset.root, tmp_path / "sources")
    return Dataset(tmp_path / "sources", dataset.assets), tmp_path / "s.zarr", tree(store)


@pytest.fixture(scope="module")
def old_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("old")
    dataset = Dataset(folder / "sources").having("z", seed=3)
    return Path(str(build_store(dataset.parameters("pixie"), folder / "s.zarr").store))


def ends_well(dataset: Dataset, out: Path, expected: dict[str, str]) -> None:
    """Run the build again and hold the result against what no fault has touched."""
    summary = build_store(dataset.parameters("pixie"), out)
    assert tree(out) == expected
    manifests = out.with_suffix(".manifests")
    assert {path.name for path in out.parent.glob("*s.*")} == {out.name, manifests.name}
    kept = {path.name for path in manifests.iterdir()}
    assert kept == {"assets.jsonl", "build.json", "sources.seen"}
    assert json.loads((manifests / "build.json").read_text())["id"] == summary.build_id
    assert len((manifests / "assets.jsonl").read_text().splitlines()) == 3


@pytest.mark.parametrize(("step", "calls"), [
    ("asset begun", 2), ("shard begun", 3), ("directory flushed", 0), ("directory exchanged", 0),
    ("store replaced", 0), ("manifests written", 0),
])  # fmt: skip
def test_killed_at_every_step(reference, old_store, step, calls):
    dataset, out, expected = reference
    shutil.copytree(old_store, out)
    before = tree(out)

    killed = Build(dataset, out, kill_at(step, calls)).done()
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert tree(out) in (before, expected)
    ends_well(dataset, out, expected)


def test_what_was_finished_is_not_done_again(reference, tmp_path, aligned):
    dataset, out, expected = reference
    killed = Build(dataset, out, kill_at("asset begun", 2)).done()
    assert killed.returncode == -signal.SIGKILL
    # A torn file, as a power failure leaves it, is known and done again.
    torn, *_ = sorted((tmp_path / ".s.zarr.work" / "spool").rglob("*.arrays"))
    torn.write_bytes(torn.read_bytes()[:-2000])
    # One was finished, so two alignments are enough.
    again = build_store(dataset.parameters("pixie"), out)
    assert (len(aligned), again.aligned, again.taken_over) == (2, 2, 1)
    assert tree(out) == expected


def test_what_is_torn_after_the_plan_counts_as_aligned(reference, tmp_path, monkeypatch):
    dataset, out, expected = reference
    assert Build(dataset, out, kill_at("asset begun", 2)).done().returncode == -signal.SIGKILL
    finished = sorted((tmp_path / ".s.zarr.work" / "spool").rglob("*.arrays"))

    def tear(step: str, _name: str) -> None:
        while step == "asset begun" and finished:
            torn = finished.pop()
            torn.write_bytes(torn.read_bytes()[:-2000])

    inject(monkeypatch, tear)
    summary = build_store(dataset.parameters("pixie"), out)
    assert (summary.aligned, summary.taken_over) == (3, 0)
    assert tree(out) == expected


def test_a_kill_between_two_renames_is_mended(reference, tmp_path):
    """Where directories cannot be exchanged, there is a moment without a store."""
    dataset, out, expected = reference
    build_store(dataset.parameters("pixie"), out)
    work = tmp_path / ".s.zarr.work"
    (work / "build-x").mkdir(parents=True)
    (work / "lock").touch()
    out.rename(atomic._aside(work / "build-x"))
    with work_beside(out):
        assert tree(out) == expected
    assert not work.exists()


def test_workers_that_die_cost_nothing_and_an_asset_that_kills_each_is_named(reference, tmp_path):
    """One dies at asset b, another one at a shard, and whichever gets asset c."""
    (dataset, out, expected), died = reference, tmp_path / "died"
    died.mkdir()
    fault = f"""
mark = os.path.join({str(died)!r}, step)
if (step == "shard filled" or (step, name) == ("asset begun", "b")) and not os.path.exists(mark):
    open(mark, "w").close()
    kill_self()
if (step, name) == ("asset begun", "c"):
    kill_self()
"""
    done = Build(dataset, out, fault, jobs=2).done()
    assert done.returncode == 0, done.stderr
    assert {path.name for path in died.iterdir()} == {"asset begun", "shard filled"}
    statuses, problems = json.loads(done.stdout)
    assert statuses == {"ok": 2, "failed": 1, "skipped": 0}
    assert "worker process was killed twice" in problems["c"]
    others = Dataset(tmp_path / "others").having("a", "b")
    assert tree(out) == tree(build_store(others.parameters("pixie"), tmp_path / "o.zarr").store)
    assert verify_store(out).ok
    ends_well(dataset, out, expected)


def test_memory_that_runs_out_is_told_of_the_asset(reference):
    dataset, out, expected = reference
    fault = """
import numpy, resource
if (step, name) == ("asset read", "b"):
    used = int(open("/proc/self/statm").read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + 2**26, before[1]))
    try:
        numpy.ones(2**26)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
"""
    done = Build(dataset, out, fault).done()
    assert done.returncode == 0, done.stderr
    _, problems = json.loads(done.stdout)
    assert problems["b"].startswith("memory ran out")
    ends_well(dataset, out, expected)


@pytest.mark.parametrize("step", ["asset aligned", "shard begun"])
def test_a_disk_that_takes_no_more(reference, step):
    """A limit on the size of files stands in for a full disk: the same error at a write."""
    dataset, out, expected = reference
    fault = f"""
import resource
if step == {step!r}:
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY))
"""
    done = Build(dataset, out, fault).done()
    assert done.returncode == 1
    assert done.stderr.startswith("refused: a: " if step == "asset aligned" else "refused: ")
    assert "cannot be written to" in done.stderr and "File too large" in done.stderr
    assert not out.exists()
    ends_well(dataset, out, expected)


def test_a_source_that_vanishes_midway(reference, tmp_path, monkeypatch):
    dataset, out, expected = reference
    slat, kept = dataset.root / "slat" / "b.npz", tmp_path / "b.npz"
    with monkeypatch.context() as context:
        inject(context, lambda *at: at == ("asset begun", "b") and slat.rename(kept))
        summary = build_store(dataset.parameters("pixie"), out)
    assert summary.statuses == {"ok": 2, "failed": 1, "skipped": 0}
    assert "b.npz: does not exist" in dict(summary.problems)["b"]
    kept.rename(slat)
    ends_well(dataset, out, expected)


@pytest.mark.parametrize(("mode", "told"), [
    (0o555, "locked (Permission denied); nothing was replaced"),
    (0o000, "s.zarr: cannot be looked at (Permission denied)"),
])  # fmt: skip
def test_a_target_that_permissions_keep(reference, tmp_path, mode, told):
    dataset, _, expected = reference
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(mode)
    done = Build(dataset, folder / "s.zarr", before=BOUND_BY_PERMISSIONS).done()
    folder.chmod(0o755)
    assert done.returncode == 1
    assert told in done.stderr and "Traceback" not in done.stderr
    ends_well(dataset, folder / "s.zarr", expected)


def test_the_second_of_two_builds_is_refused_and_told_of_the_first(reference, tmp_path):
    dataset, out, expected = reference
    sleeping = """
if step == "store created":
    time.sleep(600)
"""
    first = Build(dataset, out, sleeping)
    try:
        lock = tmp_path / ".s.zarr.work" / "lock"
        wait_until(lambda: lock.exists() and lock.read_text())
        told = rf"another build is writing it \(process {first.pid} on"
        with pytest.raises(StoreError, match=told):
            build_store(dataset.parameters("pixie"), out)
    finally:
        first.kill()
    assert lock.exists()  # A killed build leaves the file, but not the lock.
    ends_well(dataset, out, expected)


def test_workers_do_not_outlive_a_killed_build(reference, tmp_path):
    dataset, out, _ = reference
    pids = tmp_path / "pids"
    pids.mkdir()
    endless = f"""
if step == "asset begun":
    open(f"{pids}/{{os.getpid()}}", "w").close()
    time.sleep(600)
"""
    build = Build(dataset, out, endless, jobs=2)
    wait_until(lambda: len(list(pids.iterdir())) == 2)
    build.kill()
    workers = [Path("/proc", path.name) for path in pids.iterdir()]
    wait_until(lambda: not any(worker.exists() for worker in workers))


def test_a_few_kills_at_random_times(reference):
    """The short version of ``benchmarks/soak_kills.py``."""
    dataset, out, expected = reference
    build_store(dataset.parameters("pixie"), out)
    chance = random.Random(0)
    for turn in range(4):
        dataset.add("d", seed=turn)
        build = Build(dataset, out, jobs=2)
        time.sleep(chance.uniform(0.1, 1.0))  # A build takes that long.
        build.kill_all()
        stored = open_store(out)
        assert all(len(stored.asset(asset_id).coords) for asset_id in stored.ids)
    dataset.remove("d")
    ends_well(dataset, out, expected)

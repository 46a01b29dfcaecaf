"""Files and folders take their places at once, and nothing of other users is touched."""

import errno
import multiprocessing
import os
import shutil
from pathlib import Path

import pytest
from support.faults import no_room
from support.trees import copied, tree

from slatprep import ConfigError, StoreError, build_store, subset_store
from slatprep.pipeline.work import work_beside
from slatprep.storage import atomic
from slatprep.storage.atomic import staged, take_lock, writing


def test_a_write_that_a_disk_takes_in_part_is_told_as_a_full_disk():
    part = "1048576 requested and 480224 written"  # What numpy says; it gives no number.
    with pytest.raises(StoreError, match=f"{part}.*Make room there"), writing("x", Path("disk")):
        raise OSError(part)


def directory(path: Path, content: str) -> Path:
    path.mkdir()
    (path / "file").write_text(content)
    return path


@pytest.mark.parametrize("exchange", [True, False], ids=["exchanged", "renamed twice"])
def test_the_new_takes_the_olds_place(tmp_path, monkeypatch, exchange):
    if not exchange:
        monkeypatch.setattr(atomic, "_exchange", lambda new, target: False)
    target = directory(tmp_path / "store", "old")
    atomic.replace_directory(directory(tmp_path / "new", "new"), target)
    assert (target / "file").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


def test_a_new_that_does_not_exist_leaves_the_old(tmp_path):
    atomic.replace_directory(directory(tmp_path / "new", "old"), tmp_path / "store")
    with pytest.raises(OSError):
        atomic.replace_directory(tmp_path / "absent", tmp_path / "store")
    assert (tmp_path / "store" / "file").read_text() == "old"


MINE = "what somebody else wrote"


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    """A file of somebody else, in a folder of theirs."""
    (tmp_path / "theirs").mkdir()
    file = tmp_path / "theirs" / "notes.txt"
    file.write_text(MINE)
    return file


def refused(target: Path, fresh: bool = False) -> str:
    with pytest.raises(StoreError) as error, work_beside(target, fresh=fresh):
        pass
    return str(error.value)


AS_ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="gives something away")


@pytest.mark.parametrize(("how", "told"), [
    ("link", ".s.zarr.work: is no folder"),
    ("made by others", "holds notes.txt"),
    pytest.param("another user's", "belongs to user 12345", marks=AS_ROOT),
    ("spool is a link", "spool: is no folder"),
    ("spool is a file", "spool: is no folder"),
])  # fmt: skip
def test_a_work_folder_that_is_not_a_builds_own_is_refused(tmp_path, theirs, how, told):
    work = tmp_path / ".s.zarr.work"
    if how == "link":
        work.symlink_to(theirs.parent)
    else:
        work.mkdir()
    if how == "made by others":
        shutil.move(theirs, work)
        theirs = work / theirs.name
    elif how == "another user's":
        os.chown(work, 12345, 12345)
    elif "spool" in how:
        (work / "lock").touch()
        (work / "spool").touch() if "file" in how else (work / "spool").symlink_to(theirs.parent)
    assert told in refused(tmp_path / "s.zarr", fresh="spool" in how)
    assert theirs.read_text() == MINE


def test_what_is_not_a_builds_own_stays_in_its_folder(tmp_path):
    folder = tmp_path / ".s.zarr.work"
    (folder / "build-1").mkdir(parents=True)
    (folder / "lock").touch()
    (folder / "notes.txt").write_text(MINE)
    with work_beside(tmp_path / "s.zarr"):
        assert not (folder / "build-1").exists()
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


def test_nobody_else_may_enter_the_work_folder(tmp_path):
    with work_beside(tmp_path / "s.zarr") as work:
        assert work.scratch.parent.stat().st_mode & 0o077 == 0


def test_a_lock_that_is_a_link_or_holds_something_else_is_left_alone(tmp_path, theirs):
    (tmp_path / "lock").symlink_to(theirs)
    with pytest.raises(OSError, match="symbolic links"):
        take_lock(tmp_path / "lock", "taken")
    with pytest.raises(StoreError, match="holds something else than a lock"):
        take_lock(theirs, "taken")
    assert theirs.read_text() == MINE


def test_a_lock_in_a_folder_that_is_gone_is_not_looked_for_without_end(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(StoreError, match=r"lock: cannot be locked.* expected a folder that stays"):
        take_lock(Path("lock"), "taken")


def test_a_lock_that_cannot_be_taken_leaves_nothing_open(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "pwrite", no_room)
    (tmp_path / "deep").write_text("[" * 4096)
    before = len(list(Path("/dev/fd").iterdir()))
    with pytest.raises(StoreError, match="holds something else than a lock"):
        take_lock(tmp_path / "deep", "taken")
    with pytest.raises(OSError, match="No space left"):
        take_lock(tmp_path / "lock", "taken")
    assert len(list(Path("/dev/fd").iterdir())) == before


def write_report(folder: Path) -> None:
    with staged(folder / "r.html") as file:
        file.write_text("report")
    assert (folder / "r.html").read_text() == "report"


@pytest.mark.parametrize("whose", ["link", pytest.param("another user's", marks=AS_ROOT)])
def test_a_partial_file_that_is_not_ours_is_left_alone(tmp_path, theirs, whose):
    other = tmp_path / ".r.html.partial"
    if whose == "link":
        other.symlink_to(theirs)
    else:
        other.write_text(MINE)
        os.chown(other, 12345, 12345)
    write_report(tmp_path)
    assert (other.read_text(), theirs.read_text()) == (MINE, MINE)
    assert other.is_symlink() is (whose == "link") and not (tmp_path / "r.html").is_symlink()


def test_what_a_killed_process_left_is_replaced(tmp_path):
    (tmp_path / ".r.html.partial").write_text("a longer report, half of")
    write_report(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["r.html"]
    (tmp_path / "any").touch()
    assert (tmp_path / "r.html").stat().st_mode == (tmp_path / "any").stat().st_mode
    for _ in range(2):
        os.close(take_lock(tmp_path / "lock", "taken"))


def test_two_processes_that_write_one_file_each_write_it_whole(tmp_path):
    report = tmp_path / "r.html"

    def write_theirs() -> None:
        with staged(report) as file:
            file.write_text("theirs")

    with staged(report) as file, file.open("w") as ours:
        ours.write("ou")
        other = multiprocessing.get_context("fork").Process(target=write_theirs)
        other.start()
        other.join()
        assert (other.exitcode, report.read_text()) == (0, "theirs")
        ours.write("rs")
    assert report.read_text() == "ours"
    assert [path.name for path in tmp_path.iterdir()] == ["r.html"]


@pytest.mark.parametrize(
    ("code", "advice"), [(errno.ENOSPC, "Make room there"), (errno.EACCES, "may be written")]
)
def test_what_to_do_about_a_disk_depends_on_what_it_says(code, advice):
    with pytest.raises(StoreError, match=advice), writing("s.zarr", Path("/data")):
        raise OSError(code, os.strerror(code))


def test_a_full_disk_before_anything_is_written_is_told(tmp_path, monkeypatch):
    """Inodes may run out between the lock and the next folder."""
    monkeypatch.setattr("tempfile.mkdtemp", no_room)
    assert f"{tmp_path} (No space left" in refused(tmp_path / "s.zarr")


def test_what_others_have_beside_a_store_is_refused_before_any_work(undisturbed, tmp_path):
    parameters, out = undisturbed[0].parameters(), tmp_path / "s.zarr"
    folder, elsewhere = tmp_path / "s.manifests", tmp_path / "elsewhere"
    elsewhere.mkdir()
    files = "build.json", "assets.jsonl", "assets-00001.jsonl", "decoys.json"
    for name in (*files, "link", "store"):
        if name == "link":
            folder.symlink_to(elsewhere)
        elif name == "store":
            shutil.copytree(undisturbed[1], folder)
        else:
            folder.mkdir()
            (folder / name).write_text('{"mine": 1}\n')
        before = tree(tmp_path)
        told = rf"{name}.*not slatprep's" if name in files else f"is a {name}"
        with pytest.raises((StoreError, ConfigError), match=told):
            build_store(parameters, out)
        if name in files[:2]:
            with pytest.raises(StoreError, match=told):
                build_store(parameters, tmp_path / "o.zarr", manifests=folder)
        if name != "decoys.json":
            with pytest.raises((StoreError, ConfigError), match=r"s\.manifests"):
                subset_store(undisturbed[1], out, ["a"])
        assert tree(tmp_path) == before
        folder.unlink() if name == "link" else shutil.rmtree(folder)
    build_store(parameters, out)
    (folder / "assets-00001.jsonl").write_text('{"mine": 1}\n')
    shutil.rmtree(out)
    build_store(parameters, out)
    assert (folder / "assets-00001.jsonl").read_text() == '{"mine": 1}\n'


def test_two_stores_in_a_folder_do_not_share_records(undisturbed, tmp_path):
    """``s`` and ``s.zarr`` both have ``s.manifests`` by default."""
    parameters = undisturbed[0].parameters("pixie")
    first, second = copied(undisturbed[1], tmp_path / "s.zarr"), tmp_path / "s"
    records = (tmp_path / "s.manifests" / "build.json").read_bytes()
    told = r"s\.manifests: holds the records of .*s\.zarr; expected --manifests FOLDER"
    for named in (None, tmp_path / "s.manifests"):
        with pytest.raises(StoreError, match=told):
            build_store(parameters, second, manifests=named)
    with pytest.raises(StoreError, match=told):
        subset_store(first, second, ["a"])
    assert not second.exists()
    assert (tmp_path / "s.manifests" / "build.json").read_bytes() == records
    build_store(parameters, second, manifests=tmp_path / "other" / "records")
    names = {path.name for path in (tmp_path / "other" / "records").iterdir()}
    assert names == {"assets.jsonl", "build.json", "sources.seen"}
    assert (tmp_path / "s.manifests" / "build.json").read_bytes() == records
    build_store(parameters, first)


@pytest.mark.parametrize("beside", [False, True], ids=["alone", "beside one of its old name"])
def test_records_of_a_store_that_was_renamed_with_them_stay_its_own(undisturbed, tmp_path, beside):
    """They call it ``s.zarr``."""
    renamed = copied(undisturbed[1], tmp_path / "new.zarr")
    if beside:
        copied(undisturbed[1], tmp_path / "s.zarr")
    build_store(undisturbed[0].parameters(), renamed)
    assert b'"new.zarr"' in (tmp_path / "new.manifests" / "build.json").read_bytes()
    assert not beside or b'"s.zarr"' in (tmp_path / "s.manifests" / "build.json").read_bytes()

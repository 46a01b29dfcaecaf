"""A state of a file counts only where every later change of the file changes it."""

from __future__ import annotations

import mmap
import os
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from slatprep.storage import states
from slatprep.storage.states import States, keeps_times, lasting_state, note, noting, reading

MOUNTS = """\
22 27 0:21 / /proc rw,relatime - proc proc rw
27 1 254:0 / / rw,relatime shared:1 - ext4 /dev/vda rw,discard
30 27 7:3 / /data/image rw,relatime - ext4 /dev/loop3 rw
31 27 7:4 / /data/old ro,relatime - squashfs /dev/loop4 ro,errors=continue
32 27 254:1 / /data/kept ro,relatime - ext4 /dev/vdb ro
33 27 254:0 /some /data/bound ro,relatime - ext4 /dev/vda rw,discard
34 27 0:40 / /data/far rw,relatime shared:2 master:1 - nfs4 host:/data rw,vers=4.2
35 27 0:41 / /data/near rw - fuse.sshfs host: rw,user_id=0
36 27 0:42 / / rw,relatime - overlay overlay rw,lowerdir=/l,upperdir=/u,workdir=/w
37 27 0:43 / /dev/shm rw - tmpfs tmpfs rw
38 27 254:2 / /with\\040space rw - xfs /dev/vdc rw,attr2
39 27 0:44 /@home /home rw - btrfs /dev/vdd rw,subvol=/@home
40 27 0:45 / /mnt/c rw - 9p drvfs rw,dirsync
41 27 254:3 / /cd ro - iso9660 /dev/sr0 ro
42 27 254:4 / /system ro - erofs /dev/vde ro
"""

COUNTS = {27, 33, 38, 39}
"""A disk that can be written, also where it is bound elsewhere for reading."""


@pytest.fixture
def on_a_disk(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """Give a folder where states count, even if temporary files lie in memory."""
    with TemporaryDirectory(dir=request.config.rootpath, prefix=".tests-") as beside:
        for folder in (tmp_path, Path(beside)):
            (folder / "probe").touch()
            if States().of(str(folder / "probe")) is not None:
                yield folder
                return
    pytest.skip("neither temporary files nor the checkout lie where a state counts")


def lasting(path: Path) -> states.State | None:
    with path.open("rb") as file:
        return lasting_state(file.fileno())


def written(path: Path, content: bytes = b"content") -> Path:
    """Write a file, and wait until its state can be told from a later one."""
    path.write_bytes(content)
    time.sleep(2 * states.FINE_NS / 1e9)
    return path


def test_only_disks_that_are_listed_and_can_be_written_keep_times():
    numbers = [int(line.split()[0]) for line in MOUNTS.splitlines()]
    assert {number for number in [2, *numbers] if keeps_times(MOUNTS, number)} == COUNTS
    assert not keeps_times("", 27)


def test_without_proc_no_state_counts(on_a_disk, monkeypatch):
    path = written(on_a_disk / "a")

    def lacking(self: Path, **_: object) -> str:
        raise FileNotFoundError(2, "No such file or directory", str(self))

    monkeypatch.setattr(Path, "read_text", lacking)
    assert States().of(str(path)) is None


def test_a_state_is_what_the_system_says(on_a_disk):
    path = written(on_a_disk / "a")
    state, told = States().of(str(path)), path.stat()
    assert state is not None
    assert (state.inode, state.size) == (told.st_ino, told.st_size)
    assert (state.modified, state.changed) == (told.st_mtime_ns, told.st_ctime_ns)
    assert os.makedev(*state.device) == told.st_dev
    assert lasting(path) == state


def test_what_is_no_file_has_no_state(on_a_disk):
    os.mkfifo(on_a_disk / "pipe")
    for path in ("", "pipe", "nothing", "probe\0", "/dev/null"):
        assert States().of(path if path[:1] == "/" else f"{on_a_disk}/{path}") is None


def test_a_file_that_was_written_just_now_has_no_lasting_state(on_a_disk, monkeypatch):
    # However slow this machine is.
    monkeypatch.setattr(states, "FINE_NS", 10**15)
    (on_a_disk / "a").write_bytes(b"content")
    assert lasting(on_a_disk / "a") is None and States().of(str(on_a_disk / "a")) is not None


@pytest.mark.parametrize("how", ["open", "appending", "mapped", "mapped and closed", "hard link"])
def test_a_file_that_somebody_may_write_has_no_lasting_state(on_a_disk, how):
    path = written(on_a_disk / "a")
    os.link(path, on_a_disk / "b")
    time.sleep(2 * states.FINE_NS / 1e9)
    assert lasting(path) is not None
    other = on_a_disk / "b" if how == "hard link" else path
    with other.open("ab" if how == "appending" else "r+b") as file:
        held = mmap.mmap(file.fileno(), 0) if "mapped" in how else None
        if how == "mapped and closed":
            file.close()
        assert lasting(path) is None
        if held:
            held.close()
    assert lasting(path) is not None
    with path.open("rb"):  # who reads, may
        assert lasting(path) is not None


def test_a_mapping_that_is_made_later_changes_the_state(on_a_disk):
    path = written(on_a_disk / "a")
    before = lasting(path)
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as held:
        held[0] = 65
        assert States().of(str(path)) != before


@pytest.mark.parametrize("how", ["written", "renamed over", "link", "folder"])
def test_what_is_exchanged_while_it_is_read_is_noted_as_it_was_read(on_a_disk, how):
    folders = [on_a_disk / name for name in ("one", "two")]
    for folder in folders:
        folder.mkdir()
        written(folder / "a", folder.name.encode())
    (on_a_disk / "link").symlink_to("one")
    path = on_a_disk / ("link/a" if how == "link" else "one/a")
    with noting() as noted, path.open("rb") as file, reading(file.fileno(), "a"):
        if how == "written":
            path.write_bytes(b"ONE")
        elif how == "renamed over":
            (folders[1] / "a").rename(path)
        elif how == "link":
            (on_a_disk / "link").unlink()
            (on_a_disk / "link").symlink_to("two")
        else:
            folders[0].rename(on_a_disk / "kept")
            folders[1].rename(folders[0])
        file.read()
    assert noted["a"] is None or noted["a"] != States().of(str(path))
    assert list(noted) == ["a"]


def test_what_was_read_twice_must_have_been_the_same():
    state = states.State(1, (1, 1), 1, 1, 1, 1)
    with noting() as noted:
        note("same", state)
        note("same", state)
        note("other", state)
        note("other", state._replace(inode=2))
        note("unknown", None)
        note("unknown", state)
    assert noted == {"same": state, "other": None, "unknown": None}
    note("later", state)  # nobody asks any more
    assert "later" not in noted

"""What tells whether a file was changed since it was read, and where nothing can.

The state of a file is its mount, inode and size, and the times at which its content and its inode
changed. It proves that the content is the same only where the system sets these times at each
change. So a state counts where all of this holds:

- The file system sets both times itself, lies on a disk of this machine and can be written. An
  image that is mounted read-only has the times that it was made with, and what lies on a network
  is changed elsewhere.
- The mount is the same. Another disk may hold the same inode, size and times.
- Nobody had the file open for writing when its reading began. Of the writes to a page of a
  mapping, only the first changes the times.
- It was not written so shortly before that a later change could leave the same times, as in git.

A file is read, and its state taken, through one descriptor: neither a link nor a folder that is
exchanged meanwhile can part them. Systems other than Linux do not tell enough, so that no state
counts there.
"""

from __future__ import annotations

import ctypes
import os
import signal
import stat
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

FINE_NS, COARSE_NS = 100_000_000, 2_000_000_000
"""How long before a look a file must have been written. File systems with times in nanoseconds
stamp by the clock's tick, 10 ms at most; where times are rounder, the roughest, FAT, has 2 s."""

_KEEPING = {"ext2", "ext3", "ext4", "xfs", "btrfs", "f2fs"}
"""File systems that set the times at the first write to each page of a mapping, too."""

_LOOP = "7"
"""Major number of disks that are files."""

# From linux/stat.h and linux/fcntl.h: `os.stat` does not tell the mount.
_BASIC, _MOUNT, _UNIQUE_MOUNT = 0x7FF, 0x1000, 0x4000
_HERE, _EMPTY_PATH = -100, 0x1000
_STATX, _STATX_BYTES = struct.Struct("=I24xH2xQQ48xqI4xqI12xIIQ"), 256


class State(NamedTuple):
    """State of a file; times in nanoseconds."""

    mount: int
    device: tuple[int, int]
    inode: int
    size: int
    modified: int
    changed: int


Noted = tuple[object, ...] | None
"""What is noted of a file that was read: its state, or what tells a member of an archive."""


class States:
    """Looks at states of files; whether those of a mount count is asked once."""

    def __init__(self) -> None:
        self._counts: dict[int, bool] = {}
        self.noted: dict[str, Noted] = {}

    def of(self, file: str | int) -> State | None:
        """Return the state of a file, by path or descriptor; None where it does not count.

        The file may have been written just now, and be open for writing.
        """
        found = _statx(file)
        if found is None:
            return None
        if found.mount not in self._counts:
            listed = _statx(file, _BASIC | _MOUNT)
            mounts = Path("/proc/self/mountinfo").read_text(errors="replace")
            self._counts[found.mount] = listed is not None and keeps_times(mounts, listed.mount)
        return found if self._counts[found.mount] else None


def keeps_times(mountinfo: str, mount: int) -> bool:
    """Whether every change of a file on a mount changes the file's times.

    `mountinfo` is the text of ``/proc/self/mountinfo``, `mount` a number at the start of a line.
    """
    for line in mountinfo.splitlines():
        place, _, system = line.partition(" - ")
        number, _, device = place.split(" ")[:3]
        if number == str(mount):
            kind, *_, options = system.split(" ")
            local = kind in _KEEPING and device.partition(":")[0] != _LOOP
            return local and "rw" in options.split(",")  # of the file system, not of the mount
    return False


@lru_cache(maxsize=1)
def boot_id() -> str:
    """Return what tells this run of the machine, in which alone numbers of mounts hold."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def is_old(modified_ns: int, changed_ns: int) -> bool:
    """Whether a change from now on gives a file other times than these."""
    newest = max(modified_ns, changed_ns)
    return newest + (FINE_NS if newest % 1_000_000 else COARSE_NS) <= time.time_ns()


def wait_until_old() -> None:
    """Wait until what was written before is old, where times are fine."""
    time.sleep(FINE_NS / 1e9)


_noting: ContextVar[States | None] = ContextVar("noting", default=None)


def lasting_state(descriptor: int) -> State | None:
    """Return the state of an open file that every later change will change; None if none will."""
    if not _nobody_writes(descriptor):
        return None
    state = (_noting.get() or States()).of(descriptor)
    return state if state and is_old(state.modified, state.changed) else None


@contextmanager
def noting() -> Iterator[dict[str, Noted]]:
    """Collect the states of files as they are read meanwhile, by name; None where none counts."""
    states = States()
    token = _noting.set(states)
    try:
        yield states.noted
    finally:
        _noting.reset(token)


@contextmanager
def reading(descriptor: int, name: str) -> Iterator[None]:
    """Note under a name the state of an open file, unless it is another when it has been read."""
    if _noting.get() is None:
        yield
        return
    before = lasting_state(descriptor)
    yield
    note(name, before if before == _statx(descriptor) else None)


def note(name: str, state: Noted) -> None:
    """Note the state of what was read; of what was read twice, if it is the same."""
    if states := _noting.get():
        states.noted[name] = state if states.noted.get(name, state) == state else None


def _nobody_writes(descriptor: int) -> bool:
    """Whether no process has a file open for writing, or mapped; False where it cannot be told.

    The system refuses a lease for reading where one has. It gives leases to the file's owner and
    to root alone.
    """
    if sys.platform != "linux":
        return False
    import fcntl

    try:
        # Whoever opens the file meanwhile waits for its end, and we get a signal that is ignored.
        fcntl.fcntl(descriptor, fcntl.F_SETSIG, signal.SIGURG)
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_RDLCK)
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    except OSError:
        return False
    return True


def _statx(file: str | int, mask: int = _BASIC | _MOUNT | _UNIQUE_MOUNT) -> State | None:
    """Ask for the state of a regular file; None where the system does not tell it."""
    call, buffer = _statx_call(), ctypes.create_string_buffer(_STATX_BYTES)
    name = b"" if isinstance(file, int) else os.fsencode(file)
    where, flags = (file, _EMPTY_PATH) if isinstance(file, int) else (_HERE, 0)
    if call is None or b"\0" in name or call(where, name, flags, mask, buffer) != 0:
        return None
    told, mode, inode, size, *times, major, minor, mount = _STATX.unpack_from(buffer)
    if not (stat.S_ISREG(mode) and told & (_MOUNT | _UNIQUE_MOUNT)):
        return None
    changed, modified = (times[k] * 10**9 + times[k + 1] for k in (0, 2))
    return State(mount, (major, minor), inode, size, modified, changed)


@lru_cache(maxsize=1)
def _statx_call() -> Callable[..., Any] | None:
    try:
        return ctypes.CDLL(None).statx if sys.platform == "linux" else None
    except AttributeError:  # an old C library
        return None

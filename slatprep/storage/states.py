"""Tell whether a file was changed since it was read, if that can be told.

The state of a file is its mount, inode and size, and the times at which its content and its inode
changed. An equal state proves equal content only if the system sets these times at each change. So
a state counts only if all of this holds:

- The file system sets both times itself, lies on a disk of this machine and can be written. A
  read-only image keeps the times at which it was made, and files on a network are changed
  elsewhere.
- The mount is the same. Another disk may hold the same inode, size and times.
- Nobody had the file open for writing when its reading began. Only the first write to a page of a
  mapping changes the times.
- The file was not written just before, as a later change could leave the same times. Git has this
  problem too.

Content and state are read through one descriptor, so they belong together even if a link or folder
is exchanged meanwhile. Systems other than Linux do not tell enough, so no state counts there.
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
"""Least age [ns] of a file's times, if they are fine or coarse. Fine times, in nanoseconds, follow
the clock's tick, 10 ms at most. The coarsest times, those of FAT, have steps of 2 s."""

_KEEPING = {"ext2", "ext3", "ext4", "xfs", "btrfs", "f2fs"}
"""File systems that also set the times at the first write to each page of a mapping."""

_LOOP = "7"
"""Major number of loop devices, which are disks in files."""

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
"""Note on a file that was read: its state, or values that identify a member of an archive."""


class States:
    """Reads states of files; checks only once whether those of a mount count."""

    def __init__(self) -> None:
        self._counts: dict[int, bool] = {}
        self.noted: dict[str, Noted] = {}

    def of(self, file: str | int) -> State | None:
        """Return the state of a file, by path or descriptor; None if its mount does not count.

        The file may have been written just before, or be open for writing.
        """
        if (found := _statx(file)) is None:
            return None
        if found.mount not in self._counts:
            listed = _statx(file, _BASIC | _MOUNT)
            mounts = system_text("/proc/self/mountinfo")  # Not every sandbox has /proc.
            self._counts[found.mount] = listed is not None and keeps_times(mounts, listed.mount)
        return found if self._counts[found.mount] else None


def keeps_times(mountinfo: str, mount: int) -> bool:
    """Return whether every change of a file on a mount changes the file's times.

    `mountinfo` is the text of ``/proc/self/mountinfo``, `mount` a number at the start of a line.
    """
    for line in mountinfo.splitlines():
        place, _, system = line.partition(" - ")
        number, _, device = place.split(" ")[:3]
        if number == str(mount):
            kind, *_, options = system.split(" ")
            local = kind in _KEEPING and device.partition(":")[0] != _LOOP
            return local and "rw" in options.split(",")  # options of the system, not the mount
    return False


@lru_cache(maxsize=1)
def boot_id() -> str:
    """Return the id of the machine's current boot; numbers of mounts hold only within it."""
    return system_text("/proc/sys/kernel/random/boot_id").strip()


def system_text(path: str) -> str:
    """Return what a file of the system says; empty if it cannot be read."""
    try:
        return Path(path).read_text(errors="replace")
    except OSError:
        return ""


def is_old(modified_ns: int, changed_ns: int) -> bool:
    """Return whether any change from now on gives a file other times than these [ns]."""
    newest = max(modified_ns, changed_ns)
    return newest + (FINE_NS if newest % 1_000_000 else COARSE_NS) <= time.time_ns()


def wait_until_old() -> None:
    """Wait until files written before this call are old, if their times are fine."""
    time.sleep(FINE_NS / 1e9)


_noting: ContextVar[States | None] = ContextVar("noting", default=None)


def lasting_state(descriptor: int) -> State | None:
    """Return the state of an open file if every later change will alter it, else None."""
    if not _nobody_writes(descriptor):
        return None
    state = (_noting.get() or States()).of(descriptor)
    return state if state and is_old(state.modified, state.changed) else None


@contextmanager
def noting() -> Iterator[dict[str, Noted]]:
    """Collect the states of files that are read meanwhile, by name; None if a state is no proof."""
    states = States()
    token = _noting.set(states)
    try:
        yield states.noted
    finally:
        _noting.reset(token)


@contextmanager
def reading(descriptor: int, name: str) -> Iterator[None]:
    """Note the state of an open file under a name; note None if it changes during reading."""
    if _noting.get() is None:
        yield
        return
    before = lasting_state(descriptor)
    yield
    note(name, before if before == _statx(descriptor) else None)


def note(name: str, state: Noted) -> None:
    """Note the state of a file under a name; note None if an earlier reading had another state."""
    if states := _noting.get():
        states.noted[name] = state if states.noted.get(name, state) == state else None


def _nobody_writes(descriptor: int) -> bool:
    """Return whether no process has a file open for writing, or mapped; False if unknown.

    The system refuses a lease for reading if a process has. It gives leases only to the file's
    owner and to root.
    """
    if sys.platform != "linux":
        return False
    import fcntl

    try:
        # A process that opens the file meanwhile waits for the lease's end; our signal is ignored.
        fcntl.fcntl(descriptor, fcntl.F_SETSIG, signal.SIGURG)
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_RDLCK)
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    except OSError:
        return False
    return True


def _statx(file: str | int, mask: int = _BASIC | _MOUNT | _UNIQUE_MOUNT) -> State | None:
    """Return the state of a regular file; None if the system does not tell it."""
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

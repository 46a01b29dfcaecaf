"""Write files and directories that nobody may see half done: exchange, stage, lock.

A new directory replaces an old one in one step if the system can do that, after all of it is on the
disk. After a power failure, either the old one or the new one is there and complete. A lock ends
with its holder, however the holder ends.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import secrets
import shutil
import stat
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import orjson

from slatprep.errors import StoreError
from slatprep.storage.faults import reached
from slatprep.storage.files import OWN_FILE, is_at, is_only_ours, locks_alone

if TYPE_CHECKING:
    from slatprep.records import Place

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


def replace_directory(new: Path, target: Path) -> None:
    """Move the directory `new` to `target` on the same file system, then remove the old one.

    On Linux one system call exchanges them, so a reader finds the old or the new one complete at
    every moment. Elsewhere, two renames leave a short moment without either; `restore_directory`
    repairs a kill at that moment. OSError if the move fails; `target` is then unchanged.
    """
    flush_tree(new)
    reached("directory flushed", str(target))
    old = _aside(new.parent)
    if not target.exists():
        new.rename(target)
    elif _exchange(new, target):
        old = new
    else:
        target.rename(old)
        try:
            new.rename(target)
        except OSError:
            old.rename(target)
            raise
    flush(target.parent)
    reached("directory exchanged", str(target))
    if old.exists():
        shutil.rmtree(old, ignore_errors=True)  # The caller removes the work folder with any rest.


def restore_directory(work: Path, target: Path) -> None:
    """Restore `target` from below `work` after a kill between `replace_directory`'s renames."""
    for scratch in sorted(work.glob("*")):
        if _aside(scratch).exists() and not target.exists():
            _aside(scratch).rename(target)


def flush_tree(directory: Path) -> None:
    """Flush every file below a directory, and all directories' names, to the disk."""
    for parent, _, files in os.walk(directory, topdown=False):
        for name in files:
            flush(Path(parent, name))
        flush(Path(parent))


def flush(path: Path) -> None:
    """Flush a file's content, or a directory's names, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _aside(scratch: Path) -> Path:
    return scratch / "previous"


def _exchange(new: Path, target: Path) -> bool:
    """Exchange two directories atomically; return False if the system cannot."""
    if sys.platform != "linux":
        return False
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if renameat2 is None:
        return False
    result = renameat2(
        _AT_FDCWD, os.fsencode(new), _AT_FDCWD, os.fsencode(target), _RENAME_EXCHANGE
    )
    return int(result) == 0


@contextmanager
def staged(path: Path) -> Iterator[Path]:
    """Yield a file beside `path` that replaces it, complete and on disk, unless an error occurs.

    Its name is always the same, so the next process reuses the file that a killed process left. If
    a link, another user's file or a running process's file has that name, another name is used.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary, held = _claimed(path)
    try:
        yield temporary
        flush(temporary)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    finally:
        os.close(held)
    flush(path.parent)


def _claimed(path: Path) -> tuple[Path, int]:
    """Return an empty file beside a path, and a descriptor that locks it against `staged`."""
    temporary = path.with_name(f".{path.name}.partial")
    with suppress(OSError):
        held = os.open(temporary, os.O_WRONLY | OWN_FILE, 0o666)
        try:
            if is_only_ours(os.fstat(held)) and locks_alone(held) and is_at(held, temporary):
                os.ftruncate(held, 0)
                return temporary, os.dup(held)
        finally:
            os.close(held)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.partial")
    return temporary, os.open(temporary, os.O_WRONLY | os.O_EXCL | OWN_FILE, 0o666)


@contextmanager
def staged_apart(path: Path, folder: Path) -> Iterator[Path]:
    """Yield a file in `folder` that replaces `path`, complete, unless an error occurs.

    Unlike in `staged`, the file is not flushed. Its name is new each time, because a worker that
    outlives a killed build, or that a cluster has given up, may write the same file. Folders are
    not created, because such a worker must not bring back removed folders.
    """
    temporary = folder / f"{secrets.token_hex(16)}.partial"
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def telling_if_stopped(told: list[str]) -> Iterator[None]:
    """Make a KeyboardInterrupt say what is in `told` by then: in which state the old may be."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(*told) from None


@contextmanager
def writing(what: str, where: Place) -> Iterator[None]:
    """Turn an OSError of a disk or object store into a StoreError that names what was written."""
    try:
        yield
    except OSError as error:
        # numpy gives no number if a disk takes only a part of an array.
        full = error.errno in (None, errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        advice = "Make room there" if full else "Name a place that may be written"
        raise StoreError(
            f"{what}: cannot be written to {where} ({error.strerror or error}); nothing was "
            f"replaced. {advice}, and run again"
        ) from error


_TRIES = 100
"""Number of attempts to lock a file that its holder removes meanwhile."""


def take_lock(path: Path, taken: str) -> int:
    """Return a descriptor that holds a lock until it is closed or the process ends.

    The file and its folder are created; the holder may remove the file. StoreError if another
    process holds the lock: its text is `taken`, such as ``STORE: another build is writing it``,
    with that process. StoreError also if the file is no lock, or its folder vanishes. OSError if
    the file cannot be written, or is a link.
    """
    if sys.platform == "win32":
        raise StoreError(
            f"{path}: cannot be locked, as Windows has no flock; expected Linux or macOS "
            "(on Windows, the Linux subsystem WSL)"
        )
    for _ in range(_TRIES):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(path, os.O_RDWR | OWN_FILE, 0o666)
        except FileNotFoundError:
            continue  # The holder before us has just removed its folder.
        with ExitStack() as unless_held:
            unless_held.callback(os.close, descriptor)
            if not locks_alone(descriptor):
                who = _holder(descriptor) or "which has only just begun"
                raise StoreError(
                    f"{taken} ({who}); wait until it has ended, or choose another path"
                )
            if not is_at(descriptor, path):
                continue  # The locked file has been removed; lock the file that is there now.
            _sign(descriptor, path)
            unless_held.pop_all()
            return descriptor
    raise StoreError(
        f"{path}: cannot be locked, as it or its folder was removed {_TRIES} times meanwhile; "
        "expected a folder that stays (is the current one deleted?). Choose another path"
    )


def _sign(descriptor: int, path: Path) -> None:
    """Write this process into a lock as its holder."""
    state = os.fstat(descriptor)
    if not stat.S_ISREG(state.st_mode) or (state.st_size and not _holder(descriptor)):
        raise StoreError(
            f"{path}: holds something else than a lock; move it away, or choose another path"
        )
    os.ftruncate(descriptor, 0)
    told = {
        "pid": os.getpid(),
        "host": platform.node(),
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    os.pwrite(descriptor, orjson.dumps(told), 0)


def _holder(descriptor: int) -> str:
    """Return the process that a lock names as its holder, or ""."""
    try:
        told = orjson.loads(os.pread(descriptor, 4096, 0))
        return f"process {told['pid']} on {told['host']}, since {told['since']}"
    except (ValueError, TypeError, LookupError, OSError):
        return ""

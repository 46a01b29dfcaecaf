"""The folder beside a result in which it is made: one build at a time, and resumable.

``.NAME.work`` lies beside NAME, on its file system. It holds the lock, the
spool of finished assets and what this build alone writes. A build that is
killed leaves it; the next one to the same target removes all but the spool
and goes on from there.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.pipeline.spool import Spool
from slatprep.records import Place
from slatprep.storage.atomic import restore_directory
from slatprep.storage.place import storage_of


@dataclass(frozen=True)
class Work:
    """Where a build works.

    Attributes
    ----------
    spool : Spool
        Finished assets; outlives a build that is interrupted.
    scratch : Path
        A folder of this build alone, with a name that no other build had.
    """

    spool: Spool
    scratch: Path


@contextmanager
def work_beside(
    target: Place, *, arrays: bool = True, fresh: bool = False, keep: bool = False
) -> Iterator[Work]:
    """Make the work folder of a target, hold its lock, and clean up.

    Parameters
    ----------
    target : Place
        What is to be made or replaced.
    arrays : bool
        Whether the spool keeps arrays, or records alone.
    fresh : bool
        Begin with an empty spool.
    keep : bool
        Keep the spool after success as well.

    Raises
    ------
    StoreError
        If the folder cannot be written, or another build has the lock; the
        message names that build.
    """
    directory = work_directory(target)
    try:
        lock = _locked(directory, target)
    except OSError as error:
        raise StoreError(
            f"{directory.parent}: cannot write there ({error.strerror}); "
            "expected a folder for the result and for temporary files"
        ) from error
    finished = False
    spool = Spool(directory / "spool", arrays)
    try:
        _restore(directory, target)
        _remove(directory, but=("lock", "spool"))
        spool.directory.mkdir(exist_ok=True)
        if fresh:
            spool.keep_only(set())
        yield Work(spool, Path(tempfile.mkdtemp(prefix="build-", dir=directory)))
        finished = True
    finally:
        _restore(directory, target)
        if (finished and not keep) or not spool.holds_any():
            shutil.rmtree(directory, ignore_errors=True)
        else:
            _remove(directory, but=("lock", "spool"))
        os.close(lock)


def work_directory(target: Place) -> Path:
    """Return the work folder of a target: beside it, or in the cache if it is on no local disk."""
    return storage_of(target).work_folder()


def _restore(directory: Path, target: Place) -> None:
    local = storage_of(target).local
    if local is not None:
        restore_directory(directory, local)


def _locked(directory: Path, target: Place) -> int:
    """Return a descriptor that holds the lock until it is closed, if only by a kill."""
    import fcntl  # No such module on Windows, where `--help` must work all the same.

    while True:
        directory.mkdir(parents=True, exist_ok=True)
        path = directory / "lock"
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except FileNotFoundError:
            continue  # The build before us has just removed its folder.
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, 4096, 0)
            os.close(descriptor)
            raise StoreError(_refusal(target, holder)) from None
        if _is_at(descriptor, path):
            break
        os.close(descriptor)  # What we locked has been removed; lock what is there now.
    os.ftruncate(descriptor, 0)
    told = {
        "pid": os.getpid(),
        "host": platform.node(),
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    os.pwrite(descriptor, json.dumps(told).encode(), 0)
    return descriptor


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _refusal(target: Place, holder: bytes) -> str:
    try:
        told = json.loads(holder)
        who = f"process {told['pid']} on {told['host']}, since {told['since']}"
    except (ValueError, KeyError, TypeError):
        who = "which has only just begun"
    return (
        f"{target}: another build is writing it ({who}); wait until it has ended, "
        "or choose another path"
    )


def _remove(directory: Path, but: tuple[str, ...]) -> None:
    for path in directory.iterdir():
        if path.name in but:
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)

"""The folder beside a result in which it is made: one build at a time, and resumable.

``.NAME.work`` lies beside NAME, on its file system. It holds the lock, the
spool of finished assets and what this build alone writes. A build that is
killed leaves it; the next one to the same target removes all but the spool
and goes on from there.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.pipeline.spool import Spool
from slatprep.records import Place
from slatprep.storage.atomic import restore_directory
from slatprep.storage.lock import take_lock
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
        lock = take_lock(directory / "lock", f"{target}: another build is writing it")
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


def _remove(directory: Path, but: tuple[str, ...]) -> None:
    for path in directory.iterdir():
        if path.name in but:
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)

"""The work folder beside a result, for one process at a time.

``.NAME.work`` lies beside NAME, on its file system. It holds the lock, a folder of this process
alone, and what a build keeps. A killed process leaves it; the next one removes its files. If others
may write beside NAME, something else may lie there under that name. So a process takes only a
folder that this user's slatprep made, and removes from it only what slatprep makes.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.records import Place
from slatprep.storage.atomic import restore_directory, take_lock, writing
from slatprep.storage.faults import reached
from slatprep.storage.place import storage_of
from slatprep.storage.versions import BUILDER, SPOOL

LOCK, _PREFIX = "lock", "build-"


@contextmanager
def scratch_beside(
    target: Place, who: str, clear: Callable[[], object] = lambda: None
) -> Iterator[Path]:
    """Hold the lock of a target's work folder, and yield a new folder in it; clean up.

    `clear` is called at the end, with the lock held, and the folder then goes if it is empty.
    `who` works there, in a word. StoreError if the folder cannot be written or is not slatprep's,
    or another process has the lock; it names that one.
    """
    place, lock = storage_of(target), None
    directory = place.work_folder()
    try:
        with writing(str(target), directory.parent):
            _claim(directory)
            reached("work folder made", directory.name)
            lock = take_lock(directory / LOCK, f"{target}: another {who} is writing it")
            reached("work folder locked", directory.name)
            _tidy(directory, place.local)
            scratch = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=directory))
        yield scratch
    except KeyboardInterrupt:
        if lock is None:
            with suppress(OSError):  # Not empty if another process left it, or has the lock.
                directory.rmdir()
        raise
    finally:
        if lock is not None:
            try:
                _tidy(directory, place.local)
                clear()
                _leave(directory)
            finally:
                os.close(lock)


def _leave(directory: Path) -> None:
    """Remove an empty spool, and the folder, unless an interrupted build left assets or marks."""
    spool = directory / SPOOL
    if any(spool.glob("*/*.arrays")):
        return
    shutil.rmtree(spool, ignore_errors=True)
    if not any(directory.glob(f"{BUILDER}-*")):
        # The lock goes last, because a folder without a lock does not count as ours.
        (directory / LOCK).unlink(missing_ok=True)
    with suppress(OSError):  # It may hold somebody's files, or the next process's lock.
        directory.rmdir()


def refusal(path: Path, what: str) -> StoreError:
    """Return the error that a work folder, or what is in it, is not slatprep's."""
    return StoreError(
        f"{path}: {what}; expected a work folder of slatprep, or nothing. Move it away, or choose "
        "another path for the result"
    )


def _claim(directory: Path) -> None:
    """Make the work folder for this user alone, or check that this user's slatprep made it."""
    directory.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        directory.mkdir(mode=0o700)
    # Not by our user id, because our files on a network file system may have another owner.
    # The file has no name if the system can do that, so a signal leaves nothing behind.
    with tempfile.TemporaryFile(dir=directory.parent) as ours:
        owner = os.fstat(ours.fileno()).st_uid
    # If it is gone, a build has just ended there, and taking the lock makes the folder again.
    _require_ours(directory, owner)


def require_work_folder(target: Place) -> None:
    """Raise StoreError if something else has the place of a target's work folder; write nothing."""
    directory = storage_of(target).work_folder()
    with writing(str(target), directory.parent):
        _require_ours(directory)


def _require_ours(directory: Path, owner: int | None = None) -> None:
    """Raise StoreError unless a folder is this user's slatprep's, or is not there."""
    try:
        state = directory.lstat()
        if not stat.S_ISDIR(state.st_mode):
            raise refusal(directory, "is no folder")
        if owner is not None and state.st_uid != owner:
            raise refusal(directory, f"belongs to user {state.st_uid}")
        names = {path.name for path in directory.iterdir()}
    except FileNotFoundError:
        return
    if names and LOCK not in names:
        raise refusal(directory, f"holds {min(names)} and was not made by a build")


def _tidy(directory: Path, target: Path | None) -> None:
    """Restore the target from what a killed process moved aside, then remove its folders."""
    if target is not None:
        restore_directory(directory, target)
    for path in directory.glob(f"{_PREFIX}*"):
        shutil.rmtree(path, ignore_errors=True)

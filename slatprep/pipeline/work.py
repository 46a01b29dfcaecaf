"""The work folder beside a result: for one build at a time, and resumable.

``.NAME.work`` lies beside NAME, on its file system. It holds the lock, the
spool of finished assets and the files of this build alone. A killed build
leaves it. The next build to the same target removes all but the spool, and
goes on from there. If others may write beside NAME, something else may lie
there under that name. So a build takes only a folder that a build of this
user made, and removes from it only what builds make.

If workers have disks of their own and the store belongs on an object store,
the spool and the version that they write lie below the store's URL. The work
folder then holds only what the command itself writes. The lock does not keep
out builds on other machines. So each build marks the spool while it works, and
removes finished assets only if no other build's mark is there. A killed build
leaves its mark; the next build from the same work folder takes it over.
"""

from __future__ import annotations

import os
import platform
import secrets
import shutil
import stat
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.pipeline.spool import Spool
from slatprep.records import Place
from slatprep.storage.atomic import restore_directory, take_lock, writing
from slatprep.storage.faults import reached
from slatprep.storage.place import storage_of
from slatprep.storage.versions import BUILDER, SPOOL, is_spooled, new_version

LOCK, _PREFIX = "lock", "build-"


@dataclass(frozen=True)
class Work:
    """The places in which a build works.

    The `spool` of finished assets outlives an interrupted build. `scratch` is a folder of this
    build alone, with a name that no other build had. Workers write the shards of the new store
    below `shards`. `mark` is the name of the object that marks a spool below a store as in use by
    this build; for other spools it is empty.
    """

    spool: Spool
    scratch: Path
    shards: Place
    mark: str = ""

    def shared(self) -> Place:
        """Make a place that all workers must see, and return it; StoreError if that fails."""
        if not self.mark:
            return self.scratch
        place = self.spool.directory / self.mark
        with writing(str(place.parent.parent), place), storage_of(place).staged() as file:
            file.write_text(f"process {os.getpid()} on {platform.node()}\n")
        return place

    def keep_only(self, keys: set[str]) -> bool:
        """Remove all assets but these, and the mark, from the spool; return False if that fails.

        A failure is only a warning: the store is complete, and the next build will try again.
        """
        try:
            others = self.spool.keep_only(keys, self.mark)
        except (OSError, StoreError) as error:
            self._warn(f"could not be removed ({error})")
            return False
        if others:
            self._warn(
                f"were kept, as another build may need them; {others[0]} there tells which. "
                "If that was killed, remove that object, and the next build removes the rest"
            )
        return True

    def unmark(self) -> bool:
        """Remove only the mark; return whether that was possible."""
        try:
            storage_of(self.spool.directory).remove([self.mark])
        except FileNotFoundError:
            return True
        except OSError as error:
            self._warn(f"are still marked as in use ({error})")
            return False
        return True

    def _warn(self, what: str) -> None:
        warnings.warn(f"{self.spool.directory}: finished assets {what}", stacklevel=3)


@contextmanager
def work_beside(
    target: Place,
    *,
    arrays: bool = True,
    fresh: bool = False,
    keep: bool = False,
    look: Callable[[], object] = lambda: None,
    private_disks: bool = False,
    who: str = "build",
) -> Iterator[Work]:
    """Make the work folder of a target, hold its lock, and clean up.

    The spool keeps `arrays`, or only records. It begins empty with `fresh`, and stays after success
    with `keep`. `look` is called with the lock held, before the target is written, and raises an
    error if the target is refused. With `private_disks` workers share no disk, so the spool lies
    at the target. `who` works there, in a word. StoreError if the folder cannot be written or is
    not a build's, or another one has the lock or, with `fresh`, uses the spool; it names that one.
    """
    directory = work_directory(target)
    folder, remote = directory / SPOOL, storage_of(target).remote if private_disks else None
    spool = spool_of(target, private_disks, arrays)
    finished, lock, work = False, None, None
    try:
        with writing(str(target), directory.parent):
            _claim(directory)
            reached("work folder made", directory.name)
            lock = take_lock(directory / LOCK, f"{target}: another {who} is writing it")
            reached("work folder locked", directory.name)
            _restore(directory, target)
            _remove_builds(directory)
            if not os.path.lexists(folder):
                folder.mkdir()
            elif folder.is_symlink() or not folder.is_dir():
                raise _refusal(folder, "is no folder")
            scratch = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=directory))
        look()
        shards = scratch / "store.zarr" if remote is None else new_version(remote)
        work = Work(spool, scratch, shards, "" if remote is None else _mark(directory))
        if fresh:
            with writing(str(target), spool.directory):
                others = spool.keep_only(set(), work.mark)
            if others:
                raise StoreError(
                    f"{spool.directory / others[0]}: another build, which it names, uses the "
                    "assets that --fresh removes; wait until it has ended. If it was killed, "
                    "remove that object"
                )
        yield work
        finished = True
    except KeyboardInterrupt:
        if lock is None:
            with suppress(OSError):  # Not empty if another build left it, or has the lock.
                directory.rmdir()
        raise
    finally:
        if lock is not None:
            try:
                _restore(directory, target)
                _remove_builds(directory)
                _clear(directory, work, all_assets=finished and not keep)
            finally:
                os.close(lock)


def _clear(directory: Path, work: Work | None, all_assets: bool) -> None:
    """Remove the mark, the finished assets if nothing needs them, and then the folder."""
    if work is not None and work.mark:
        cleared = work.keep_only(set()) if all_assets else work.unmark()
        if cleared:
            (directory / work.mark).unlink(missing_ok=True)
    folder = directory / SPOOL
    if all_assets or not Spool(folder).holds_any():
        shutil.rmtree(folder, ignore_errors=True)
        if not any(directory.glob(f"{BUILDER}-*")):
            # The lock goes last, because a folder without a lock does not count as a build's.
            (directory / LOCK).unlink(missing_ok=True)
        with suppress(OSError):  # It may hold somebody's files, or the next build's lock.
            directory.rmdir()


def work_directory(target: Place) -> Path:
    """Return the work folder of a target: beside it, or in the cache if it is on no local disk."""
    return storage_of(target).work_folder()


def spool_of(target: Place, private_disks: bool, arrays: bool = True) -> Spool:
    """Return the spool of a target; see `work_beside` for the parameters."""
    remote = storage_of(target).remote if private_disks else None
    return Spool((remote or work_directory(target)) / SPOOL, arrays)


def _mark(directory: Path) -> str:
    """Return this build's mark: the mark of a build killed in this work folder, or a new mark.

    This build holds the lock, so that other build has ended.
    """
    there = sorted(p.name for p in directory.glob(f"{BUILDER}-*") if is_spooled(p.name))
    name = there[0] if there else f"{BUILDER}-{secrets.token_hex(8)}"
    (directory / name).touch()
    return name


def _restore(directory: Path, target: Place) -> None:
    local = storage_of(target).local
    if local is not None:
        restore_directory(directory, local)


def _claim(directory: Path) -> None:
    """Make the work folder for this user alone, or check that a build of this user made it."""
    directory.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        directory.mkdir(mode=0o700)
    # Not by our user id, because our files on a network file system may have another owner.
    # The file has no name if the system can do that, so a signal leaves nothing behind.
    with tempfile.TemporaryFile(dir=directory.parent) as ours:
        owner = os.fstat(ours.fileno()).st_uid
    try:
        state = directory.lstat()
        if not stat.S_ISDIR(state.st_mode):
            raise _refusal(directory, "is no folder")
        if state.st_uid != owner:
            raise _refusal(directory, f"belongs to user {state.st_uid}")
        names = {path.name for path in directory.iterdir()}
    except FileNotFoundError:
        return  # A build has just ended there, and taking the lock makes the folder again.
    if names and LOCK not in names:
        raise _refusal(directory, f"holds {min(names)} and was not made by a build")


def _refusal(path: Path, what: str) -> StoreError:
    return StoreError(
        f"{path}: {what}; expected a work folder of slatprep, or nothing. Move it away, or choose "
        "another path for the result"
    )


def _remove_builds(directory: Path) -> None:
    for path in directory.glob(f"{_PREFIX}*"):
        shutil.rmtree(path, ignore_errors=True)

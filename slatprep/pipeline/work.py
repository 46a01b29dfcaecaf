"""The work folder of a build: `slatprep.storage.work`, with a spool that makes it resumable.

A killed build leaves the spool of finished assets. The next build to the same target goes on from
there.

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
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.pipeline.spool import Spool
from slatprep.records import Place
from slatprep.storage.atomic import writing
from slatprep.storage.place import storage_of
from slatprep.storage.versions import BUILDER, SPOOL, is_spooled, new_version
from slatprep.storage.work import refusal, scratch_beside


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
) -> Iterator[Work]:
    """Make the work folder of a target, hold its lock, and clean up.

    The spool keeps `arrays`, or only records. It begins empty with `fresh`, and stays after success
    with `keep`. `look` is called with the lock held, before the target is written, and raises an
    error if the target is refused. With `private_disks` workers share no disk, so the spool lies
    at the target. StoreError as `scratch_beside`, and if, with `fresh`, another build uses the
    spool; it names that build.
    """
    directory = storage_of(target).work_folder()
    folder, remote = directory / SPOOL, storage_of(target).remote if private_disks else None
    spool = spool_of(target, private_disks, arrays)
    finished, work = False, None

    def clear() -> None:
        _clear(directory, work, all_assets=finished and not keep)

    with scratch_beside(target, "build", clear) as scratch:
        with writing(str(target), directory.parent):
            if not os.path.lexists(folder):
                folder.mkdir()
            elif folder.is_symlink() or not folder.is_dir():
                raise refusal(folder, "is no folder")
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


def _clear(directory: Path, work: Work | None, all_assets: bool) -> None:
    """Remove the mark, and the finished assets if nothing needs them."""
    if work is not None and work.mark:
        cleared = work.keep_only(set()) if all_assets else work.unmark()
        if cleared:
            (directory / work.mark).unlink(missing_ok=True)
    if all_assets:
        shutil.rmtree(directory / SPOOL, ignore_errors=True)


def spool_of(target: Place, private_disks: bool, arrays: bool = True) -> Spool:
    """Return the spool of a target; see `work_beside` for the parameters."""
    remote = storage_of(target).remote if private_disks else None
    return Spool((remote or storage_of(target).work_folder()) / SPOOL, arrays)


def _mark(directory: Path) -> str:
    """Return this build's mark: the mark of a build killed in this work folder, or a new mark.

    This build holds the lock, so that other build has ended.
    """
    there = sorted(p.name for p in directory.glob(f"{BUILDER}-*") if is_spooled(p.name))
    name = there[0] if there else f"{BUILDER}-{secrets.token_hex(8)}"
    (directory / name).touch()
    return name

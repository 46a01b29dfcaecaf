"""Put a new directory in the place of an old one, in one step where the system can.

Nothing is exchanged before all of the new one is on the disk itself, so that
a power failure finds the old one whole or the new one whole.
"""

from __future__ import annotations

import ctypes
import errno
import os
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from slatprep.errors import StoreError
from slatprep.storage.faults import reached
from slatprep.storage.files import OWN_FILE, is_at, is_only_ours, locks_alone

if TYPE_CHECKING:
    from slatprep.records import Place

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


def replace_directory(new: Path, target: Path) -> None:
    """Move the directory `new` to `target`; what was there is removed afterwards.

    On Linux the two directories are exchanged in one system call, so a reader
    finds the old or the new one whole at every moment. Elsewhere, and on file
    systems that cannot exchange, two renames leave a short moment without
    either; `restore_directory` mends what a kill in it leaves. Both must lie
    on one file system.

    Raises
    ------
    OSError
        If the directory cannot be moved; `target` is as it was.
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
        shutil.rmtree(old, ignore_errors=True)  # The work folder goes next, with what is left.


def restore_directory(work: Path, target: Path) -> None:
    """Put back what a kill between the two renames of `replace_directory` left below `work`."""
    for scratch in sorted(work.glob("*")):
        if _aside(scratch).exists() and not target.exists():
            _aside(scratch).rename(target)


def flush_tree(directory: Path) -> None:
    """Bring every file below a directory, and the names of all, onto the disk itself."""
    for parent, _, files in os.walk(directory, topdown=False):
        for name in files:
            flush(Path(parent, name))
        flush(Path(parent))


def flush(path: Path) -> None:
    """Bring a file's content, or a directory's names, onto the disk itself."""
    if path.is_dir() and sys.platform == "win32":
        return  # There a directory cannot be opened.
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _aside(scratch: Path) -> Path:
    return scratch / "previous"


def _exchange(new: Path, target: Path) -> bool:
    """Exchange two directories atomically; False where the system cannot."""
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
    """Yield a file beside `path` that takes its place, whole and on disk, when all went well.

    Its name is the same each time, so what a killed process leaves is replaced
    by the next. Where a link, somebody else's file or that of a running process
    has that name, it is left alone for another one.
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


def append_file(source: Path, target: Path, size: int) -> None:
    """Put a file's content behind that of another, onto the disk; what is there is not written.

    Unlike `staged` it is not one step: a kill leaves part of it.

    Parameters
    ----------
    source : Path
        What to add.
    target : Path
        The file, which is ours alone.
    size : int
        Its bytes.

    Raises
    ------
    OSError
        If the file is another one by now, or the disk does not take it; it is as it was then.
    """
    flags = os.O_WRONLY | os.O_APPEND | OWN_FILE & ~os.O_CREAT
    descriptor = os.open(target, flags)
    try:
        state = os.fstat(descriptor)
        if not is_only_ours(state) or state.st_size != size:
            raise OSError(errno.EBUSY, "it was changed meanwhile")
        try:
            with source.open("rb") as more, os.fdopen(os.dup(descriptor), "ab") as file:
                shutil.copyfileobj(more, file)
            os.fsync(descriptor)
        except OSError:
            os.ftruncate(descriptor, size)  # Only now is nothing left that waits to be written.
            raise
    finally:
        os.close(descriptor)


@contextmanager
def staged_apart(path: Path, folder: Path) -> Iterator[Path]:
    """Yield a file in `folder` that takes the place of `path`, whole, when all went well.

    Unlike that of `staged` it is not flushed, and has a name of its own each time: a worker that
    outlives a killed build, or that a cluster has given up, may write the same file. Folders are
    not made: such a worker must not bring back those that were removed.
    """
    temporary = folder / f"{secrets.token_hex(16)}.partial"
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def writing(what: str, where: Place) -> Iterator[None]:
    """Turn the refusal of a disk or object store into an error that names what was to be written.

    Raises
    ------
    StoreError
        In place of an `OSError`.
    """
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        advice = "Make room there" if full else "See that both may be written"
        raise StoreError(
            f"{what}: cannot be written to {where} ({error.strerror or error}); nothing was "
            f"replaced. {advice} and run again: what is finished is kept"
        ) from error

"""A lock on what only one process may write; it ends with its holder, however that ends."""

from __future__ import annotations

import os
import platform
import stat
import sys
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import orjson

from slatprep.errors import StoreError
from slatprep.storage.files import OWN_FILE, is_at, locks_alone

_TRIES = 100
"""Attempts to lock a file that its holder has just removed."""


def take_lock(path: Path, taken: str) -> int:
    """Return a descriptor that holds a lock until it is closed or the process ends.

    The file and its folder are created; the holder may remove the file. StoreError if another
    process holds it, with that process and the words of `taken`, such as ``STORE: another build is
    writing it``; also if the file is no lock, or its folder vanishes. OSError if it cannot be
    written, or is a link.
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
                continue  # What we locked has been removed; lock what is there now.
            _sign(descriptor, path)
            unless_held.pop_all()
            return descriptor
    raise StoreError(
        f"{path}: cannot be locked, as it or its folder was removed {_TRIES} times meanwhile; "
        "expected a folder that stays (is the current one deleted?). Choose another path"
    )


def _sign(descriptor: int, path: Path) -> None:
    """Write into a lock which process holds it."""
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

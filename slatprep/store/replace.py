"""Put a finished directory in the place of an old one, in one step where the system can."""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
from pathlib import Path

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


def replace_directory(new: Path, target: Path) -> None:
    """Move the directory `new` to `target`; what was there is removed afterwards.

    On Linux the two directories are exchanged in one system call, so a reader
    finds the old or the new one whole at every moment. Elsewhere, and on file
    systems that cannot exchange, two renames leave a short moment without
    either. Both must lie on one file system.

    Raises
    ------
    OSError
        If the directory cannot be moved; `target` is as it was.
    """
    if not target.exists():
        new.rename(target)
    elif _exchange(new, target):
        shutil.rmtree(new)
    else:
        old = new.with_name(f"{new.name}.old")
        target.rename(old)
        try:
            new.rename(target)
        except OSError:
            old.rename(target)
            raise
        shutil.rmtree(old)


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

"""The names of files below a root: a disk is asked one by one, an object store all at once.

An object store has no folders. It lists a thousand names in a request, and asking for a single name
costs as much.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path


class Listing:
    """Names below a folder of the local disk, up to date except that each folder is listed once.

    Names are relative to the folder, with forward slashes.
    """

    def __init__(self, root: Path) -> None:
        self._root = str(root)  # os.path.join is not called so often with a Path

    def of_folder(self, folder: str, *, folders: bool) -> Iterable[str]:
        """Return the names of a folder's files, or of its folders; none if it does not exist.

        `folder` ends with a slash, or is empty for the root. OSError if it cannot be listed.
        """
        return (self._scan(folder) if folder else self._top)[folders]

    def is_file(self, path: str) -> bool:
        """Whether this name exists and is not a folder; broken links count."""
        full = os.path.join(self._root, path)  # noqa: PTH118 - half a million times
        link = False
        try:
            mode = os.lstat(full).st_mode
            if link := stat.S_ISLNK(mode):
                mode = os.stat(full).st_mode  # noqa: PTH116
        except (OSError, ValueError):
            return link
        return not stat.S_ISDIR(mode)

    @cached_property
    def _top(self) -> tuple[list[str], list[str]]:
        return self._scan("")  # Every pattern begins there.

    def _scan(self, folder: str) -> tuple[list[str], list[str]]:
        """Return the names in a folder: of files and others, and of folders."""
        found: tuple[list[str], list[str]] = ([], [])
        try:
            with os.scandir(os.path.join(self._root, folder)) as entries:  # noqa: PTH118
                for entry in entries:
                    found[_is_folder(entry)].append(entry.name)
        except (FileNotFoundError, NotADirectoryError):
            pass
        return found


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # A link loop.
        return False


class RemoteListing(Listing):
    """Names below a place on an object store when it was listed, relative to the root."""

    def __init__(self, files: Iterable[str]) -> None:
        self.files = frozenset(files)
        self._folders: dict[str, dict[str, None]] = {}
        for file in self.files:
            while file:
                folder, _, name = file.rpartition("/")
                self._folders.setdefault(folder + "/" if folder else "", {})[name] = None
                file = folder

    def of_folder(self, folder: str, *, folders: bool) -> Iterable[str]:
        """See `Listing`."""
        names = self._folders.get(folder, ())
        if folders:
            return [name for name in names if f"{folder}{name}/" in self._folders]
        return [name for name in names if folder + name in self.files]

    def is_file(self, path: str) -> bool:
        """See `Listing`."""
        return path in self.files

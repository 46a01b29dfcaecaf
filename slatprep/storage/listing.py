"""The names of files below a root: asked of the disk one by one, of an object store all at once.

An object store has no folders; it lists a thousand names a request, whatever
they are, and asking for one costs as much.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path


class Listing:
    """Names below a folder of the local disk, as they are whenever one asks.

    Names are relative to the folder, with forward slashes.

    Parameters
    ----------
    root : Path
        The folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    def of_folder(self, folder: str) -> Iterable[str]:
        """Return the names in a folder, given with a slash at its end; none if there is none.

        Raises
        ------
        OSError
            If it cannot be listed.
        """
        try:
            with os.scandir(self._root / folder) as entries:
                return [entry.name for entry in entries]
        except (FileNotFoundError, NotADirectoryError):
            return []

    def is_file(self, path: str) -> bool:
        """Whether there is a file of this name."""
        return os.path.isfile(os.path.join(self._root, path))  # noqa: PTH113, PTH118 - half a million times


class RemoteListing(Listing):
    """Names below a place on an object store, as they were when it was listed.

    Parameters
    ----------
    files : iterable of str
        All of them, relative to the root.
    """

    def __init__(self, files: Iterable[str]) -> None:
        self.files = frozenset(files)
        self._folders: dict[str, dict[str, None]] = {}
        for file in self.files:
            while file:
                folder, _, name = file.rpartition("/")
                self._folders.setdefault(folder + "/" if folder else "", {})[name] = None
                file = folder

    def of_folder(self, folder: str) -> Iterable[str]:
        """See `Listing`."""
        return self._folders.get(folder, ())

    def is_file(self, path: str) -> bool:
        """See `Listing`."""
        return path in self.files

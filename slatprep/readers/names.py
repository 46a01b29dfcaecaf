"""The names of files below a root: asked of the disk one by one, of an object store all at once.

An object store has no folders; it lists a thousand names a request, whatever
they are, and asking for one costs as much.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from slatprep.errors import ConfigError
from slatprep.storage.remote import RemotePath, list_objects


class LocalNames:
    """Names below a folder of the local disk.

    Parameters
    ----------
    root : Path
        The folder.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def of_folder(self, folder: str) -> list[str]:
        """Return the names in a folder, given relative to the root; none where there is none."""
        path = self.root / folder
        try:
            with os.scandir(path) as entries:
                return [entry.name for entry in entries]
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise ConfigError(f"{path}: cannot be listed ({error.strerror})") from None

    def is_file(self, path: str) -> bool:
        """Whether there is a file of this name, relative to the root."""
        return os.path.isfile(os.path.join(self.root, path))  # noqa: PTH113, PTH118 - half a million times


class RemoteNames:
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

    @classmethod
    def of(cls, root: RemotePath) -> RemoteNames:
        """List a place; within `listed_once`, only the first time.

        Raises
        ------
        ConfigError
            If it cannot be listed.
        """
        known = _listed.get(root) if _listed is not None else None
        if known is not None:
            return known
        try:
            names = cls(list_objects(root))
        except OSError as error:
            raise ConfigError(f"{root}: cannot be listed ({error.strerror})") from None
        if _listed is not None:
            _listed[root] = names
        return names

    def of_folder(self, folder: str) -> Iterable[str]:
        """Return the names in a folder, given relative to the root with a slash at its end."""
        return self._folders.get(folder, ())

    def is_file(self, path: str) -> bool:
        """Whether there is an object of this name, relative to the root."""
        return path in self.files


_listed: dict[RemotePath, RemoteNames] | None = None


@contextmanager
def listed_once() -> Iterator[None]:
    """Within, list every place on an object store once, and hold on to what was there then."""
    global _listed
    outer = _listed
    _listed = {} if outer is None else outer
    try:
        yield
    finally:
        _listed = outer

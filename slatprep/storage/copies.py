"""A copy, on the local disk, of a store on an object store: for reading it more than once."""

from __future__ import annotations

import tempfile
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.storage.cache import folder_for
from slatprep.storage.remote import RemotePath, in_parts, list_objects, reach, telling
from slatprep.storage.versions import is_version


def local_copy(path: Path) -> Path:
    """Return where a store lies on the local disk, after copying it there if it does not.

    Parameters
    ----------
    path : Path
        A local store, which is its own copy; or a version of a store on an
        object store. Versions never change, so a copy is made once.

    Raises
    ------
    StoreError
        If it is no version, cannot be copied whole, or the disk does not take it.
    """
    if not isinstance(path, RemotePath):
        return path
    if not is_version(path):
        raise StoreError(
            f"{path}: lies there without versions, so a copy could not be told to be current; "
            "build it there with `slatprep build-store`, or copy it yourself"
        )
    store = path.parent.parent
    folder = folder_for(store) / path.name
    copy = folder / store.name
    if copy.is_dir():
        return copy
    try:
        objects = list_objects(path)  # Names that lead out of a folder are not among them.
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as own:
            part = Path(own, "part")
            system, root = reach(path)
            with telling(path):
                options = in_parts(system) | ({"batch_size": 4} if system.async_impl else {})
                system.get(
                    [f"{root}/{name}" for name in objects],
                    [str(part / name) for name in objects],
                    **options,
                )
            for name, entry in objects.items():
                if (part / name).stat().st_size != entry["size"]:
                    raise StoreError(f"{path / name}: changed while it was copied; run again")
            if not copy.is_dir():  # Another process may have been faster.
                part.rename(copy)
    except OSError as error:
        raise StoreError(f"{path}: cannot be copied to {folder} ({error.strerror})") from None
    return copy

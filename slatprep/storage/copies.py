"""A local copy of a store on an object store, for reading it more than once."""

from __future__ import annotations

import tempfile
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.storage.cache import folder_for
from slatprep.storage.files import file_digest
from slatprep.storage.remote import RemotePlace, connected, list_objects, multipart_options
from slatprep.storage.versions import content_of, is_version, read_pointer


def copied_version(place: RemotePlace) -> Path:
    """Return the local copy of a store's version, after making it if needed.

    Versions never change, so a copy is made once. StoreError if the place is no version, differs
    from its pointer, or the disk refuses the copy.
    """
    if not is_version(place):
        raise StoreError(
            f"{place}: lies there without versions, so a copy could not be told to be current; "
            "build it there with `slatprep build-store`, or copy it yourself"
        )
    store = place.parent.parent
    folder = folder_for(store) / place.name
    copy = folder / store.name
    if copy.is_dir():
        return copy
    try:
        pointer = read_pointer(store)
        objects = list_objects(place)  # Names that lead out of a folder are not among them.
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as own:
            part = Path(own, "part")
            with connected(place) as (system, root):
                system.get(
                    [f"{root}/{name}" for name in objects],
                    [str(part / name) for name in objects],
                    **multipart_options(system, files_at_once=4),
                )
            for name, entry in objects.items():
                if (part / name).stat().st_size != entry["size"]:
                    raise StoreError(f"{place / name}: changed while it was copied; run again")
            if pointer is not None and pointer.version == place.name and pointer.content:
                digests = {name: file_digest(part / name) for name in objects}
                if content_of(digests) != pointer.content:
                    raise StoreError(
                        f"{place}: the copy is not what was published there; run again, and if "
                        f"that does not help, `slatprep verify {store}` names what is damaged"
                    )
            if not copy.is_dir():  # Another process may have been faster.
                part.rename(copy)
    except OSError as error:
        raise StoreError(f"{place}: cannot be copied to {folder} ({error.strerror})") from None
    return copy

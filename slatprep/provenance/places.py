"""Where the records of a build lie."""

from __future__ import annotations

from slatprep.errors import StoreError
from slatprep.records import Place
from slatprep.storage.versions import MANIFESTS, is_version


def manifests_of(store: Place) -> Place:
    """Return the folder of a store's records: ``demo.manifests`` beside ``demo.zarr``.

    Those of a version on an object store lie beside all versions.
    """
    if is_version(store):
        return store.parent.parent / MANIFESTS / store.name
    return store.parent / f"{store.name.removesuffix('.zarr')}.manifests"


def manifests_beside(store: Place) -> Place | None:
    """Return the folder of a store's records if there is one; StoreError if nobody can tell."""
    folder = manifests_of(store)
    files = (folder / "build.json", folder / "assets.jsonl")
    try:
        return folder if any(file.exists() for file in files) else None
    except OSError as error:
        raise StoreError(f"{folder}: cannot be reached ({error.strerror})") from None

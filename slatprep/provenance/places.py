"""Where the records of a build lie."""

from __future__ import annotations

from pathlib import Path

from slatprep.storage.remote import RemotePath
from slatprep.storage.versions import RECORDS, is_version


def manifests_of(store: Path) -> Path:
    """Return the folder of a store's records: ``demo.manifests`` beside ``demo.zarr``.

    Those of a version on an object store lie beside all versions.
    """
    if isinstance(store, RemotePath) and is_version(store):
        return store.parent.parent / RECORDS / store.name
    return store.with_name(f"{store.name.removesuffix('.zarr')}.manifests")

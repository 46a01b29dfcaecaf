"""The manifests beside a store: its records as lines, and `build.json`, read with bounds.

A file of lines is derived from one shard of ``asset/record`` by `lines_of`, and by nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.records import Place
from slatprep.storage.documents import read_bounded
from slatprep.storage.versions import MANIFESTS, is_version
from slatprep.store.layout import RECORD_ARRAY, RECORDS_IN_SHARD
from slatprep.store.reader import Store
from slatprep.store.record import BuildRecord
from slatprep.store.record_json import read_build_record

BUILD, ASSETS, SEVERAL = "build.json", "assets.jsonl", "assets-*.jsonl"

MAX_BUILD_BYTES = 32 * 2**20
"""No `build.json` is larger: it lists as many of the assets that could not go in as fit."""

_LINES = re.compile(r"assets(-\d{5,})?\.jsonl")


def file_names(assets: int) -> list[str]:
    """Return the names of the files of lines, one for each shard of the records of so many assets.

    >>> file_names(5), file_names(1025)
    (['assets.jsonl'], ['assets-00000.jsonl', 'assets-00001.jsonl'])
    """
    shards = -(-assets // RECORDS_IN_SHARD)
    return [ASSETS] if shards == 1 else [f"assets-{shard:05d}.jsonl" for shard in range(shards)]


def lines_of(store: Store, shard: int) -> bytes:
    """Return the records of a shard's rows, a line each; StoreError if they are damaged."""
    start = shard * RECORDS_IN_SHARD
    texts = store.read_rows(RECORD_ARRAY, start, min(start + RECORDS_IN_SHARD, len(store)))
    return "".join(f"{text}\n" for text in texts).encode()


def stale_files(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the files of lines in a folder that have none of these names."""
    there = (file for file in folder.iterdir() if _LINES.fullmatch(file.name))
    return sorted(file for file in there if file.name not in names)


def build_text(folder: Place) -> bytes:
    """Return the record of a build as it is in its file; StoreError if it cannot be read."""
    try:
        return read_bounded(folder / BUILD, MAX_BUILD_BYTES)
    except (OSError, ValueError) as error:
        raise StoreError(f"{folder / BUILD}: cannot be read ({error})") from None


def build_in(folder: Place) -> BuildRecord:
    """Read the record of a build; StoreError where it cannot be."""
    return read_build_record(build_text(folder), str(folder / BUILD))


def manifests_of(store: Place) -> Place:
    """Return the folder of a store's records: ``demo.manifests`` beside ``demo.zarr``.

    Those of a version on an object store lie beside all versions; those of a store behind a link
    lie beside the store.
    """
    if isinstance(store, Path) and store.is_symlink():
        store = store.resolve()
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

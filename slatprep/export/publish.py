"""Write a dataset for a hub: card, description, pictures, data and checksums in a folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from slatprep.errors import ConfigError, StoreError
from slatprep.export import croissant, export_store, target
from slatprep.export.card import card_of
from slatprep.export.croissant import Stated
from slatprep.records import USABLE, Place
from slatprep.storage.files import file_digest, local_files
from slatprep.storage.place import place_of, storage_of
from slatprep.store import Store, open_store
from slatprep.store.integrity import file_findings
from slatprep.store.reader import require_outside

Data = Literal["store", "webdataset"]

CARD, DESCRIPTION, CHECKSUMS, SHARDS = "README.md", "croissant.json", "SHA256SUMS", "data"
"""Names of the files beside the data, and of the folder of shards."""


@dataclass(frozen=True)
class PublishSummary:
    """The result: path, data, number of assets, files and bytes, and metadata not stated."""

    path: Path
    data: str
    assets: int
    files: int
    size: int
    missing: tuple[str, ...]


def publish_store(
    store: str | Place,
    out: Path,
    data: Data = "store",
    *,
    stated: Stated | None = None,
    pictures: Mapping[str, bytes] | None = None,
    verdicts: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> PublishSummary:
    """Write a store of the local disk, or WebDataset shards of it, as a dataset for a hub.

    An earlier result at `out` is replaced when the new one is complete. `pictures` for the card
    are PNG bytes by file name. For shards, `verdicts` is as in `slatprep.export.export_store`, and
    `progress` gets the number of assets done and of all. ConfigError if the store is not local, or
    `out` lies in one or holds other files. StoreError if a file differs from its digest.
    """
    place, stated, out = place_of(store), stated or Stated(), Path(out)
    local = storage_of(place).local
    if local is None:
        raise ConfigError(f"{place} is on no local disk; copy it there to publish it")
    require_outside(out)
    opened = open_store(place)
    assets = len(opened)
    chosen: Sequence[str] = ()
    with target.directory(out) as folder:
        if data == "store":
            where = opened.name
            _copy(opened, local, folder / where)
            # For shards, hubs generate a description themselves.
            described = replace(stated, license=stated.license_url)
            document = croissant.describe(opened, described, where)
            (folder / DESCRIPTION).write_text(croissant.to_json(document), encoding="utf-8")
        else:
            where = f"{SHARDS}/*.tar"
            chosen = USABLE if verdicts is None else tuple(verdicts)
            assets = export_store(
                place, folder / SHARDS, "webdataset", verdicts=chosen, progress=progress
            ).assets
        for name, content in (pictures or {}).items():
            (folder / name).write_bytes(content)
        card = card_of(opened, stated, where, list(pictures or ()), chosen)
        (folder / CARD).write_text(card, encoding="utf-8")
        names = list(local_files(folder))
        lines = (f"{file_digest(folder / name)}  {name}\n" for name in names)
        (folder / CHECKSUMS).write_text("".join(lines), encoding="utf-8")
        names.append(CHECKSUMS)
        size = sum((folder / name).stat().st_size for name in names)
        about = {"format": target.FORMAT, "format_version": target.FORMAT_VERSION,
                 "kind": "hub", "store": opened.name, "manifest": opened.about.manifest,
                 "files": names}  # fmt: skip
        target.write_index(folder, about, [])
    asked = ("license", "cite_as", "url", "date_published")
    missing = tuple(f"--{name.replace('_', '-')}" for name in asked if not getattr(stated, name))
    return PublishSummary(out, where, assets, len(names), size, missing)


def _copy(store: Store, local: Path, to: Path) -> None:
    """Copy a store whose files are all what its digests say."""
    # First, as an error while copying is taken for one of writing.
    _, findings = file_findings(store, jobs=1)
    for finding in sorted(findings, key=str):
        raise StoreError(f"{local}/{finding}; `slatprep verify` says more")
    for name in local_files(local):
        (to / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(local / name, to / name)

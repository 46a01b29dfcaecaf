"""A folder that a hub of datasets takes as it is: card, description, pictures, data, checksums."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from slatprep.errors import ConfigError
from slatprep.export import croissant, export_store, target
from slatprep.export.card import Stated, card_of
from slatprep.records import Place
from slatprep.storage.files import file_digest, local_files
from slatprep.storage.place import place_of, storage_of
from slatprep.store import open_store

Data = Literal["store", "webdataset"]

CARD, DESCRIPTION, CHECKSUMS, SHARDS = "README.md", "croissant.json", "SHA256SUMS", "data"
"""Names of what lies beside the data, and of the folder of shards."""


@dataclass(frozen=True)
class PublishSummary:
    """What was written: where, of which assets, and what of it a person should complete."""

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
    """Write what a dataset needs on a hub.

    Parameters
    ----------
    store : str or Place
        A store of the local disk.
    out : Path
        The folder; one that was published before is replaced when the new one is complete.
    data : {"store", "webdataset"}
        The data: the store as it is, or shards of the WebDataset convention.
    stated : Stated, optional
        Licence and what else the store does not know.
    pictures : mapping of str to bytes, optional
        Pictures of the card by their names.
    verdicts : sequence of str, optional
        As in `slatprep.export.export_store`, for shards.
    progress : callable, optional
        Called with the assets done and the assets in all, for shards.

    Returns
    -------
    PublishSummary
        What was written.

    Raises
    ------
    ConfigError
        If the store is on no local disk, or `out` is something else or lies in the store.
    StoreError
        If the store cannot be read.
    """
    place, stated, out = place_of(store), stated or Stated(), Path(out)
    local = storage_of(place).local
    if local is None:
        raise ConfigError(f"{place} is on no local disk; copy it there to publish it")
    if local.resolve() in (out.resolve(), *out.resolve().parents):
        raise ConfigError(f"{out} lies inside the store; expected a path outside {place}")
    opened = open_store(place)
    with target.directory(out) as folder:
        if data == "store":
            where = opened.name
            _copy(local, folder / where)
            # Of shards a hub writes a description itself.
            document = croissant.describe(
                opened,
                location=where,
                name=stated.name,
                license=stated.license_url,
                url=stated.url,
                cite_as=stated.cite_as,
                version=stated.version,
                date_published=stated.date_published,
            )
            (folder / DESCRIPTION).write_text(croissant.to_json(document), encoding="utf-8")
        else:
            where = f"{SHARDS}/*.tar"
            export_store(place, folder / SHARDS, "webdataset", verdicts=verdicts, progress=progress)
        for name, content in (pictures or {}).items():
            (folder / name).write_bytes(content)
        card = card_of(opened, stated, where, list(pictures or ()))
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
    return PublishSummary(out, where, len(opened), len(names), size, missing)


def _copy(store: Path, to: Path) -> None:
    """Copy the regular files of a store, so that no link comes along."""
    for name, size in local_files(store).items():
        if size < 0:
            raise ConfigError(f"{store / name}: is no regular file; `slatprep verify` says more")
        (to / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(store / name, to / name)

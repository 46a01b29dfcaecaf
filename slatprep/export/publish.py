"""Write a dataset for a hub: card, description, pictures, data and checksums in a folder.

A hub displays and parses the card.
"""

from __future__ import annotations

import html
import json
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, StoreError, printable, row_of_category
from slatprep.export import croissant, export_store, target
from slatprep.export.croissant import Stated
from slatprep.records import Verdict
from slatprep.storage.files import file_digest, local_files
from slatprep.storage.place import storage_of
from slatprep.store import Store
from slatprep.store.integrity import file_findings
from slatprep.store.reader import require_outside
from slatprep.workers import Progress

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
    store: Store,
    out: Path,
    data: Data,
    *,
    stated: Stated,
    pictures: Mapping[str, bytes],
    verdicts: Sequence[str],
    progress: Progress,
) -> PublishSummary:
    """Write a store of the local disk, or WebDataset shards of it, as a dataset for a hub.

    `pictures` for the card are PNG bytes by file name. Shards have the assets with one of
    `verdicts`, and `progress` tells of them; a store has all, so `verdicts` are none then.
    ConfigError if the store is not local, or `out` lies in one or holds other files. StoreError if
    a file differs from its digest.
    """
    local = storage_of(store.path).local
    if local is None:
        raise ConfigError(
            f"{store.path} is on no local disk; `slatprep subset {store.path} --verdict all "
            "--out FOLDER` makes a store there that can be published"
        )
    require_outside(out)
    assets = len(store)
    with target.directory(out, "hub") as folder:
        if data == "store":
            where = store.name
            _copy(store, local, folder / where)
            # For shards, hubs generate a description themselves.
            described = replace(stated, license=stated.license_url)
            document = croissant.describe(store, described, where)
            (folder / DESCRIPTION).write_text(croissant.to_json(document), encoding="utf-8")
        else:
            where = f"{SHARDS}/*.tar"
            assets = export_store(
                store, folder / SHARDS, "webdataset", verdicts=verdicts, progress=progress
            ).assets
        for name, content in pictures.items():
            (folder / name).write_bytes(content)
        card = card_of(store, stated, where, list(pictures), verdicts)
        (folder / CARD).write_text(card, encoding="utf-8")
        names = list(local_files(folder))
        lines = (f"{file_digest(folder / name)}  {name}\n" for name in names)
        (folder / CHECKSUMS).write_text("".join(lines), encoding="utf-8")
        names.append(CHECKSUMS)
        size = sum((folder / name).stat().st_size for name in names)
        about = {"format": target.FORMAT, "format_version": target.FORMAT_VERSION,
                 "kind": "hub", "store": store.name, "manifest": store.about.manifest,
                 "files": names}  # fmt: skip
        target.write_index(folder, about, [])
    return PublishSummary(out, where, assets, len(names), size, stated.missing)


def _copy(store: Store, local: Path, to: Path) -> None:
    """Copy a store; StoreError if a file differs from its digest."""
    # Files are checked first, as an error while copying counts as an error of writing.
    _, findings = file_findings(store, jobs=1)
    for finding in sorted(findings, key=str):
        raise StoreError(f"{local}/{finding}; `slatprep verify` says more")
    for name in local_files(local):
        (to / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(local / name, to / name)


_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"),
          (1_000_000, "100K<n<1M"))  # fmt: skip
"""Hugging Face's size categories, each below a number of samples."""

_TAGS = ("3d", "physics", "material-properties", "structured-latents", "zarr", "slatprep")

_HOW_ZARR = """\
```python
import slatprep  # in a checkout of it: pip install '.[hub]'

store = slatprep.open_store("hf://datasets/OWNER/NAME/{data}")
asset = store.asset(store.ids[0])
asset.coords, asset.feats, asset.properties, asset.material, asset.valid
```

Plain zarr reads a copy of it, `zarr.open_group("{data}", mode="r")`."""

_HOW_WEBDATASET = """\
```python
from datasets import load_dataset

for sample in load_dataset("OWNER/NAME", split="train", streaming=True):
    sample["npz"]["coords"], sample["npz"]["feats"], sample["npz"]["properties"]
```

Each sample is an asset: `json` describes it, `npz` holds its arrays."""


def card_of(
    store: Store, stated: Stated, data: str, pictures: Sequence[str], verdicts: Sequence[str] = ()
) -> str:
    """Return the card as Hugging Face expects it: Markdown with metadata in YAML.

    `data` is the path of the data relative to the card: the store's name, or a pattern of shards.
    `pictures` names the pictures beside the card. The data have only assets with one of
    `verdicts`; empty or ``all`` is all of them.
    """
    kept = store.having(verdicts)
    title = stated.name or store.name.removesuffix(".zarr")
    shards = data.endswith(".tar")
    head: dict[str, Any] = {
        "pretty_name": title,
        "tags": list(_TAGS),
        "size_categories": [next((w for n, w in _SIZES if kept.sum() < n), "1M<n<10M")],
    }
    if stated.license and "://" not in stated.license:
        head["license"] = stated.license.lower()
    elif stated.license:
        head |= {"license": "other", "license_name": "stated", "license_link": stated.license}
    if shards:
        head["configs"] = [{"config_name": "default", "data_files": data}]
    # Every JSON value is a YAML value.
    lines = [f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in head.items()]
    about = store.about
    how = _HOW_WEBDATASET if shards else _HOW_ZARR.format(data=data)
    parts = [
        "---\n" + "\n".join(lines) + "\n---",
        f"# {_plain(title)}",
        _plain(croissant.description_of(about.contents)),
        *(f"![Some of the assets, aligned, and the error of each voxel]({n})" for n in pictures),
        "## What is in it",
        "\n".join(_table(store, kept)),
        "`good`, `doubtful` and `failed` are verdicts on the alignment; `expected_accuracy` is the "
        "share of material classes that can be expected to be right, `valid_share` that of the "
        "voxels with an annotation. `confidence` and `expected_accuracy` are medians over assets.",
        "## How to read it",
        how,
        "`sha256sum --check SHA256SUMS` checks the files.",
        "## Units",
        "\n".join(_ranges(store)),
        "## Provenance",
        f"Built by slatprep {about.build.versions.get('slatprep', '')}, build "
        f"`{about.manifest[:16]}`. Every asset's record says from which files, by SHA-256, it was "
        "made, and how.",
        "## Licence",
        _plain(stated.license_url) or "Not stated: ask whoever published this before you use it.",
    ]
    if stated.cite_as:
        parts += ["## Citation", f"```\n{stated.cite_as.replace('`', chr(39))}\n```"]
    return printable("\n\n".join(parts) + "\n")


def _table(store: Store, kept: NDArray[np.bool_]) -> Iterator[str]:
    columns = {
        name: np.asarray(store.column(name))[kept]
        for name in ("category", "verdict", "confidence", "expected_accuracy", "valid_share")
    }
    columns["voxels"] = np.diff(store.offsets)[kept]
    figures = "good | doubtful | failed | confidence | expected_accuracy | valid_share"
    yield f"| category | assets | voxels | {figures} |"
    yield "| --- |" + " ---: |" * 8
    names = sorted(set(map(str, columns["category"])))
    for name in names:
        yield _row(_plain(row_of_category(name)), columns, columns["category"] == name)
    if len(names) > 1:
        yield _row("all", columns, np.ones(kept.sum(), dtype=bool))


def _row(name: str, columns: dict[str, NDArray[Any]], chosen: NDArray[np.bool_]) -> str:
    own = {column: values[chosen] for column, values in columns.items()}
    verdicts, voxels = Counter(map(str, own["verdict"])), int(own["voxels"].sum())
    counts = (len(own["verdict"]), voxels, *(verdicts[word] for word in Verdict))
    medians = (np.median(own[figure]) for figure in ("confidence", "expected_accuracy"))
    shares = (*medians, own["valid_share"] @ own["voxels"] / max(voxels, 1))
    cells = (name, *(f"{count:,}" for count in counts), *(f"{share:.3f}" for share in shares))
    return f"| {' | '.join(cells)} |"


def _ranges(store: Store) -> Iterator[str]:
    yield "| property | unit | scale | -1 is | 1 is |"
    yield "| --- | --- | --- | ---: | ---: |"
    for one, held in zip(store.normalization.ranges, store.contents.properties, strict=True):
        scale = "log10" if one.log10 else "linear"
        unit = _plain(held.sign or "1")
        yield f"| {one.name} | {unit} | {scale} | {one.lo:.6g} | {one.hi:.6g} |"


def _plain(text: str) -> str:
    """Return text as Markdown in which nothing is markup."""
    words = html.escape(" ".join(text.split()), quote=False)
    return "".join(f"\\{c}" if c in r"\`*_[]|#!" else c for c in words)

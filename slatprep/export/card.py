"""The card of a published dataset, which a hub displays and parses."""

from __future__ import annotations

import html
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.export.croissant import DESCRIPTION, Stated
from slatprep.store import Store

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
    `verdicts`, or all if it is empty.
    """
    verdict = store.column("verdict").astype(str)
    kept = np.isin(verdict, verdicts) if verdicts else np.ones(len(store), dtype=bool)
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
        DESCRIPTION,
        *(
            f"![Some of the assets, aligned, and the error of each voxel]({one})"
            for one in pictures
        ),
        "## What is in it",
        "\n".join(_table(store, kept)),
        "`good`, `doubtful` and `failed` are verdicts on the alignment; `labels_right` is the "
        "share of material classes that can be expected to be right, `valid` that of the voxels "
        "with an annotation. Confidence and `labels_right` are medians over assets.",
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
    return "\n\n".join(parts) + "\n"


def _table(store: Store, kept: NDArray[np.bool_]) -> Iterator[str]:
    columns = {
        name: np.asarray(store.column(name))[kept]
        for name in ("category", "verdict", "confidence", "expected_accuracy", "valid_share")
    }
    columns["voxels"] = np.diff(store.offsets)[kept]
    figures = ("good", "doubtful", "failed", "confidence", "labels_right", "valid")
    head = ("category", "assets", "voxels", *figures)
    yield f"| {' | '.join(head)} |"
    yield "| --- |" + " ---: |" * (len(head) - 1)
    names = sorted(set(map(str, columns["category"])))
    for name in names:
        yield _row(_plain(name) or "(unknown)", columns, columns["category"] == name)
    if len(names) > 1:
        yield _row("all", columns, np.ones(kept.sum(), dtype=bool))


def _row(name: str, columns: dict[str, NDArray[Any]], chosen: NDArray[np.bool_]) -> str:
    own = {column: values[chosen] for column, values in columns.items()}
    verdicts = Counter(map(str, own["verdict"]))
    voxels = int(own["voxels"].sum())
    valid = float(own["valid_share"] @ own["voxels"]) / max(voxels, 1)
    cells = (
        name,
        f"{np.count_nonzero(chosen):,}",
        f"{voxels:,}",
        *(f"{verdicts[verdict]:,}" for verdict in ("good", "doubtful", "failed")),
        *(f"{np.median(own[figure]):.3f}" for figure in ("confidence", "expected_accuracy")),
        f"{valid:.3f}",
    )
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

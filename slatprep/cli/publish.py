"""`slatprep publish`: write a store as a dataset for a hub."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slatprep.cli.options import (
    EXISTING_FOLDER,
    NEW_FOLDER,
    ChoiceOf,
    command,
    option,
    verdicts_option,
)
from slatprep.cli.output import Cell, Output

if TYPE_CHECKING:
    from slatprep.records import Place
    from slatprep.store import Store

_PICTURES = click.IntRange(min=0, max=60)


@command()
@click.argument("store", type=EXISTING_FOLDER)
@option("--out", NEW_FOLDER, required=True)
@option("--data", ChoiceOf("slatprep.export.publish:Data"), "store")
@verdicts_option
@option("--pictures", _PICTURES, 12, metavar="N")
@option("--name", default="")
@option("--license", default="", metavar="SPDX|URL")
@option("--url", default="")
@option("--cite-as", default="", metavar="TEXT")
@option("--dataset-version", name="version", default="1.0.0", metavar="X.Y.Z")
@option("--date-published", default="", metavar="YYYY-MM-DD")
def publish(
    output: Output,
    store: Place,
    out: Path,
    data: Any,
    verdicts: tuple[str, ...] | None,
    pictures: int,
    **stated: str,
) -> None:
    """Write STORE as a dataset for a hub, such as Hugging Face's.

    Writes a folder with the card (README.md, with statistics and a picture), the data, the
    checksum of every file and, beside a store, the description that catalogues read
    (croissant.json). Nothing is uploaded: the hub's own tool does that.

    Options
    -------
    --out: The folder; an earlier result is replaced when the new one is complete.
    --data: The store itself, which `slatprep.open_store("hf://datasets/...")` reads, or shards
        for `datasets.load_dataset`.
    --pictures: Number of assets in the card's picture.
    --name: Name of the dataset. [default: the store's]
    --license: Its licence, such as CC-BY-4.0.
    --url: Its home page.
    --cite-as: How to cite it.
    --dataset-version: Its version.
    --date-published: When it was published.

    Example
    -------
    slatprep publish data/demo.zarr --out hub --license CC-BY-4.0
    slatprep publish data/demo.zarr --out hub --data webdataset --name "My demo"
    """
    from slatprep.errors import ConfigError
    from slatprep.export.card import Stated
    from slatprep.export.publish import publish_store
    from slatprep.store import open_store

    if verdicts is not None and data == "store":
        raise ConfigError(
            "--verdict is for --data webdataset; `slatprep subset` chooses of a store"
        )
    opened = open_store(store)
    drawn = {"assets.png": _picture(opened, pictures)} if pictures and len(opened) else {}
    with output.progress("publish") as progress:
        summary = publish_store(
            store,
            out,
            data,
            stated=Stated(**stated),
            pictures=drawn,
            verdicts=verdicts,
            progress=progress,
        )
    if summary.missing:
        output.note(f"the card and catalogues also ask for {', '.join(summary.missing)}")
    cells: dict[str, Cell] = {
        "data": summary.data,
        "assets": summary.assets,
        "files": summary.files,
        "MB": summary.size / 1e6,
    }
    output.made(summary, lambda: output.record(f"Dataset in {out}", cells))
    output.note(f"next: hf upload OWNER/NAME {out} --repo-type dataset")


def _picture(store: Store, count: int) -> bytes:
    """Draw some assets, of as many categories as possible."""
    from slatprep.inspect.pictures.write import sheet_of

    seen: dict[str, int] = {}
    turns = []
    for row, category in enumerate(map(str, store.column("category"))):
        seen[category] = seen.get(category, 0) + 1
        turns.append((seen[category], row))
    return sheet_of(store, [store.ids[row] for _, row in sorted(turns)[:count]])

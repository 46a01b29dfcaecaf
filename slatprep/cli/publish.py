"""`slatprep publish`: write a store as a dataset for a hub."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import click

from slatprep.cli.options import ChoiceOf, FolderOrUrl, NewFolder, StatedOptions, UsableVerdicts
from slatprep.cli.output import Output
from slatprep.cli.signature import command

if TYPE_CHECKING:
    from slatprep.store import Store


@command()
def publish(
    output: Output,
    store: FolderOrUrl,
    *,
    out: NewFolder,
    data: Annotated[Any, ChoiceOf("slatprep.export.publish:Data")] = "store",
    verdicts: UsableVerdicts = None,
    pictures: Annotated[int, click.IntRange(0, 60)] = 12,
    stated: StatedOptions,
) -> None:
    """Write STORE as a dataset for a hub, such as Hugging Face's.

    Writes a folder with the card (README.md, with statistics and a picture), the data, the
    checksum of every file and, beside a store, the description that catalogues read
    (croissant.json). Nothing is uploaded: the hub's own tool does that.

    Parameters
    ----------
    out
        The folder; an earlier result is replaced when the new one is complete.
    data
        The store itself, which `slatprep.open_store("hf://datasets/...")` reads, or shards for
        `datasets.load_dataset`.
    pictures : N
        Number of assets in the card's picture.

    Example
    -------
    slatprep publish data/demo.zarr --out hub --license CC-BY-4.0
    slatprep publish data/demo.zarr --out hub --data webdataset --name "My demo"
    """
    from slatprep.errors import ConfigError
    from slatprep.export.croissant import Stated
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
            stated=Stated(**vars(stated)),
            pictures=drawn,
            verdicts=verdicts,
            progress=progress,
        )
    if summary.missing:
        output.note(f"the card and catalogues also ask for {', '.join(summary.missing)}")
    cells = {name: getattr(summary, name) for name in ("data", "assets", "files")}
    cells |= {"MB": summary.size / 1e6}
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

"""`slatprep publish` and `describe`: a store for hubs and catalogues of datasets."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from slatprep.cli import options
from slatprep.cli.output import Output, say
from slatprep.cli.signature import command
from slatprep.errors import ConfigError
from slatprep.storage.place import storage_of

if TYPE_CHECKING:
    from slatprep.store import Store


@command()
def publish(
    output: Output,
    store: options.FolderOrUrl,
    *,
    out: options.NewFolder,
    data: Annotated[Any, options.ChoiceOf("slatprep.export.publish:Data")] = "store",
    verdicts: options.UsableVerdicts = None,
    pictures: Annotated[int, click.IntRange(0, 60)] = 12,
    stated: options.StatedOptions,
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
    from slatprep.export.croissant import Stated
    from slatprep.export.publish import publish_store

    if verdicts is not None and data == "store":
        raise ConfigError(
            "--verdict is for --data webdataset; `slatprep subset` chooses of a store"
        )
    opened = options.opened(store)
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


_ASKED_FOR = ("license", "cite_as", "date_published")
"""Optional metadata whose absence Croissant's validator warns of."""


@command(context_settings={"show_default": False})
def describe(
    output: Output,
    store: options.FolderOrUrl,
    *,
    out: options.NewFile | None = None,
    location: str = "",
    stated: options.StatedOptions,
) -> None:
    """Describe STORE in Croissant, MLCommons' vocabulary for datasets.

    The description is JSON-LD: the files of every array, their shapes and
    meaning, the classes, the ranges of the properties, and the table of
    assets. Catalogues of datasets and the mlcroissant package read it.

    Parameters
    ----------
    out : FILE.json
        The file. [default: standard output]
    location : URL
        Where its readers will find the store. [default: its path, as seen from the description]

    Example
    -------
    slatprep describe data/demo.zarr
    slatprep describe data/demo.zarr --out demo.croissant.json --name demo
    """
    from slatprep.export import croissant
    from slatprep.storage.atomic import staged, writing

    if not location:
        local, beside = storage_of(store).local, out.parent if out else Path()
        location = Path(os.path.relpath(local, beside)).as_posix() if local else str(store)
    missing = [f"--{name.replace('_', '-')}" for name in _ASKED_FOR if not getattr(stated, name)]
    if missing:
        output.note(f"catalogues also ask for {', '.join(missing)}")
    told = croissant.Stated(**vars(stated))
    document = croissant.describe(options.opened(store), told, location.rstrip("/"))
    text = croissant.to_json(document)
    if out is None:
        say(text, nl=False)
        return
    with writing(str(out), out.parent), staged(out) as path:
        path.write_text(text, encoding="utf-8")
    output.note(f"description: {out}")

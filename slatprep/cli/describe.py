"""`slatprep describe`: a store in Croissant, for catalogues of datasets."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slatprep.cli.options import EXISTING_FOLDER, NEW_FILE, command, option
from slatprep.cli.output import Output, say
from slatprep.storage.place import storage_of

if TYPE_CHECKING:
    from slatprep.records import Place


_ASKED_FOR = ("license", "cite_as", "date_published")
"""Optional metadata whose absence Croissant's validator warns of."""


@command(context_settings={"show_default": False})
@click.argument("store", type=EXISTING_FOLDER)
@option("--out", NEW_FILE, metavar="FILE.json")
@option("--location", default="", metavar="URL")
@option("--name", default="")
@option("--license", default="", metavar="URL")
@option("--url", default="")
@option("--cite-as", default="", metavar="TEXT")
@option("--dataset-version", name="version", default="1.0.0", metavar="X.Y.Z")
@option("--date-published", default="", metavar="YYYY-MM-DD")
def describe(output: Output, store: Place, out: Path | None, location: str, **stated: str) -> None:
    """Describe STORE in Croissant, MLCommons' vocabulary for datasets.

    The description is JSON-LD: the files of every array, their shapes and
    meaning, the classes, the ranges of the properties, and the table of
    assets. Catalogues of datasets and the mlcroissant package read it.

    Options
    -------
    --out: The file. [default: standard output]
    --location: Where its readers will find the store. [default: its path, as seen from the
        description]
    --name: Name of the dataset. [default: the store's]
    --license: Its licence.
    --url: Its home page.
    --cite-as: How to cite it.
    --dataset-version: Its version. [default: 1.0.0]
    --date-published: When it was published.

    Example
    -------
    slatprep describe data/demo.zarr
    slatprep describe data/demo.zarr --out demo.croissant.json --name demo
    """
    from slatprep.export import croissant
    from slatprep.storage.atomic import staged, writing
    from slatprep.store import open_store

    if not location:
        local, beside = storage_of(store).local, out.parent if out else Path()
        location = Path(os.path.relpath(local, beside)).as_posix() if local else str(store)
    missing = [f"--{name.replace('_', '-')}" for name in _ASKED_FOR if not stated[name]]
    if missing:
        output.note(f"catalogues also ask for {', '.join(missing)}")
    document = croissant.describe(open_store(store), location=location.rstrip("/"), **stated)
    text = croissant.to_json(document)
    if out is None:
        say(text, nl=False)
        return
    with writing(str(out), out.parent), staged(out) as path:
        path.write_text(text, encoding="utf-8")
    output.note(f"description: {out}")

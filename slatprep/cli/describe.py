"""`slatprep describe`: a store in Croissant, for catalogues of datasets."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slatprep.cli.options import EXISTING_FOLDER, NEW_FILE, option
from slatprep.cli.output import Output, output_options
from slatprep.storage.place import storage_of

if TYPE_CHECKING:
    from slatprep.records import Place


@click.command(
    # What is not stated is left out: an empty default says nothing.
    context_settings={"show_default": False},
    epilog="""\b
Example:
  slatprep describe demo.zarr
  slatprep describe demo.zarr --out demo.croissant.json --name demo
""",
)
@click.argument("store", type=EXISTING_FOLDER)
@option("--out", "The file.  [default: standard output]", NEW_FILE, metavar="FILE.json")
@option(
    "--location",
    "Where its readers will find the store.  [default: its path, as seen from the description]",
    default="",
    metavar="URL",
)
@option("--name", "Name of the dataset.  [default: the store's]", default="")
@option("--license", "Its licence.", default="", name="license_", metavar="URL")
@option("--url", "Its home page.", default="")
@option("--cite-as", "How to cite it.", default="", metavar="TEXT")
@option("--dataset-version", "Its version.  [default: 1.0.0]", default="1.0.0", metavar="X.Y.Z")
@option("--date-published", "When it was published.", default="", metavar="YYYY-MM-DD")
@output_options
def describe(
    output: Output,
    store: Place,
    out: Path | None,
    location: str,
    license_: str,
    dataset_version: str,
    **stated: str,
) -> None:
    """Describe STORE in Croissant, MLCommons' vocabulary for datasets.

    The description is JSON-LD: the files of every array, their shapes and
    meaning, the classes, the ranges of the properties, and the table of
    assets. Catalogues of datasets and the mlcroissant package read it.
    """
    from slatprep.export import croissant
    from slatprep.storage.atomic import staged
    from slatprep.store import open_store

    if not location:
        local, beside = storage_of(store).local, out.parent if out else Path()
        location = Path(os.path.relpath(local, beside)).as_posix() if local else str(store)
    text = croissant.to_json(
        croissant.describe(
            open_store(store),
            location=location.rstrip("/"),
            license=license_,
            version=dataset_version,
            **stated,
        )
    )
    if out is None:
        click.echo(text, nl=False)
        return
    with staged(out) as path:
        path.write_text(text, encoding="utf-8")
    output.note(f"description: {out}")

"""`slatprep describe`: a store in Croissant, for catalogues of datasets."""

from __future__ import annotations

import os
from pathlib import Path

import click

from slatprep.cli.options import STORE
from slatprep.cli.output import Output, output_options


@click.command(
    epilog="""\b
Example:
  slatprep describe demo.zarr
  slatprep describe demo.zarr --out demo.croissant.json --name demo
"""
)
@click.argument("store", type=STORE)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE.json",
              help="Where to write it.  [default: standard output]")  # fmt: skip
@click.option("--location", default="", metavar="URL", help="Where its readers will find the "
              "store.  [default: its path, as seen from the description]")  # fmt: skip
@click.option("--name", default="", help="Name of the dataset.  [default: the store's]")
@click.option("--license", "license_", default="", metavar="URL", help="Its licence.")
@click.option("--url", default="", help="Its home page.")
@click.option("--cite-as", default="", metavar="TEXT", help="How to cite it.")
@click.option("--dataset-version", default="1.0.0", show_default=True, metavar="X.Y.Z",
              help="Its version.")  # fmt: skip
@click.option("--date-published", default="", metavar="YYYY-MM-DD", help="When it was published.")
@output_options
def describe(
    output: Output,
    store: Path,
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
        location = Path(os.path.relpath(store, out.parent if out else Path())).as_posix()
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

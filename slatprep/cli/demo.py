"""`slatprep make-demo`: procedural assets with known truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import click

from slatprep.cli.options import jobs_option
from slatprep.cli.output import Output, output_options


@click.command(
    name="make-demo",
    epilog="""\b
Example:
  slatprep make-demo demo --assets 14 --seed 0
  slatprep make-demo hard --assets 6 --seed 1 --level 3 --level 4
  slatprep make-demo other --assets 4 --seed 2 --grid-form prediction --slat-form hdf5
""",
)
@click.argument("directory", type=click.Path(path_type=Path, file_okay=False))
@click.option("--assets", type=click.IntRange(min=1), default=25, show_default=True,
              help="Number of objects; fourteen hold every category once.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True,
              help="Seed of everything random; the same seed gives the same bytes.")  # fmt: skip
@click.option("--level", "levels", type=click.IntRange(0, 4), multiple=True,
              help="Difficulty, 0 (quarter turns) to 4 (warped); may be repeated, levels take "
              "turns.  [default: all]")  # fmt: skip
@click.option("--views", type=click.IntRange(min=1), default=1, show_default=True,
              help="SLATs of each object.")  # fmt: skip
@click.option("--habitual-share", type=click.FloatRange(0, 1), default=0.0, show_default=True,
              help="Share of the objects that have one quarter turn in common.")  # fmt: skip
@click.option("--latents", type=click.Choice(["placeholder", "material"]), default="placeholder",
              show_default=True, help="What the latents are made of: noise with TRELLIS's "
              "statistics, or something that depends on the material.")  # fmt: skip
@click.option("--grid-form", type=click.Choice(["raw", "prediction", "prediction-ids"]),
              default="raw", show_default=True,
              help="Raw grids, or predictions of 11 or 4 channels.")  # fmt: skip
@click.option("--slat-form", type=click.Choice(["npz", "npz-batch", "hdf5", "hdf5-groups"]),
              default="npz", show_default=True,
              help="Files of (N,3) or (N,4) coordinates, HDF5, or one HDF5 for all.")  # fmt: skip
@click.option("--slat-names", type=click.Choice(["id", "sha256"]), default="id", show_default=True,
              help="Name SLATs by object, or by sha256 with a metadata.csv.")  # fmt: skip
@jobs_option
@output_options
def make_demo(output: Output, directory: Path, levels: tuple[int, ...], **recipe: Any) -> None:
    """Make procedural assets with known truth in DIRECTORY.

    Writes pixieverse/, slat/ and truth/ in the layouts that build-store reads,
    and dataset.toml, their definition for build-store --config. DIRECTORY must
    be new, empty, or hold the same demo.
    """
    from slatprep import demo

    if levels:
        recipe["levels"] = tuple(sorted(set(levels)))
    with output.progress("demo") as progress:
        summary = demo.make_demo(directory, progress=progress, **recipe)

    def show() -> None:
        output.table(
            f"Demo data in {summary.directory}",
            ("category", "objects"),
            sorted(summary.categories.items()),
        )
        output.note(
            f"next: slatprep build-store --config {summary.config} --out {summary.directory}.zarr"
        )

    output.result(dataclasses.asdict(summary), show)

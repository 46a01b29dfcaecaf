"""`slatprep make-demo`: procedural assets with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from slatprep.cli.options import NEW_FOLDER, POSITIVE, ChoiceOf, jobs_option, option
from slatprep.cli.output import Output, output_options


@click.command(
    name="make-demo",
    epilog="""\b
Example:
  slatprep make-demo demo --assets 14 --seed 0
  slatprep make-demo hard --assets 6 --seed 1 --level 3 --level 4
  slatprep make-demo shapes --assets 6 --seed 1 --level 5 --level 6 --level 7
  slatprep make-demo other --assets 4 --seed 2 --grid-form prediction --slat-form hdf5
""",
)
@click.argument("directory", type=NEW_FOLDER)
@option("--assets", "Objects; fourteen hold every category once.", POSITIVE, 25)
@option("--seed", "The same seed gives the same bytes.", click.IntRange(min=0), 0)
@option(
    "--level",
    "Difficulty, 0 (quarter turns) to 4 (warped), 5 (a generated shape), 6 (a NeRF's field), "
    "7 (both); may be repeated, levels take turns.  [default: 0 to 4]",
    click.IntRange(0, 7),
    name="levels",
    multiple=True,
)
@option("--views", "SLATs of each object.", POSITIVE, 1)
@option(
    "--habitual-share",
    "Share of the objects that have one quarter turn in common.",
    click.FloatRange(0, 1),
    0.0,
)
@option(
    "--latents",
    "What the latents are made of: noise with TRELLIS's statistics, or something that "
    "depends on the material.",
    ChoiceOf("slatprep.demo.latents:LatentKind"),
    "placeholder",
)
@option(
    "--grid-form",
    "Raw grids, or predictions of 11 or 4 channels.",
    ChoiceOf("slatprep.demo.write:GridForm"),
    "raw",
)
@option(
    "--slat-form",
    "Files of (N,3) or (N,4) coordinates, HDF5, or one HDF5 for all.",
    ChoiceOf("slatprep.demo.write:SlatForm"),
    "npz",
)
@option(
    "--slat-names",
    "Name SLATs by object, or by sha256 with a metadata.csv.",
    ChoiceOf("slatprep.demo.write:SlatNames"),
    "id",
)
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

    output.result(summary, show)

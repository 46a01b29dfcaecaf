"""`slatprep make-demo`: procedural assets with known truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click

from slatprep.cli.output import Output, output_options


@click.command(
    name="make-demo",
    epilog="""\b
Example:
  slatprep make-demo demo --assets 12 --seed 0
  slatprep make-demo demo --assets 6 --seed 1 --level 0 --level 3
""",
)
@click.argument("directory", type=click.Path(path_type=Path, file_okay=False))
@click.option("--assets", type=click.IntRange(min=1), default=24, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option(
    "--level",
    "levels",
    type=click.IntRange(0, 4),
    multiple=True,
    help="Difficulty, 0 (quarter turns) to 4 (warped); may be repeated.  [default: all]",
)
@output_options
def make_demo(
    output: Output, directory: Path, assets: int, seed: int, levels: tuple[int, ...]
) -> None:
    """Make procedural assets with known truth in DIRECTORY.

    Writes DIRECTORY/pixieverse, DIRECTORY/slat and DIRECTORY/truth, in the
    layouts that build-store reads. The same seed gives the same bytes.
    """
    from slatprep import demo

    chosen = {"levels": tuple(sorted(set(levels)))} if levels else {}
    with output.progress("demo") as progress:
        summary = demo.make_demo(directory, assets, seed, progress=progress, **chosen)
    document = {"directory": directory, **dataclasses.asdict(summary)}

    def show() -> None:
        click.echo(f"{assets} assets in {directory}")
        click.echo(
            f"next: slatprep build-store --pixieverse {directory / 'pixieverse'}"
            f" --slat {directory / 'slat'} --out {directory}.zarr"
        )

    output.result(document, show)

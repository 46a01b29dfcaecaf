"""`slatprep bench read`: how fast random whole assets can be read."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slatprep.cli.options import chosen_store, store_argument
from slatprep.cli.output import Output, output_options

if TYPE_CHECKING:
    from slatprep.bench.read import ReadBench


@click.command(
    "read",
    epilog="""\b
Example:
  slatprep bench read data/demo.zarr
  slatprep bench read data/demo.zarr --assets 400 --repeats 9
""",
)
@store_argument
@click.option("--assets", type=click.IntRange(min=1), help="At most so many.  [default: all]")
@click.option("--repeats", type=click.IntRange(min=1), default=5, show_default=True)
@click.option("--seed", type=int, default=0, show_default=True, help="Of the order of reading.")
@output_options
def read(output: Output, store: Path | None, assets: int | None, repeats: int, seed: int) -> None:
    """Read shuffled whole assets (coords, feats, properties) as training does.

    Compares slatprep's reader with npz (one file an asset, plain and
    compressed), one HDF5 file, zarr-python, and zarrs and tensorstore where
    they are installed. 'cold' is after asking the system to forget the files.
    """
    path = chosen_store(store)
    from slatprep.bench.read import bench_read

    with (
        tempfile.TemporaryDirectory(dir=path.resolve().parent) as temporary,
        output.progress("passes") as progress,
    ):
        result = bench_read(
            path, Path(temporary), limit=assets, repeats=repeats, seed=seed, progress=progress
        )
    output.result(dataclasses.asdict(result), lambda: _show(output, result))


def _show(output: Output, result: ReadBench) -> None:
    output.table(
        f"Assets a second, {result.assets} assets of {result.voxels // result.assets} voxels, "
        f"best of {result.repeats} (processor ms an asset and its ratio to npz: medians)",
        ("way", "MB", "files", "warm", "warm, two", "cold", "ms", "ratio"),
        [
            (way.name, round(way.size / 1e6, 1), way.files, round(way.warm),
             round(way.warm_two), None if way.cold is None else round(way.cold),
             round(way.seconds * 1e3, 3), round(way.ratio, 2))
            for way in result.ways
        ],
    )  # fmt: skip
    for name in result.left_out:
        output.note(f"{name}: not installed")

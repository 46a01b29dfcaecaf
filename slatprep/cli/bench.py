"""`slatprep bench`: measurements that anyone can repeat."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slatprep.cli.bench_read import read
from slatprep.cli.output import Output, output_options

if TYPE_CHECKING:
    from slatprep.bench.align import AlignBench

_ENGINES = ("field", "small_gicp", "open3d", "open3d-64")


@click.group(
    epilog="""\b
Example:
  slatprep bench align
"""
)
def bench() -> None:
    """Measure slatprep on this machine, side by side with what else there is."""


bench.add_command(read)


@bench.command(
    "align",
    epilog="""\b
Example:
  slatprep bench align --assets 14 --repeats 3
  slatprep bench align --data demo --engine field --engine open3d-64
""",
)
@click.option(
    "--data",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="DIR",
    help="Folder with pixieverse/, slat/ and truth/, or of such folders.  [default: demo data]",
)
@click.option(
    "--engine",
    "engines",
    multiple=True,
    type=click.Choice(_ENGINES),
    help="Engine to measure; may be repeated.  [default: all]",
)
@click.option(
    "--assets",
    type=click.IntRange(min=1),
    help="At most so many assets of each folder.  [default: 25 of the demo, all of --data]",
)
@click.option("--repeats", type=click.IntRange(min=1), default=3, show_default=True)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the demo data.")
@output_options
def align(
    output: Output,
    data: Path | None,
    engines: tuple[str, ...],
    assets: int | None,
    repeats: int,
    seed: int,
) -> None:
    """Align assets with known truth by each engine; print accuracy and time.

    Times are processor seconds of one thread, an asset; every engine aligns
    each asset in turn. open3d-64 is the paper's protocol as published, open3d
    the same without repeated rotations (the preset 'paper'), small_gicp GICP
    from the same rotations, field the default engine.
    """
    from slatprep.bench.align import bench_align
    from slatprep.demo import make_demo

    with tempfile.TemporaryDirectory() as temporary, output.progress("alignments") as progress:
        if data is None:
            data = Path(temporary) / "demo"
            make_demo(data, assets or 25, seed)
        result = bench_align(
            data, engines=engines or _ENGINES, repeats=repeats, limit=assets, progress=progress
        )
    output.result(dataclasses.asdict(result), lambda: _show(output, result))


def _show(output: Output, result: AlignBench) -> None:
    output.table(
        f"Accuracy, non-symmetric of {result.assets} assets (displacement in voxels)",
        ("engine", "level", "assets", "success", "displacement", "p90", "labels", "truth's own"),
        [
            (e.engine, f"L{s.level}", s.assets, s.success, s.displacement_median,
             s.displacement_p90, s.label_accuracy, s.truth_own)
            for e in result.engines
            for s in e.levels
        ],
    )  # fmt: skip
    output.table(
        f"Processor seconds an asset, {result.repeats} repeats "
        "(5-95: percentiles; ratio: over the default engine's, pair by pair)",
        ("engine", "median", "5-95", "ratio", "ratio 5-95", "start-up", "compiling"),
        [
            (e.engine, round(e.seconds, 4), f"{e.seconds_low:.3f}-{e.seconds_high:.3f}",
             round(e.ratio, 1), f"{e.ratio_low:.1f}-{e.ratio_high:.1f}", round(e.start_up, 1),
             round(e.compiling, 1))
            for e in result.engines
        ],
    )  # fmt: skip
    output.note(
        f"the floor: reading both files {result.reading * 1e3:.1f} ms, "
        f"their distance fields {result.fields * 1e3:.1f} ms"
    )

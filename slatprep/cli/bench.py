"""`slatprep bench`: measurements that anyone can repeat."""

from __future__ import annotations

import tempfile
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from slatprep.cli.options import ChoiceOf, Folder, LastStore, Positive
from slatprep.cli.output import Output
from slatprep.cli.signature import Click, command
from slatprep.storage.place import storage_of

if TYPE_CHECKING:
    from slatprep.bench.align import AlignBench
    from slatprep.bench.read import ReadBench


@command("align")
def align(
    output: Output,
    *,
    data: Annotated[
        Folder | None,
        "Folder with pixieverse/, slat/ and truth/, or of such folders. [default: demo data]",
    ] = None,
    engines: Annotated[
        tuple[Any, ...],
        ChoiceOf("slatprep.bench.align:ENGINES"),
        "Engine to measure; may be repeated. [default: all that are installed]",
        Click("--engine"),
    ] = (),
    assets: Annotated[
        Positive | None, "Most assets of each folder. [default: 25 of the demo, all of --data]"
    ] = None,
    repeats: Annotated[Positive, "Number of measurements."] = 3,
    seed: Annotated[int, "Seed of the demo data."] = 0,
) -> None:
    """Align assets with known truth by each engine; print accuracy and time.

    Times are processor seconds of one thread per asset; the engines align
    each asset in turn. open3d-64 is the paper's protocol as published, open3d
    the same without repeated rotations (the preset 'paper'), small_gicp GICP
    from the same rotations, cpd-affine and cpd-deformable Coherent Point Drift
    from them, field the default engine. All but the last need extras of
    slatprep: pip install 'slatprep[bench,paper]'.

    Example
    -------
    slatprep bench align --assets 14 --repeats 3
    slatprep bench align --data demo --engine field --engine open3d-64
    """
    from slatprep.bench.align import ENGINES, bench_align, missing_extra
    from slatprep.demo import make_demo

    with tempfile.TemporaryDirectory() as temporary, output.progress("alignments") as progress:
        if data is None:
            data = Path(temporary) / "demo"
            make_demo(data, assets or 25, seed)
        result = bench_align(
            data, engines=engines, repeats=repeats, limit=assets, progress=progress
        )
    output.result(result, lambda: _show_align(output, result))
    for engine in () if engines else ENGINES:
        if extra := missing_extra(engine):
            output.note(f"{engine}: not installed, left out (pip install 'slatprep[{extra}]')")


def _show_align(output: Output, result: AlignBench) -> None:
    accuracy = attrgetter(
        "assets",
        "success",
        "displacement_median",
        "displacement_p90",
        "label_accuracy",
        "truth_own",
    )
    output.table(
        f"Accuracy, non-symmetric of {result.assets} assets (displacement in voxels)",
        ("engine", "level", "assets", "success", "displacement", "p90", "labels", "truth's own"),
        [(e.engine, f"L{s.level}", *accuracy(s)) for e in result.engines for s in e.levels],
    )
    output.table(
        f"Processor seconds an asset, {result.repeats} repeats "
        "(5-95: percentiles; ratio: over the default engine's, pair by pair)",
        ("engine", "median", "5-95", "ratio", "ratio 5-95", "start-up", "compiling"),
        [
            (
                e.engine,
                round(e.seconds, 4),
                f"{e.seconds_low:.3f}-{e.seconds_high:.3f}",
                round(e.ratio, 1),
                f"{e.ratio_low:.1f}-{e.ratio_high:.1f}",
                round(e.start_up, 1),
                round(e.compiling, 1),
            )
            for e in result.engines
        ],
    )
    output.note(
        f"for comparison: reading both files {result.reading * 1e3:.1f} ms, "
        f"their distance fields {result.fields * 1e3:.1f} ms"
    )


@command("read")
def read(
    output: Output,
    store: LastStore,
    *,
    assets: Annotated[Positive | None, "Most assets to read. [default: all]"] = None,
    repeats: Annotated[Positive, "Number of measurements."] = 5,
    seed: Annotated[int, "Seed of the order of reading."] = 0,
) -> None:
    """Read shuffled whole assets (coords, feats, properties) as training does.

    Compares slatprep's reader with npz (one file an asset, plain and
    compressed), one HDF5 file, zarr-python, and zarrs and tensorstore where
    they are installed. 'cold' is after asking the system to drop the files from its cache.

    Example
    -------
    slatprep bench read data/demo.zarr
    slatprep bench read data/demo.zarr --assets 400 --repeats 9
    """
    path = storage_of(store).local
    if path is None:
        raise click.UsageError(f"{store}: expected a store on the local disk")
    from slatprep.bench.read import bench_read

    with (
        tempfile.TemporaryDirectory(dir=path.resolve().parent) as temporary,
        output.progress("passes") as progress,
    ):
        result = bench_read(
            path, Path(temporary), limit=assets, repeats=repeats, seed=seed, progress=progress
        )
    output.result(result, lambda: _show_read(output, result))


def _show_read(output: Output, result: ReadBench) -> None:
    output.table(
        f"Assets a second, {result.assets} assets of {result.voxels // result.assets} voxels, "
        f"best of {result.repeats} (processor ms an asset and its ratio to npz: medians)",
        ("way", "MB", "files", "warm", "warm, two", "cold", "ms", "ratio"),
        [
            (
                way.name,
                round(way.size / 1e6, 1),
                way.files,
                round(way.warm),
                round(way.warm_two),
                None if way.cold is None else round(way.cold),
                round(way.seconds * 1e3, 3),
                round(way.ratio, 2),
            )
            for way in result.ways
        ],
    )
    for name in result.left_out:
        output.note(f"{name}: not installed")


bench = click.Group(
    "bench",
    commands=[align, read],
    help="Measure slatprep on this machine, side by side with the alternatives.",
    epilog="\b\nExample:\n  slatprep bench align",
)

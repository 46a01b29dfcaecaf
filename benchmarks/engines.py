"""Compare alignment engines: whether they are right, how exact and how fast they are.

    python benchmarks/engines.py --data DIR --engine field --engine open3d-64

For each asset all engines run in turn, so that a machine that slows down
slows all of them; times are CPU seconds of one thread.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Annotated

import click
import numpy as np
from numpy.typing import NDArray

from slatprep.align import align
from slatprep.align.starts import euler_starts
from slatprep.align.surface import surface_of
from slatprep.cli.options import Folder, Positive
from slatprep.cli.output import Output
from slatprep.cli.signature import Click, command
from slatprep.demo import make_demo
from slatprep.errors import ConfigError, SlatprepError
from slatprep.geometry.deformation import map_of
from slatprep.geometry.voxels import occupancy_of
from slatprep.inspect.score import LevelScore, TruthScore, compare_with_truth, read_truth, summarise
from slatprep.parameters import PRESETS, AlignParameters
from slatprep.parameters.files import load_parameters
from slatprep.readers import discover, read_field, read_latents
from slatprep.records import Alignment, AssetPair, Engine, MaterialField, StructuredLatents
from slatprep.sample import sample
from slatprep.workers import Progress
from slatprep.workers.local import single_threaded

ENGINES = ("field", "cpd-affine", "cpd-deformable", "small_gicp", "open3d", "open3d-64")
"""The default engine; from the same 24 rotations Coherent Point Drift, affine and
deformable, and GICP; the paper's protocol without repeated rotations (``--preset
paper``), and as published."""

_NEEDS = {
    "cpd-affine": ("pycpd", "bench"),
    "cpd-deformable": ("pycpd", "bench"),
    "small_gicp": ("small_gicp", "bench"),
    "open3d": ("open3d", "paper"),
    "open3d-64": ("open3d", "paper"),
}
"""The package that an engine needs, and the extra that installs it."""

REFERENCE = "field"


@dataclass(frozen=True)
class EngineResult:
    """What one engine did with all assets.

    Attributes
    ----------
    engine : str
        One of `ENGINES`.
    seconds : float
        Median processor seconds an asset, over assets and repeats.
    seconds_low, seconds_high : float
        5th and 95th percentile of the same.
    ratio, ratio_low, ratio_high : float
        Median, 5th and 95th percentile of the engine's time over the default
        engine's, pair by pair on the same asset in the same repeat.
    start_up, compiling : float
        Wall seconds of import and first alignment in a new process, with
        compiled code at hand, and what compiling it the first time adds.
    levels : tuple of LevelScore
        Accuracy over the assets that have one right placement only.
    """

    engine: str
    seconds: float
    seconds_low: float
    seconds_high: float
    ratio: float
    ratio_low: float
    ratio_high: float
    start_up: float
    compiling: float
    levels: tuple[LevelScore, ...]


@dataclass(frozen=True)
class AlignBench:
    """Result of `bench_align`; `reading` and `fields` are the floor of any method.

    Median processor seconds an asset: to read and check both files, and to
    fill both voxel sets and measure their distance fields.
    """

    assets: int
    repeats: int
    reading: float
    fields: float
    engines: tuple[EngineResult, ...]


def installed_engines() -> tuple[str, ...]:
    """Return those of `ENGINES` whose package is installed."""
    return tuple(engine for engine in ENGINES if not missing_extra(engine))


def missing_extra(engine: str) -> str:
    """Return the extra of slatprep that an engine waits for; empty where it is installed."""
    package, extra = _NEEDS.get(engine, ("", ""))
    return extra if package and find_spec(package) is None else ""


def bench_align(
    folder: Path,
    *,
    engines: Sequence[str] = (),
    repeats: int = 3,
    limit: int | None = None,
    progress: Progress | None = None,
) -> AlignBench:
    """Align all assets of a dataset with truth by each engine.

    Parameters
    ----------
    folder : Path
        Holds ``pixieverse/``, ``slat/`` and ``truth/``, as `make_demo` writes
        them, or several such folders.
    engines : sequence of str
        Some of `ENGINES`, all that are installed where none is named; the
        default engine is always among them, and the first.
    repeats : int
        How often each asset is aligned by each engine.
    limit : int, optional
        At most so many assets of each folder.
    progress : callable, optional
        Called with alignments done and in all.

    Raises
    ------
    ConfigError
        If there is no asset with truth, or an engine is unknown.
    SlatprepError
        If an engine that is named is not installed.
    """
    chosen = _chosen(engines or installed_engines())
    pairs = list(pairs_with_truth(folder, limit))
    if not pairs:
        raise ConfigError(
            f"{folder}: no asset with truth; expected pixieverse/, slat/ and truth/ in it, "
            "or folders that have them"
        )
    start_up = {engine: _start_up(engine) for engine in chosen}
    seconds: dict[str, list[float]] = {engine: [] for engine in chosen}
    scores: dict[str, list[TruthScore]] = {engine: [] for engine in chosen}
    reading: list[float] = []
    fields: list[float] = []
    with single_threaded():
        _warm_up(chosen)
        for number, (pair, truth_path) in enumerate(pairs):
            truth = read_truth(truth_path)
            for repeat in range(repeats):
                with _timed(reading):
                    field, latents = read_field(pair), read_latents(pair)
                with _timed(fields):
                    surface_of(field.occupancy)
                    surface_of(occupancy_of(latents.coords, latents.resolution))
                for position, engine in enumerate(chosen):
                    with _timed(seconds[engine]):
                        places = _align(engine, field, latents)
                    if repeat == 0:
                        preset = PRESETS["default" if engine == REFERENCE else "paper"]
                        annotation = sample(field, places, preset.sample)
                        score = compare_with_truth(pair.asset_id, truth, field, latents, annotation)
                        scores[engine].append(score)
                    if progress:
                        done = (number * repeats + repeat) * len(chosen) + position + 1
                        progress(done, len(pairs) * repeats * len(chosen))
    return AlignBench(
        assets=len(pairs),
        repeats=repeats,
        reading=float(np.median(reading)),
        fields=float(np.median(fields)),
        engines=tuple(
            _result(e, seconds[e], seconds[REFERENCE], scores[e], start_up[e]) for e in chosen
        ),
    )


def _chosen(engines: Sequence[str]) -> list[str]:
    """Return engines in the order of `ENGINES`, the default one first; see `bench_align`."""
    unknown = set(engines) - set(ENGINES)
    if unknown:
        raise ConfigError(f"no engine {sorted(unknown)}; expected some of {', '.join(ENGINES)}")
    for engine in engines:
        if extra := missing_extra(engine):
            raise SlatprepError(
                f"the engine {engine} needs {_NEEDS[engine][0]}, which is not installed: "
                f"pip install 'slatprep[{extra}]'"
            )
    return [REFERENCE, *(e for e in ENGINES if e in engines and e != REFERENCE)]


@contextmanager
def _timed(into: list[float]) -> Iterator[None]:
    """Append the processor seconds of what is done within."""
    begin = time.process_time()
    yield
    into.append(time.process_time() - begin)


def pairs_with_truth(folder: Path, limit: int | None = None) -> Iterator[tuple[AssetPair, Path]]:
    """Yield the assets of a dataset that have a truth, and where it is.

    Parameters
    ----------
    folder : Path
        Holds ``pixieverse/``, ``slat/`` and ``truth/``, or several such folders.
    limit : int, optional
        At most so many assets of each folder.
    """
    folders = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    for root in folders:
        if not (root / "truth").is_dir():
            continue
        parameters = load_parameters(
            None, {side: {"root": str(root / side)} for side in ("pixieverse", "slat")}
        )
        found = (
            (pair, truth)
            for pair in discover(parameters)
            if not pair.problem and (truth := root / "truth" / f"{pair.asset_id}.npz").exists()
        )
        yield from islice(found, limit)


def _align(engine: str, field: MaterialField, latents: StructuredLatents) -> NDArray[np.float64]:
    """Return where an engine's map leads the SLAT's voxels, (N, 3) in the PixieVerse frame."""
    if engine.startswith("cpd-"):
        from cpd import cpd_places

        return cpd_places(field, latents, deformable=engine == "cpd-deformable")
    return map_of(_aligned(engine, field, latents)).to_pixieverse(latents.centres)


def _aligned(engine: str, field: MaterialField, latents: StructuredLatents) -> Alignment:
    if engine == "open3d-64":
        from slatprep.align import open3d_icp

        return open3d_icp.align(field, latents, PRESETS["paper"].align, starts=euler_starts())
    if engine == "open3d":
        return align(field, latents, PRESETS["paper"].align)
    if engine == "small_gicp":
        return align(field, latents, AlignParameters(engine=Engine.SMALL_GICP, model="rigid"))
    return align(field, latents, PRESETS["default"].align)


def _small_asset() -> tuple[MaterialField, StructuredLatents]:
    occupancy = np.zeros((64, 64, 64), dtype=bool)
    occupancy[20:40, 24:36, 28:40] = True
    voxels = np.argwhere(occupancy).astype(np.uint8)
    material = np.zeros(len(voxels), dtype=np.uint8)
    properties = np.ones((len(voxels), 3), dtype=np.float32)
    field = MaterialField(occupancy, voxels, material, properties)
    return field, StructuredLatents(voxels, np.zeros((len(voxels), 8), dtype=np.float32))


def _warm_up(engines: Sequence[str]) -> None:
    field, latents = _small_asset()
    for engine in engines:
        _align(engine, field, latents)


def _start_up(engine: str) -> tuple[float, float]:
    """Wall seconds of import and first alignment in a new process, and of compiling besides."""
    code = (
        "import time; begin = time.perf_counter()\n"
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import engines\n"
        f"engines._align({engine!r}, *engines._small_asset())\n"
        "print(time.perf_counter() - begin)"
    )
    times = []
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache, "OMP_NUM_THREADS": "1"}
        for _ in range(2):
            printed = subprocess.check_output(
                [sys.executable, "-c", code], env=environment, stderr=subprocess.PIPE, text=True
            )
            times.append(float(printed.splitlines()[-1]))
    cold, warm = times
    return warm, max(cold - warm, 0.0)


def _result(
    engine: str,
    seconds: list[float],
    reference: list[float],
    scores: list[TruthScore],
    start_up: tuple[float, float],
) -> EngineResult:
    low, middle, high = np.percentile(seconds, [5, 50, 95]).tolist()
    ratios = np.divide(seconds, reference)
    ratio_low, ratio, ratio_high = np.percentile(ratios, [5, 50, 95]).tolist()
    spread = middle, low, high, ratio, ratio_low, ratio_high
    return EngineResult(engine, *spread, *start_up, levels=summarise(scores))


@command("engines")
def main(
    output: Output,
    *,
    data: Annotated[
        Folder | None,
        "Folder with pixieverse/, slat/ and truth/, or of such folders. [default: demo data]",
    ] = None,
    engines: Annotated[
        tuple[str, ...],
        click.Choice(ENGINES),
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
    python benchmarks/engines.py --assets 14 --repeats 3
    python benchmarks/engines.py --data demo --engine field --engine open3d-64
    """
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


if __name__ == "__main__":
    main()

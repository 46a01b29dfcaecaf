"""`slatprep train`, `predict` and `evaluate`: a decoder, its predictions, and their errors."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import click

from slatprep.cli import options
from slatprep.cli.latents import LatentsReader, Standardised
from slatprep.cli.output import Output, write_csv
from slatprep.cli.signature import Click, command
from slatprep.errors import ConfigError, InputError

if TYPE_CHECKING:
    from slatprep.extract import Session
    from slatprep.learn.compare import Comparison
    from slatprep.learn.metrics import Evaluation, Measure, Measures
    from slatprep.learn.published import PublishedScore
    from slatprep.learn.runs import EpochRecord
    from slatprep.learn.train import TrainSummary
    from slatprep.records import Place

_SIZES = ("small", "medium", "large")

_PAPER: dict[str, Any] = {"steps": 2000, "accumulate": 4}
"""What `--preset paper` sets; the other parameters of the paper are the defaults."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """What `TrainParameters` takes as it is given.

    Attributes
    ----------
    epochs
        Passes over the training objects.
    steps
        Steps of the optimiser, instead of --epochs; the last pass may be incomplete.
    batch_size
        Assets in a batch.
    accumulate
        Batches per step of the optimiser.
    learning_rate
        Initial learning rate of AdamW; a cosine schedule lowers it to 0.
    precision
        bf16: mixed precision; auto: bf16 if the processor has instructions for it, else fp32.
    keep
        Weights of the epoch with the least validation loss, or of the last epoch.
    patience
        Stop after this number of epochs without a better validation loss.
    augmentation
        Symmetries to draw from: 8 that keep z up, or all 48 of the cube.
    max_ambiguity
        Leave out assets that are more ambiguous.
    weigh_by_confidence
        Weight voxels by the probability that their class is right.
    seed
        Seed of initial weights, order and augmentation.
    """

    epochs: options.Positive = 100
    steps: options.Positive | None = None
    batch_size: options.Positive = 1
    accumulate: options.Positive = 1
    learning_rate: options.Above0 = 0.0001
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    keep: Literal["best", "last"] = "best"
    patience: options.Positive = 10
    augmentation: Annotated[
        Any, options.ChoiceOf("slatprep.learn.augment:Augmentation"), Click("--augment")
    ] = "none"
    max_ambiguity: Annotated[float | None, options.FiniteRange(min=0)] = None
    weigh_by_confidence: bool = False
    seed: int = 0


@command()
def train(
    output: Output,
    store: options.FolderOrUrl,
    *,
    out: options.NewFolder,
    size: Literal["small", "medium", "large"] = "large",
    all_sizes: bool = False,
    preset: Literal["default", "paper"] = "default",
    training: TrainingOptions,
    verdicts: options.UsableVerdicts = None,
    splits: options.SplitOptions,
    device: Literal["cpu", "cuda"] = "cpu",
    workers: Annotated[int, click.IntRange(min=0)] = 0,
    threads: options.Positive | None = None,
) -> None:
    """Train SLAT-Phys's decoder on STORE.

    Writes run.json, log.csv, curve.png, checkpoints and the predictions of
    the test objects, which `slatprep evaluate` measures. Needs PyTorch:
    pip install 'slatprep[train]'.

    Parameters
    ----------
    out
        Folder of the run; a stopped run is resumed.
    size
        0.20, 1.19 or 6.32 million weights.
    all_sizes
        Train all three, each in a folder of its own.
    preset
        paper: 2,000 steps, and 4 accumulated batches a step, whose number the paper does not give.
        Options that are given count more.
    device
        Where to compute.
    workers
        Processes that read ahead.
    threads
        Threads to compute with. [default: all cores]

    Example
    -------
    slatprep train data/demo.zarr --out runs/small --size small --epochs 8 --learning-rate 0.003
    slatprep train data/demo.zarr --out runs/sizes --all-sizes
    slatprep train data/demo.zarr --out runs/large --preset paper --split-by test_set.json
    """
    from slatprep.learn import require_torch

    require_torch(device)
    import torch

    from slatprep.learn.runs import LAST
    from slatprep.learn.train import TrainParameters
    from slatprep.learn.train import train as run
    from slatprep.records import USABLE, Verdict
    from slatprep.storage.atomic import writing

    source = click.get_current_context().get_parameter_source
    given = {
        name: source(name) is not click.core.ParameterSource.DEFAULT for name in ("epochs", *_PAPER)
    }
    if training.steps and given["epochs"]:
        raise click.UsageError("--epochs and --steps both say when to end; give one of them")
    if preset == "paper":
        own = {name: value for name, value in _PAPER.items() if not given[name]}
        if given["epochs"]:
            own.pop("steps", None)
        training = dataclasses.replace(training, **own)
    torch.set_num_threads(threads or os.cpu_count() or 1)
    opened, rule = options.opened(store), splits.rule
    options.split_of_objects(output, opened, rule, f"by {rule['by']}")
    if verdicts is None:
        verdicts = USABLE
        options.note_left_out(output, opened)
    chosen = TrainParameters(
        size=size,
        split_by=rule["by"],
        shares=rule["shares"],
        verdicts=verdicts or tuple(Verdict),
        **vars(training),
    )
    runs = {name: out / name for name in _SIZES} if all_sizes else {size: out}
    summaries = {}
    for name, directory in runs.items():
        output.if_stopped = (
            "the same command goes on from the last checkpoint, at most 30 s and a step ago"
        )
        if (directory / LAST).exists():
            output.note(f"resumed: from {directory / LAST}; steps are counted from there")
        with (
            writing(str(directory), directory.parent),
            output.progress(f"train {name}", "steps") as steps,
        ):
            summaries[name] = run(
                store,
                directory,
                dataclasses.replace(chosen, size=name),
                device=device,
                workers=workers,
                steps=steps,
                progress=partial(_tell_epoch, output, name),
            )
    output.made({"runs": summaries}, lambda: _show_training(output, summaries))
    output.note(f"runs:    {', '.join(str(directory) for directory in runs.values())}")
    first = next(iter(summaries.values()))
    output.note(f"next:    slatprep evaluate {first.predictions} --store {store}")


def _tell_epoch(output: Output, name: str, record: EpochRecord) -> None:
    told = f"{name}, epoch {record.epoch}: train loss {record.train_loss:.4f}"
    if not math.isnan(record.val_loss):
        told += (
            f", validation loss {record.val_loss:.4f}, MSE {record.val_mse:.4f}, "
            f"accuracy {record.val_accuracy:.3f}"
        )
    output.note(told)
    output.if_stopped = (
        f"epochs up to {record.epoch} are kept, and the steps since then but for the last 30 s; "
        "the same command goes on from there"
    )


def _show_training(output: Output, summaries: dict[str, TrainSummary]) -> None:
    best = {name: summary.history[summary.best_epoch] for name, summary in summaries.items()}
    references = next(iter(summaries.values())).references
    output.table(
        "Validation (mean squared error in normalised space, mean over assets)",
        ("model", "epoch", "mse", "accuracy"),
        [
            *((f"decoder, {n}", e.epoch, e.val_mse, e.val_accuracy) for n, e in best.items()),
            *((name, None, error, None) for name, error in references.items()),
        ],
    )


_IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".bmp")


@command()
def predict(
    output: Output,
    source: options.FileOrUrl,
    *,
    checkpoint: options.FileOrFolder,
    out: options.NewFolder,
    assets: options.AssetIds = (),
    gaussians: options.NewFile | None = None,
    seed: options.Seed = 42,
    far: Annotated[Any, options.ChoiceOf("slatprep.particles.transfer:Far")] = "background",
    device: Literal["cpu", "cuda"] | None = None,
    batch_voxels: options.Positive = 65536,
    standardised: Standardised = "auto",
) -> None:
    """Predict material fields of SOURCE with a trained decoder.

    SOURCE is a SLAT (npz or HDF5), a folder of them, a store, or an image,
    whose latents TRELLIS samples if it is installed. Each asset gives
    <id>.npz with coords, properties in [-1,1] and properties_si in Pa,
    kg/m^3 and 1, material, probabilities of the eight classes, ranges, the
    checkpoint's SHA-256 and the seconds of its decoding. `slatprep evaluate`
    and `slatprep transfer --prediction` read these files.
    Needs PyTorch: pip install 'slatprep[train]'.

    Parameters
    ----------
    checkpoint
        best.pt of a run of `slatprep train`, or the folder of the run.
    out
        Folder of the predictions; files of other assets are kept.
    assets
        Predict only this asset; may be repeated.
    gaussians : FILE.ply
        Also decode an image's latents to Gaussians, and write those with their materials.
    seed
        Seed of an image's latents.
    far
        With --gaussians: give far Gaussians class 7 and properties 0, leave them out, or give them
        the nearest material.
    device
        Where to compute. [default: cpu; for an image the GPU if there is one]
    batch_voxels
        Number of voxels up to which assets are decoded together.

    Example
    -------
    slatprep predict latents --checkpoint runs/small --out predictions
    slatprep predict data/demo.zarr --checkpoint runs/small/best.pt --out predictions --device cuda
    slatprep predict cup.png --checkpoint runs/large --out cup --gaussians cup.ply --device cuda
    """
    from slatprep.learn import require_torch

    is_image = source.suffix.lower() in _IMAGES
    require_torch(device or "cpu")
    import torch

    if device is None:
        # TRELLIS needs a GPU.
        device = "cuda" if is_image and torch.cuda.is_available() else "cpu"
        if is_image:
            output.note(f"TRELLIS and the decoder run on {device}")
    from slatprep.learn import predict as work
    from slatprep.learn.published import SECONDS, SECONDS_OF_OTHERS

    if gaussians is not None and not is_image:
        raise ConfigError(
            "--gaussians goes with an image; `slatprep decode-slat` makes Gaussians of latents, "
            "and `slatprep transfer` gives them materials"
        )
    decoder = work.load_checkpoint(checkpoint, device)
    image = _sample_latents(output, source, out, seed, device) if is_image else None
    space = decoder.contents.latents
    if image is not None:
        standardised = "no"  # TRELLIS samples them as its decoders take them.
    read = LatentsReader(output, image.latents if image else source, assets, space, standardised)
    counts = {"predicted": 0, "voxels": 0}
    seconds = {**(image.seconds if image else {}), "read": 0.0, "decode": 0.0, "write": 0.0}
    with output.progress("predict") as progress:
        progress(0, len(read.ids))
        for number, field in enumerate(work.predict(decoder, read, batch_voxels=batch_voxels)):
            begin = time.perf_counter()
            try:
                work.write_prediction(out, read.done[number], field, decoder)
            except InputError as error:
                read.leave_out(error)
            else:
                counts["predicted"] += 1
                counts["voxels"] += len(field.coords)
            seconds["write"] += time.perf_counter() - begin
            seconds["decode"] += field.seconds
            progress(counts["predicted"] + len(read.problems), len(read.ids))
    seconds["read"] = read.seconds
    if image and gaussians is not None and counts["predicted"]:
        begin = time.perf_counter()
        _write_gaussians(output, image, out, gaussians, far)
        seconds["gaussians"] = time.perf_counter() - begin
    about = {"path": out, "checkpoint": decoder.sha256, "size": decoder.size}

    def show() -> None:
        output.record(f"Predictions in {out}", counts)
        each = 1e3 / max(counts["predicted"], 1)
        stages = {**seconds, "in all": sum(seconds.values())}
        columns, shown = ("stage", "seconds", "ms an asset", "SLAT-Phys, s"), 4 if image else 3
        rows = [(name, s, s * each, SECONDS.get(name, ""))[:shown] for name, s in stages.items()]
        output.table("Time", columns[:shown], rows)
        if image:
            others = ", ".join(
                f"{name} {spent:,.0f} s" for name, spent in SECONDS_OF_OTHERS.items()
            )
            output.note(f"SLAT-Phys's times are of an A5000; it prints beside them: {others}")

    document = {**about, **counts, "seconds": seconds, "problems": read.problems}
    output.made(document, show, complete=not read.problems)


@dataclass(frozen=True)
class _Image:
    """Latents of an image: their file, the pipeline that sampled them, and time by stage."""

    latents: Path
    session: Session
    seconds: Mapping[str, float]


def _sample_latents(output: Output, source: Place, out: Path, seed: int, device: str) -> _Image:
    """Sample the latents of an image."""
    from slatprep import extract as work

    session = work.load_session(device=device)
    extractions = work.list_extractions([Path(str(source))], out / "latents", [seed], False)
    (result,) = work.extract(session, extractions)
    if isinstance(result, InputError):
        raise result
    output.note(f"latents: {extractions[0].slat}{', drawn before' if result.kept else ''}")
    return _Image(extractions[0].slat, session, result.seconds)


def _write_gaussians(output: Output, image: _Image, out: Path, path: Path, far: Any) -> None:
    """Decode an image's latents to Gaussians, and give each the material of its voxel."""
    from slatprep.extract import decode_gaussians
    from slatprep.particles import transfer as work
    from slatprep.particles.fields import predicted_field
    from slatprep.particles.read import read_particles
    from slatprep.readers import read_slat
    from slatprep.storage.files import file_name

    plain = out / "gaussians.ply"
    decode_gaussians(image.session, read_slat(image.latents, image.latents.parent), plain)
    field = predicted_field(out / f"{file_name(image.latents.stem)}.npz", None)
    particles = read_particles(plain, "trellis")
    result = work.transfer(particles.in_slat(), field, far=far)
    if result.far:
        count = len(particles.positions)
        output.note(f"{result.far:,} of {count:,} Gaussians have no voxel: {far}")
    work.write_transferred(path, particles, result, max_distance=2.0, in_slat=False)


@command()
def evaluate(
    output: Output,
    predictions: options.FileOrFolder | None = None,
    *,
    store: options.FolderOrUrl,
    grids: tuple[str, ...] = (),
    split: Annotated[Any, options.ChoiceOf("slatprep.readers.splits:SPLITS", "all")] = "test",
    splits: options.SplitOptions,
    spread: Annotated[Any, options.ChoiceOf("slatprep.learn.metrics:SPREADS")] = "se",
    csv_file: Annotated[options.NewFile | None, Click("--csv")] = None,
    picture: options.NewFile | None = None,
    beside: tuple[str, ...] = (),
) -> None:
    """Measure PREDICTIONS by Pixie's protocol.

    PREDICTIONS is a folder with an npz for each asset, or a Zarr group or
    HDF5 file with a group for each asset. Each has properties (N,3) in
    normalised space, and may have material (N,) or logits (N,8), coords
    (N,3), and ranges (3,2) if they differ from the store's. Errors are means
    over valid voxels, then over objects. The exit code is 1 if an asset of
    the split has no prediction. Beside the run.json of a training, the split
    is that of the run, unless --split-by or --shares is given.

    Parameters
    ----------
    store : STORE.zarr
        The store with the labels.
    grids : [NAME=]DIR
        Grids predicted by Pixie or another method: DIR/ID/sample_0_pred.npy, of 11 or 4 channels;
        may be repeated. They are measured on their own voxels and looked up at the SLAT's, on the
        same objects as PREDICTIONS, which may be left out.
    split
        Only objects of this split.
    spread
        Standard error or standard deviation over objects, or what Pixie prints.
    csv_file
        Also write the table to this file.
    picture
        With --grids, also draw the table as a PNG.
    beside : pixie|slat-phys|FILE.csv
        Also print the published scores of Pixie (with NeRF2Physics) or of SLAT-Phys, or a CSV with
        names in the first column and columns named as here; may be repeated.

    Example
    -------
    slatprep evaluate runs/small/predictions --store data/demo.zarr
    slatprep evaluate predictions.h5 --store data/demo.zarr --split all --spread sd --csv scores.csv
    slatprep evaluate predictions --store pixieverse.zarr --split-by test_set.json
    slatprep evaluate runs/large/predictions --store pixieverse.zarr --beside pixie
    slatprep evaluate predictions --store data/demo.zarr --grids Pixie=results --picture m.png
    """
    from slatprep.learn.metrics import OURS, SPREADS, evaluate_store
    from slatprep.learn.published import TABLES, read_scores

    if predictions is None and not grids:
        raise click.UsageError("nothing to measure; give PREDICTIONS, --grids, or both")
    if picture is not None and not grids:
        raise click.UsageError("--picture draws methods side by side; give --grids as well")
    if picture is not None and picture.suffix.lower() != ".png":
        raise click.BadParameter(f"{picture} does not end in .png", param_hint="--picture")
    folders = _folders_of_grids(grids)
    others = {
        name: TABLES[name][1] if name in TABLES else read_scores(Path(name)) for name in beside
    }
    chosen = _selected(output, predictions, store, split, splits) | {"spread": spread}
    part = None if split == "all" else split
    result: Evaluation | Comparison
    baselines: Measures = {}
    if grids:
        from slatprep.learn.compare import compare_methods

        result = compare_methods(predictions, folders, store, part, **chosen)
        measures = ours = result.methods
        what, problems = "method", result.problems
        if problems:
            output.note(
                "note:    assets without a usable prediction of some method, left out of all: "
                f"{len(problems)}"
            )
        if result.partly_annotated:
            output.note(
                "note:    objects with occupied voxels that have no annotation and are not scored: "
                f"{result.partly_annotated}; Pixie's loader leaves such objects out"
            )
    else:
        result = evaluate_store(cast("Path", predictions), store, part, **chosen)
        measures = {name or "(none)": m for name, m in result.categories.items()}
        measures |= {"all": result.overall}
        ours, what = {OURS: result.overall}, "category"
        baselines = result.baselines
        problems = [f"{predictions}: no prediction of {name}" for name in result.missing]
        if result.converted:
            output.note(
                "note:    predictions normalised by other ranges, converted to the store's: "
                f"{result.converted}"
            )
    if csv_file is not None:
        _write_scores(csv_file, what, measures, spread)
    if picture is not None:
        from slatprep.learn.compare import draw_comparison

        options.draw_to(output, picture, partial(draw_comparison, measures, SPREADS[spread]))

    output.problems(problems, "--json lists them")
    document = vars(result) | {"store": store}
    if beside:
        document["beside"] = [score for scores in others.values() for score in scores]

    def show() -> None:
        names = tuple(next(iter(measures.values())).means)
        output.table(
            "Mean squared error in normalised space, class accuracy "
            f"(± {SPREADS[spread]} over n objects)",
            (what, "n", *names),
            [_row_of_scores(name, one) for name, one in (measures | baselines).items()],
        )
        if TABLES.keys() & others:
            output.note(
                "note: those beside were measured on PixieVerse's test objects; they compare only "
                "with predictions of the same objects, normalised by Pixie's ranges (--ranges "
                "pixie)"
            )
        means = {name: one.means for name, one in ours.items()}
        for name, scores in others.items():
            title = TABLES[name][0] if name in TABLES else name
            _show_beside(output, f"Beside {title}", means, scores)

    output.result(document, show, complete=not problems)


def _selected(
    output: Output, predictions: Path | None, store: Place, split: str, splits: options.SplitOptions
) -> dict[str, Any]:
    """Return the split of each object and which assets count, by the options or else by a run."""
    from slatprep.learn.predictions import selection_of_run

    filters: dict[str, Any] = {}
    rule, how = splits.rule, f"by {splits.rule['by']}"
    run = selection_of_run(predictions) if predictions and not splits.given else None
    if run is not None:
        file, rule, filters = run
        how = f"as {file} says"
    elif not splits.given:
        how += ", as no run lies beside the predictions (others: --split-by, --split all)"
    opened = options.opened(store)
    return {"splits": options.split_of_objects(output, opened, rule, f"{split}, {how}"), **filters}


def _folders_of_grids(grids: tuple[str, ...]) -> dict[str, Path]:
    """Return the folders of ``--grids`` by the method's name, by default the folder's name."""
    folders: dict[str, Path] = {}
    for text in grids:
        name, _, rest = text.rpartition("=")
        folder = Path(text) if Path(text).is_dir() else Path(rest)
        if not rest or not folder.is_dir():
            raise click.BadParameter(f"{text!r} is no folder", param_hint="--grids")
        name = folder.resolve().name if folder == Path(text) else name.strip()
        if not name:
            raise click.BadParameter(f"{text!r} has no name before =", param_hint="--grids")
        if name in folders:
            raise click.BadParameter(
                f"two folders are called {name!r}; name them apart: NAME=DIR", param_hint="--grids"
            )
        folders[name] = folder
    return folders


def _write_scores(file: Path, what: str, measures: Mapping[str, Measure], spread: str) -> None:
    metrics = next(iter(measures.values())).means
    names = (name for mean in metrics for name in (mean, f"{mean} {spread}"))
    rows = (
        (name, m.objects, *(s[key] for key in metrics for s in (m.means, m.spreads)))
        for name, m in measures.items()
    )
    write_csv(file, (what, "objects", *names), rows)


def _show_beside(
    output: Output,
    title: str,
    ours: Mapping[str, Mapping[str, float]],
    others: tuple[PublishedScore, ...],
) -> None:
    names = tuple(next(iter(ours.values())))
    means = [*ours.items(), *((score.method, score.means) for score in others)]
    rows = [(name, *map(own.get, names)) for name, own in means]
    output.table(title, ("method", *names), rows)
    spreads = [
        (one.method, *map(one.spreads.get, names), one.spread) for one in others if one.spreads
    ]
    if spreads:
        output.table("Their spreads, as printed", ("method", *names, "kind"), spreads)


def _row_of_scores(name: str, scores: Measure) -> tuple[str | int, ...]:
    """Return a row of the printed table: each mean with its spread, if there is one."""
    cells = zip(scores.means.values(), scores.spreads.values(), strict=True)
    texts = (f"{mean:.3f}" + ("" if math.isnan(s) else f"±{s:.3f}") for mean, s in cells)
    return name, scores.objects, *texts

"""`slatprep train` and `predict`: train a decoder, and predict with it."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click

from slatprep.cli import options
from slatprep.cli.latents import Standardised
from slatprep.cli.output import Cell, Output
from slatprep.cli.signature import Click, command
from slatprep.errors import ConfigError, InputError, amount

if TYPE_CHECKING:
    from slatprep.extract import Session
    from slatprep.learn.runs import EpochRecord
    from slatprep.learn.train import TrainSummary
    from slatprep.records import Place

_SIZES = ("small", "medium", "large")

_PAPER: dict[str, Any] = {"steps": 2000, "accumulate": 4}
"""Parameters that `--preset paper` sets; the paper's other parameters are the defaults."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Options that `TrainParameters` takes unchanged.

    Attributes
    ----------
    epochs
        Number of passes over the training objects.
    steps
        Number of optimiser steps, instead of --epochs; the last pass may be incomplete.
    batch_size
        Number of assets in a batch.
    accumulate
        Number of batches per optimiser step.
    learning_rate
        Initial learning rate of AdamW; a cosine schedule lowers it to 0.
    precision
        bf16: mixed precision; auto: bf16 if the processor has instructions for it, else fp32.
    keep
        Keep the weights of the epoch with the least validation loss, or of the last epoch.
    patience
        Stop after this number of epochs without a better validation loss.
    augmentation
        Symmetries to draw from: 8 that keep z up, or all 48 of the cube.
    max_ambiguity
        Leave out assets whose ambiguity is larger.
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
    seed: options.Seed = 0


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
    device: Literal["cpu", "cuda"] | None = None,
    workers: options.Count | None = None,
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
        Size of the decoder: 0.20, 1.19 or 6.32 million weights.
    all_sizes
        Train all three sizes, each in a folder of its own.
    preset
        paper: 2,000 steps, and 4 accumulated batches per step (the paper does not give this
        number). Other options override the preset.
    device
        Device that computes. [default: the GPU if there is one]
    workers
        Number of processes that read ahead. [default: 0, for a GPU 1]
    threads
        Number of threads that compute. [default: all cores]

    Example
    -------
    slatprep train data/demo.zarr --out runs/small --size small --epochs 8 --learning-rate 0.003
    slatprep train data/demo.zarr --out runs/sizes --all-sizes
    slatprep train data/demo.zarr --out runs/large --preset paper --split-by test_set.json
    """
    from slatprep.learn import require_torch

    chosen_device = require_torch(device)
    import torch

    from slatprep.learn.train import TrainParameters
    from slatprep.learn.train import train as run
    from slatprep.records import USABLE
    from slatprep.storage.atomic import writing

    source = click.get_current_context().get_parameter_source
    given = {
        name: source(name) is not click.core.ParameterSource.DEFAULT
        for name in ("epochs", "size", *_PAPER)
    }
    if all_sizes and given["size"]:
        raise click.UsageError("--all-sizes and --size both say which sizes; give one of them")
    if training.steps and given["epochs"]:
        raise click.UsageError("--epochs and --steps both say when to end; give one of them")
    if preset == "paper":
        own = {name: value for name, value in _PAPER.items() if not given[name]}
        if given["epochs"]:
            own.pop("steps", None)
        training = dataclasses.replace(training, **own)
    torch.set_num_threads(threads or os.cpu_count() or 1)
    output.note(f"device:  {chosen_device}")
    opened, rule = options.opened(store), splits.rule
    options.split_of_objects(output, opened, rule, f"by {rule['by']}")
    left_out: list[str] = []
    if verdicts is None:
        verdicts = USABLE
        left_out = options.note_left_out(output, opened, range(len(opened)), USABLE)
    chosen = TrainParameters(
        size=size,
        split_by=rule["by"],
        shares=rule["shares"],
        verdicts=verdicts,
        **vars(training),
    )
    runs = {name: out / name for name in _SIZES} if all_sizes else {size: out}
    summaries = {}
    for name, directory in runs.items():
        output.if_stopped = (
            "the same command goes on from the last checkpoint, if there is one; while an epoch "
            "runs, one is written every 30 s"
        )
        with (
            writing(str(directory), directory.parent),
            output.progress(f"train {name}", "steps") as steps,
        ):
            summaries[name] = run(
                store,
                directory,
                dataclasses.replace(chosen, size=name),
                device=chosen_device,
                workers=int(chosen_device == "cuda") if workers is None else workers,
                steps=steps,
                progress=partial(_tell_epoch, output, name),
                note=output.note,
            )
    for directory, summary in zip(runs.values(), summaries.values(), strict=True):
        if summary.diverged_in is not None:
            output.problem(
                f"{directory}: the training diverged in epoch {summary.diverged_in}: its loss is "
                f"no finite number; the weights of epoch {summary.best_epoch} are kept, and a "
                "smaller --learning-rate into another --out may lead farther"
            )
    document = {"runs": summaries, "problems": left_out}
    output.made(document, lambda: _show_training(output, summaries))
    output.note(f"runs:    {', '.join(str(directory) for directory in runs.values())}")
    first = next(iter(summaries.values()))
    output.note(f"next:    slatprep evaluate {first.predictions} --store {store}")


def _tell_epoch(output: Output, name: str, record: EpochRecord) -> None:
    told = f"{name}, epoch {record.epoch}: train loss {record.train_loss:.4f}"
    if not math.isnan(record.val_loss):
        told += (
            f", validation loss {record.val_loss:.4f}, MSE {record.val_mse:.4f}"
            + f", accuracy {record.val_accuracy:.3f}" * (not math.isnan(record.val_accuracy))
        )
    output.note(told)
    output.if_stopped = (
        f"epochs up to {record.epoch} are kept, and the steps since then but for the last 30 s; "
        "the same command goes on from there"
    )


def _show_training(output: Output, summaries: dict[str, TrainSummary]) -> None:
    best = {name: summary.history[summary.best_epoch] for name, summary in summaries.items()}
    references = next(iter(summaries.values())).references
    rows: list[tuple[Cell, ...]] = [
        *((f"decoder, {n}", e.epoch, e.val_mse, e.val_accuracy) for n, e in best.items()),
        *((name, None, error, None) for name, error in references.items()),
    ]
    # Without classes there is no accuracy.
    classified = not all(math.isnan(epoch.val_accuracy) for epoch in best.values())
    columns = ("model", "epoch", "mse", "accuracy")[: 4 if classified else 3]
    title = "Validation (mean squared error in normalised space, mean over objects)"
    output.table(title, columns, [row[: len(columns)] for row in rows])


_IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".bmp")


@command()
def predict(
    output: Output,
    source: options.FileOrUrl,
    *,
    checkpoint: options.FileOrFolder,
    out: options.NewFolder,
    assets: options.AssetsOrAll = (),
    gaussians: options.NewFile | None = None,
    seed: options.Seed = 42,
    far: Annotated[Any, options.ChoiceOf("slatprep.particles.transfer:Far")] = "background",
    device: Literal["cpu", "cuda"] | None = None,
    batch_voxels: options.Positive = 65536,
    standardised: Standardised = "auto",
) -> None:
    """Predict material fields of SOURCE with a trained decoder.

    SOURCE is a SLAT (npz or HDF5), a folder of SLATs, a store, or an image,
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
    gaussians : FILE.ply
        Also decode an image's latents to Gaussians, and write them with their materials.
    seed
        Seed of an image's latents.
    far
        With --gaussians: give far Gaussians class 7 and properties 0, omit them, or give them the
        nearest material.
    device
        Device that computes. [default: the GPU if there is one]
    batch_voxels
        Decode assets together up to this number of voxels.

    Example
    -------
    slatprep predict latents --checkpoint runs/small --out predictions
    slatprep predict data/demo.zarr --checkpoint runs/small/best.pt --out predictions --device cpu
    slatprep predict cup.png --checkpoint runs/large --out cup --gaussians cup.ply
    """
    from slatprep.learn import require_torch

    is_image = source.suffix.lower() in _IMAGES
    chosen_device = require_torch(device)
    output.note(f"device:  {chosen_device}")
    from slatprep.latents import LatentsReader
    from slatprep.learn import predict as work
    from slatprep.learn.published import SECONDS, SECONDS_OF_OTHERS

    if gaussians is not None and not is_image:
        raise ConfigError(
            "--gaussians goes with an image; `slatprep decode-slat` makes Gaussians of latents, "
            "and `slatprep transfer` gives them materials"
        )
    decoder = work.load_checkpoint(checkpoint, chosen_device)
    space = decoder.contents.latents
    session, sampling = None, dict[str, float]()
    if is_image:
        source, session, sampling = _sample_latents(output, source, out, seed, chosen_device)
        standardised = "no"  # TRELLIS samples latents on the scale that its decoders take.
    read = LatentsReader(source, assets, space, standardised, output.note, output.problem)
    counts = {"predicted": 0, "voxels": 0}
    seconds = {**sampling, "read": 0.0, "decode": 0.0, "write": 0.0}
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
                output.if_stopped = (
                    f"{amount(counts['predicted'], 'prediction')} in {out} are new; run it again "
                    "to make all"
                )
                counts["voxels"] += len(field.coords)
            seconds["write"] += time.perf_counter() - begin
            seconds["decode"] += field.seconds
            progress(counts["predicted"] + len(read.problems), len(read.ids))
    seconds["read"] = read.seconds
    if session and gaussians is not None and counts["predicted"]:
        begin = time.perf_counter()
        _write_gaussians(output, session, Path(str(source)), out, gaussians, far)
        seconds["gaussians"] = time.perf_counter() - begin
    about = {"path": out, "checkpoint": decoder.sha256, "size": decoder.size}

    def show() -> None:
        output.record(f"Predictions in {out}", counts)
        each = 1e3 / max(counts["predicted"], 1)
        stages = {**seconds, "in all": sum(seconds.values())}
        columns, shown = ("stage", "seconds", "ms an asset", "SLAT-Phys, s"), 4 if is_image else 3
        rows = [(name, s, s * each, SECONDS.get(name, ""))[:shown] for name, s in stages.items()]
        output.table("Time", columns[:shown], rows)
        if is_image:
            others = ", ".join(
                f"{name} {spent:,.0f} s" for name, spent in SECONDS_OF_OTHERS.items()
            )
            output.note(f"SLAT-Phys's times are of an A5000; it prints beside them: {others}")

    document = {**about, **counts, "seconds": seconds, "problems": read.problems}
    output.made(document, show, complete=not read.problems)


def _sample_latents(
    output: Output, source: Place, out: Path, seed: int, device: str
) -> tuple[Path, Session, dict[str, float]]:
    """Sample the latents of an image; return their file, the pipeline, and times by stage."""
    from slatprep import extract as work

    session = work.load_session(device=device)
    extractions = work.list_extractions([Path(str(source))], out / "latents", [seed], False)
    (result,) = work.extract(session, extractions)
    if isinstance(result, InputError):
        raise result
    output.note(f"latents: {extractions[0].slat}{', drawn before' if result.kept else ''}")
    return extractions[0].slat, session, dict(result.seconds)


def _write_gaussians(
    output: Output, session: Session, latents: Path, out: Path, path: Path, far: Any
) -> None:
    """Decode an image's latents to Gaussians, and give each the material of its voxel."""
    from slatprep.extract import decode_gaussians
    from slatprep.particles import transfer as work
    from slatprep.particles.fields import predicted_field
    from slatprep.particles.read import read_particles
    from slatprep.readers import read_slat
    from slatprep.storage.files import file_name

    plain = out / "gaussians.ply"
    decode_gaussians(session, read_slat(latents, latents.parent), plain)
    field = predicted_field(out / f"{file_name(latents.stem)}.npz", None)
    particles = read_particles(plain, "trellis")
    result = work.transfer(particles.in_slat(), field, far=far)
    if result.far:
        count = len(particles.positions)
        output.note(f"{result.far:,} of {count:,} Gaussians have no voxel: {far}")
    work.write_transferred(path, particles, result, max_distance=2.0, in_slat=False)

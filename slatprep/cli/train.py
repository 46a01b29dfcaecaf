"""`slatprep train`: train SLAT-Phys's decoder on a store."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click

from slatprep.cli import options
from slatprep.cli.output import Output
from slatprep.cli.signature import Click, command

if TYPE_CHECKING:
    from slatprep.learn.runs import EpochRecord
    from slatprep.learn.train import TrainSummary

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
                progress=functools.partial(_tell_epoch, output, name),
            )
    output.made({"runs": summaries}, lambda: _show_training(output, summaries))
    output.note(f"runs:    {', '.join(str(directory) for directory in runs.values())}")
    first = next(iter(summaries.values()))
    output.note(f"next:    slatprep evaluate {first.predictions} --store {store}")


def _tell_epoch(output: Output, name: str, record: EpochRecord) -> None:
    output.note(f"{name}, {_line(record)}")
    output.if_stopped = (
        f"epochs up to {record.epoch} are kept, and the steps since then but for the last 30 s; "
        "the same command goes on from there"
    )


def _line(record: EpochRecord) -> str:
    line = f"epoch {record.epoch}: train loss {record.train_loss:.4f}"
    if math.isnan(record.val_loss):
        return line
    return (
        f"{line}, validation loss {record.val_loss:.4f}, MSE {record.val_mse:.4f}, "
        f"accuracy {record.val_accuracy:.3f}"
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

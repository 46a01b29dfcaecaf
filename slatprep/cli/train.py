"""`slatprep train`: train SLAT-Phys's decoder on a store."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slatprep.cli.options import (
    EXISTING_FOLDER,
    NEW_FOLDER,
    POSITIVE,
    ChoiceOf,
    FiniteRange,
    command,
    note_left_out,
    note_split,
    option,
    split_options,
    split_rule,
    verdicts_option,
)
from slatprep.cli.output import Output

if TYPE_CHECKING:
    from slatprep.learn.runs import EpochRecord
    from slatprep.learn.train import TrainSummary
    from slatprep.records import Place

_SIZES = ("small", "medium", "large")


@command()
@click.argument("store", type=EXISTING_FOLDER)
@option("--out", NEW_FOLDER, required=True)
@option("--size", click.Choice(_SIZES), "large")
@option("--all-sizes", is_flag=True)
@option("--epochs", POSITIVE, 100)
@option("--steps", POSITIVE)
@option("--batch-size", POSITIVE, 1)
@option("--accumulate", POSITIVE, 1)
@option("--learning-rate", FiniteRange(min=0, min_open=True), 0.0001)
@option("--precision", click.Choice(["auto", "fp32", "bf16"]), "auto")
@option("--keep", click.Choice(["best", "last"]), "best")
@option("--patience", POSITIVE, 10)
@option("--augment", ChoiceOf("slatprep.learn.augment:Augmentation"), "none", name="augmentation")
@verdicts_option
@option("--max-ambiguity", FiniteRange(min=0))
@split_options
@option("--weigh-by-confidence", is_flag=True)
@option("--seed", int, 0)
@option("--device", click.Choice(["cpu", "cuda"]), "cpu")
@option("--workers", click.IntRange(min=0), 0)
@option("--threads", POSITIVE, lambda: os.cpu_count() or 1, show_default="all cores")
def train(
    output: Output,
    store: Place,
    out: Path,
    size: str,
    all_sizes: bool,
    split_by: str | None,
    shares: str | None,
    verdicts: tuple[str, ...] | None,
    device: str,
    workers: int,
    threads: int,
    **parameters: Any,
) -> None:
    """Train SLAT-Phys's decoder on STORE.

    Writes run.json, log.csv, curve.png, checkpoints and the predictions of
    the test objects, which `slatprep evaluate` measures. Needs PyTorch:
    pip install 'slatprep[train]'.

    Options
    -------
    --out: Folder of the run; a stopped run is resumed.
    --size: 0.20, 1.19 or 6.32 million weights.
    --all-sizes: Train all three, each in a folder of its own.
    --epochs: Passes over the training objects.
    --steps: Steps of the optimiser, instead of --epochs; the last pass may be incomplete.
    --batch-size: Assets in a batch.
    --accumulate: Batches per step of the optimiser.
    --learning-rate: Initial learning rate of AdamW; a cosine schedule lowers it to 0.
    --precision: bf16: mixed precision; auto: bf16 if the processor has instructions for it, else
        fp32.
    --keep: Weights of the epoch with the least validation loss, or of the last epoch.
    --patience: Stop after this number of epochs without a better validation loss.
    --augment: Symmetries to draw from: 8 that keep z up, or all 48 of the cube.
    --max-ambiguity: Leave out assets that are more ambiguous.
    --weigh-by-confidence: Weight voxels by the probability that their class is right.
    --seed: Seed of initial weights, order and augmentation.
    --device: Where to compute.
    --workers: Processes that read ahead.
    --threads: Threads to compute with.

    Example
    -------
    slatprep train data/demo.zarr --out runs/small --size small --epochs 8 --learning-rate 0.003
    slatprep train data/demo.zarr --out runs/sizes --all-sizes
    slatprep train data/demo.zarr --out runs/large --steps 2000 --keep last --split-by test_set.json
    """
    from slatprep.learn import require_torch

    require_torch(device)
    import torch

    from slatprep.learn.splits import assign_store
    from slatprep.learn.train import TrainParameters
    from slatprep.learn.train import train as run
    from slatprep.records import USABLE, Verdict
    from slatprep.storage.atomic import writing
    from slatprep.store import open_store

    given = click.get_current_context().get_parameter_source("epochs")
    if parameters["steps"] and given is not click.core.ParameterSource.DEFAULT:
        raise click.UsageError("--epochs and --steps both say when to end; give one of them")
    torch.set_num_threads(threads)
    opened, rule = open_store(store), split_rule(split_by, shares)
    note_split(output, assign_store(opened, **rule), f"by {rule['by']}")
    if verdicts is None:
        verdicts = USABLE
        note_left_out(output, opened)
    chosen = TrainParameters(
        size=size,
        split_by=rule["by"],
        shares=rule["shares"],
        verdicts=verdicts or tuple(Verdict),
        **parameters,
    )
    runs = {name: out / name for name in _SIZES} if all_sizes else {size: out}
    summaries = {}
    for name, directory in runs.items():
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
                progress=lambda r, name=name: output.note(f"{name}, {_line(r)}"),  # type: ignore[misc]
            )
    output.made({"runs": summaries}, lambda: _show_training(output, summaries))
    output.note(f"runs:    {', '.join(str(directory) for directory in runs.values())}")
    first = next(iter(summaries.values()))
    output.note(f"next:    slatprep evaluate {first.predictions} --store {store}")


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

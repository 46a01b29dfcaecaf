"""`slatprep train`: SLAT-Phys's decoder on a store."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slatprep.cli.options import (
    EXISTING_FOLDER,
    NEW_FOLDER,
    POSITIVE,
    ChoiceOf,
    option,
    shares_of,
    shares_option,
    verdicts_option,
)
from slatprep.cli.output import Output, output_options

if TYPE_CHECKING:
    from slatprep.learn.train import TrainSummary
    from slatprep.records import Place

_SIZES = ("small", "medium", "large")


@click.command(
    epilog="""\b
Example:
  slatprep train demo.zarr --out runs/small --size small --epochs 8 --learning-rate 0.003
  slatprep train demo.zarr --out runs/sizes --all-sizes
"""
)
@click.argument("store", type=EXISTING_FOLDER)
@option("--out", "Folder of the run; a stopped one goes on.", NEW_FOLDER, required=True)
@option("--size", "0.20, 1.19 or 6.32 million weights.", click.Choice(_SIZES), "large")
@option("--all-sizes", "Train all three, each in its own directory.", is_flag=True)
@option("--epochs", "Passes over the training objects.", POSITIVE, 100)
@option("--batch-size", "Assets in a batch.", POSITIVE, 1)
@option("--accumulate", "Batches in a step of the optimiser.", POSITIVE, 1)
@option(
    "--learning-rate", "Of AdamW, before the cosine.", click.FloatRange(min=0, min_open=True), 1e-4
)
@option("--precision", "bf16: mixed precision.", click.Choice(["fp32", "bf16"]), "bf16")
@option("--patience", "Stop after so many epochs without progress.", POSITIVE, 10)
@option(
    "--augment",
    "Quarter turns and flips: of 8 or 48 kinds.",
    ChoiceOf("slatprep.learn.augment:Augmentation"),
    "none",
)
@verdicts_option
@option("--max-ambiguity", "Leave out assets that are more ambiguous.", float)
@shares_option
@option("--seed", "Of weights, order and augmentation.", int, 0)
@option("--device", "Where to compute.", click.Choice(["cpu", "cuda"]), "cpu")
@option("--workers", "Processes that read ahead.", click.IntRange(min=0), 0)
@option(
    "--threads",
    "Threads to compute with.",
    POSITIVE,
    lambda: os.cpu_count() or 1,
    show_default="all cores",
)
@output_options
def train(
    output: Output,
    store: Place,
    out: Path,
    size: str,
    all_sizes: bool,
    shares: str,
    augment: Any,
    verdicts: tuple[str, ...],
    device: str,
    workers: int,
    threads: int,
    **parameters: Any,
) -> None:
    """Train SLAT-Phys's decoder on STORE.

    Writes run.json, log.csv, curve.png, checkpoints and the predictions of
    the test objects, which `slatprep evaluate` measures. Needs PyTorch: pip
    install slatprep[train].
    """
    from slatprep.learn import require_torch

    require_torch()
    import torch

    from slatprep.learn.train import TrainParameters
    from slatprep.learn.train import train as run

    torch.set_num_threads(threads)
    chosen = TrainParameters(
        size=size,
        augmentation=augment,
        shares=shares_of(shares),
        verdicts=verdicts or TrainParameters.verdicts,
        **parameters,
    )
    runs = {name: out / name for name in _SIZES} if all_sizes else {size: out}
    summaries = {}
    for name, directory in runs.items():
        summaries[name] = run(
            store,
            directory,
            dataclasses.replace(chosen, size=name),
            device=device,
            workers=workers,
            progress=lambda r, name=name: output.note(  # type: ignore[misc]
                f"{name}, epoch {r.epoch}: train loss {r.train_loss:.4f}, validation loss "
                f"{r.val_loss:.4f}, MSE {r.val_mse:.4f}, accuracy {r.val_accuracy:.3f}"
            ),
        )
    output.result(summaries, lambda: _show_training(output, summaries))
    output.note(f"runs:    {', '.join(str(directory) for directory in runs.values())}")
    first = next(iter(summaries.values()))
    output.note(f"next:    slatprep evaluate {first.predictions} --store {store} --shares {shares}")


def _show_training(output: Output, summaries: dict[str, TrainSummary]) -> None:
    rows: list[tuple[str, int | None, float, float | None]] = []
    for name, summary in summaries.items():
        best = summary.history[summary.best_epoch]
        rows.append((f"decoder, {name}", best.epoch, best.val_mse, best.val_accuracy))
    references = next(iter(summaries.values())).references
    rows.extend((name, None, error, None) for name, error in references.items())
    output.table(
        "Validation (mean squared error in normalised space, mean over assets)",
        ("model", "epoch", "mse", "accuracy"),
        rows,
    )

"""`slatprep train`: SLAT-Phys's decoder on a store."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slatprep.cli.learn import STORE, shares_of, shares_option
from slatprep.cli.output import Output, output_options

if TYPE_CHECKING:
    from slatprep.learn.train import TrainSummary


@click.command(
    epilog="""\b
Example:
  slatprep train demo.zarr --out runs/small --size small --epochs 8 --learning-rate 0.003
  slatprep train demo.zarr --out runs/sizes --all-sizes
"""
)
@click.argument("store", type=STORE)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), required=True,
              help="Directory of the run; one that was stopped goes on.")  # fmt: skip
@click.option("--size", type=click.Choice(["small", "medium", "large"]), default="large",
              show_default=True, help="0.20, 1.19 or 6.32 million parameters.")  # fmt: skip
@click.option("--all-sizes", is_flag=True, help="Train all three, each in its own directory.")
@click.option("--epochs", type=click.IntRange(min=1), default=100, show_default=True,
              help="Passes over the training objects.")  # fmt: skip
@click.option("--batch-size", type=click.IntRange(min=1), default=1, show_default=True,
              help="Assets in a batch.")  # fmt: skip
@click.option("--accumulate", type=click.IntRange(min=1), default=1, show_default=True,
              help="Batches in a step of the optimiser.")  # fmt: skip
@click.option("--learning-rate", type=click.FloatRange(min=0, min_open=True), default=1e-4,
              show_default=True, help="Of AdamW, before the cosine.")  # fmt: skip
@click.option("--precision", type=click.Choice(["fp32", "bf16"]), default="bf16",
              show_default=True, help="bf16 is mixed precision.")  # fmt: skip
@click.option("--patience", type=click.IntRange(min=1), default=10, show_default=True,
              help="Epochs without a better validation loss before stopping.")  # fmt: skip
@click.option("--augment", type=click.Choice(["none", "upright", "all"]), default="none",
              show_default=True, help="Quarter turns and flips: of 8 or 48 kinds.")  # fmt: skip
@click.option("--verdict", "verdicts", type=click.Choice(["good", "doubtful", "failed"]),
              multiple=True, help="Verdicts to use; may be repeated.  [default: all]")  # fmt: skip
@click.option("--max-ambiguity", type=float, help="Leave out assets that are more ambiguous.")
@shares_option
@click.option("--seed", type=int, default=0, show_default=True,
              help="Of weights, order and augmentation.")  # fmt: skip
@click.option("--device", type=click.Choice(["cpu", "cuda"]), default="cpu", show_default=True,
              help="Where to compute.")  # fmt: skip
@click.option("--workers", type=click.IntRange(min=0), default=0, show_default=True,
              help="Processes that read ahead.")  # fmt: skip
@click.option("--threads", type=click.IntRange(min=1), default=lambda: os.cpu_count() or 1,
              show_default="all cores", help="Threads to compute with.")  # fmt: skip
@output_options
def train(
    output: Output, store: Path, out: Path, size: str, all_sizes: bool, shares: str,
    augment: Any, verdicts: tuple[str, ...], device: str, workers: int, threads: int,
    **parameters: Any,
) -> None:  # fmt: skip
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
        size=size, augmentation=augment, shares=shares_of(shares), **parameters,
        verdicts=verdicts or TrainParameters.verdicts,
    )  # fmt: skip
    runs = {name: out / name for name in ("small", "medium", "large")} if all_sizes else {size: out}
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
    document = {name: dataclasses.asdict(summary) for name, summary in summaries.items()}
    output.result(document, lambda: _show_training(output, summaries))
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

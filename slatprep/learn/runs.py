"""The directory of a training run: parameters, log, checkpoints, curve, predictions."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

from slatprep.errors import ConfigError, InputError
from slatprep.storage.atomic import staged

LAST, BEST = "last.pt", "best.pt"

INK, MUTED = "#1F2328", "#6B7280"
"""Colours of the curve: text and data, and what they are compared with."""


@dataclasses.dataclass(frozen=True)
class EpochRecord:
    """One line of ``log.csv``: means over the epoch, in the loss's own units."""

    epoch: int
    learning_rate: float
    train_loss: float
    val_loss: float
    val_mse: float
    val_accuracy: float


class Run:
    """The directory of one training run.

    Parameters
    ----------
    path : Path
        New, empty, or that of a run with the same parameters, which goes on.
    parameters : dict
        Everything that decides the result.

    Raises
    ------
    ConfigError
        If the directory holds something else.
    """

    def __init__(self, path: Path, parameters: dict[str, Any]) -> None:
        self.path = path
        file = path / "run.json"
        text = json.dumps(parameters, indent=1, sort_keys=True) + "\n"
        if file.exists():
            if file.read_text(encoding="utf-8") != text:
                raise ConfigError(
                    f"{file}: the run there has other parameters; "
                    "repeat them to go on with it, or choose another --out"
                )
        elif path.exists() and any(path.iterdir()):
            raise ConfigError(f"{path} is not empty and holds no run; choose another --out")
        else:
            path.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")

    def save(self, name: str, state: dict[str, Any]) -> None:
        """Write a checkpoint; the old one stays until the new one is whole."""
        with staged(self.path / name) as path:
            torch.save(state, path)

    def load(self, name: str) -> dict[str, Any] | None:
        """Read a checkpoint, None if there is none.

        Raises
        ------
        InputError
            If the file is damaged.
        """
        path = self.path / name
        if not path.exists():
            return None
        try:
            state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        except (RuntimeError, OSError, EOFError, ValueError, UnpicklingError) as error:
            raise InputError(
                path, f"cannot be read ({error})", "a checkpoint of `slatprep train`"
            ) from error
        return state

    def log(self, history: Sequence[EpochRecord]) -> None:
        """Write ``log.csv``, and TensorBoard's events where it is installed."""
        names = [field.name for field in dataclasses.fields(EpochRecord)]
        with (self.path / "log.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(names)
            writer.writerows(dataclasses.astuple(record) for record in history)
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        with SummaryWriter(str(self.path / "tensorboard")) as board:
            for name in names[1:]:
                board.add_scalar(name, getattr(history[-1], name), history[-1].epoch)

    def draw(self, history: Sequence[EpochRecord], references: dict[str, float]) -> None:
        """Draw ``curve.png``: validation error by epoch, beside the references.

        Parameters
        ----------
        history : sequence of EpochRecord
            One epoch at least.
        references : dict of str to float
            Name and mean squared error of each of the two references.
        """
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator

        figure = Figure(figsize=(6.6, 3.6), layout="constrained")
        axes = figure.add_subplot()
        errors = [record.val_mse for record in history]
        axes.plot([record.epoch + 1 for record in history], errors, "o-", color=INK, ms=4)
        for style, error in zip(("--", ":"), references.values(), strict=True):
            axes.axhline(error, color=MUTED, linestyle=style)
        for name, error in {"decoder": errors[-1], **references}.items():
            axes.annotate(name, (1.0, error), (6, 0), va="center", textcoords="offset points",
                          xycoords=("axes fraction", "data"), fontsize=9, color=INK)  # fmt: skip
        axes.set(xlabel="passes over the training objects", ylabel="validation MSE (normalised)")
        axes.set_ylim(0, 1.08 * max(*errors, *references.values()))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(self.path / "curve.png", dpi=120)

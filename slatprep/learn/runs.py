"""The folder of a training run: parameters, log, checkpoints, curve, predictions."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import json
import math
import os
import pickletools
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

from slatprep.errors import ConfigError, InputError
from slatprep.learn.predictions import RUN_BYTES, RUN_FILE, SPLITS_FILE
from slatprep.readers.files import refusing
from slatprep.readers.splits import Assignment
from slatprep.records import INK, MUTED
from slatprep.storage.atomic import staged, take_lock
from slatprep.storage.documents import read_document
from slatprep.storage.files import file_digest
from slatprep.storage.place import storage_of

LAST, BEST = "last.pt", "best.pt"
_LOCK, _PARTIAL = ".lock", f".{RUN_FILE}.partial"

_GLOBALS = ("torch", "collections OrderedDict")
"""Prefixes of the names that a checkpoint's pickle may contain."""

_MAX_PICKLE = 2**20
"""Most bytes of a checkpoint's structure without tensors; the large decoder's takes 60,000."""

_MAX_ENTRIES = 10_000
"""Most members of a checkpoint's archive."""


@dataclasses.dataclass(frozen=True)
class EpochRecord:
    """A line of ``log.csv``: means over an epoch.

    Validation figures are NaN if there are no objects to validate on.
    """

    epoch: int
    learning_rate: float
    train_loss: float
    val_loss: float
    val_mse: float
    val_accuracy: float


def read_state(path: Path) -> dict[str, Any]:
    """Read the state in an untrusted checkpoint to the CPU; nothing in it is executed.

    Raises InputError if the file is damaged or not a checkpoint.
    """
    with (
        refusing(path, "cannot be read", "a checkpoint of `slatprep train`"),
        storage_of(path).open() as file,
    ):
        # zipfile and torch make an object for every entry before their number can be checked.
        entries = sum(part.count(b"PK\x01\x02") for part in iter(lambda: file.read(2**20), b""))
        if entries > _MAX_ENTRIES:
            raise ValueError(f"it has {entries:,} members, and at most {_MAX_ENTRIES:,} are read")
        size = file.tell()
        file.seek(0)
        with zipfile.ZipFile(file) as archive:
            if any(info.filename.endswith("/constants.pkl") for info in archive.infolist()):
                raise ValueError("it holds a program of TorchScript")
            # torch.save does not compress; a compressed file could unpack to any size.
            if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
                raise ValueError("it is compressed")
            if sum(info.file_size for info in archive.infolist()) > size:
                raise ValueError("its members overlap")
            for info in archive.infolist():
                if info.filename.endswith("/data.pkl"):
                    if info.file_size > _MAX_PICKLE:
                        raise ValueError(f"its structure takes {info.file_size:,} bytes")
                    _check_globals(archive.read(info))
        file.seek(0)
        try:
            state = torch.load(file, map_location="cpu", weights_only=True)
        except UnpicklingError as error:
            raise ValueError(error) from None
        if not isinstance(state, dict):
            raise ValueError(f"it holds {type(state).__name__}")
    return state


def _check_globals(pickled: bytes) -> None:
    """Raise ValueError if a pickle names more than tensors: torch would allow a bytearray, too."""
    words: list[str] = []
    for operation, argument, _ in pickletools.genops(pickled):
        name = str(argument)
        if operation.name == "STACK_GLOBAL":
            name = " ".join(words[-2:])
        elif isinstance(argument, str):
            words.append(argument)
        if operation.name in ("GLOBAL", "STACK_GLOBAL") and not name.startswith(_GLOBALS):
            raise ValueError(f"it names {name[:80]!r}")


@contextmanager
def open_run(path: Path) -> Iterator[Run]:
    """Hold the lock of the folder of a training run.

    The folder is new, empty, or holds a run, whose parameters are read. ConfigError if it holds
    something else, StoreError if another process trains into it.
    """
    file, lock, parameters = path / RUN_FILE, path / _LOCK, dict[str, Any]()
    # An empty lock file may be the user's, so it is not deleted afterwards.
    foreign = lock.is_file() and not lock.stat().st_size
    held = take_lock(lock, f"{path}: another training is writing it")
    try:
        # Checked only under the lock: another training may have changed the folder before.
        if file.exists():
            with refusing(file, "cannot be read", "what `slatprep train` wrote"):
                parameters = read_document(file, RUN_BYTES)
        elif any(there.name not in (_LOCK, _PARTIAL) for there in path.iterdir()):
            raise ConfigError(f"{path} is not empty and holds no run; choose another --out")
        yield Run(path, parameters)
    finally:
        if foreign:
            os.ftruncate(held, 0)
        else:
            lock.unlink(missing_ok=True)
        os.close(held)


@dataclasses.dataclass(frozen=True)
class Run:
    """The folder of a training run, and the parameters that it has; empty if it is new."""

    path: Path
    parameters: dict[str, Any]

    def begin(self, parameters: dict[str, Any], assignment: Assignment) -> None:
        """Write the parameters of a new run, or continue a run with the same parameters.

        The result must depend on nothing but these. The objects of each split go into
        ``splits.json``, their digest into ``run.json``. ConfigError if the run in the folder has
        other parameters; the message names them.
        """
        lists = json.dumps(assignment.lists(), indent=1) + "\n"
        parameters = parameters | {"splits": hashlib.sha256(lists.encode()).hexdigest()}
        text = json.dumps(parameters, indent=1, sort_keys=True) + "\n"
        wanted, found = json.loads(text), self.parameters
        file = self.path / RUN_FILE
        if not found:
            with staged(file) as path:
                path.write_text(text, encoding="utf-8")
        elif found.get("store") != wanted.get("store"):
            raise ConfigError(
                f"{file}: the run there is of another store, or of this one before it was built "
                "anew; choose another --out"
            )
        elif found != wanted:
            others = [
                f"{name} {found.get(name)!r} instead of {wanted.get(name)!r}"
                for name in sorted({*found, *wanted})
                if found.get(name) != wanted.get(name)
            ]
            raise ConfigError(
                f"{file}: the run there has other parameters ({', '.join(others)}); "
                "repeat them to go on with it, or choose another --out"
            )
        with staged(self.path / SPLITS_FILE) as path:
            path.write_text(lists, encoding="utf-8")

    def save(self, name: str, state: dict[str, Any]) -> None:
        """Write a checkpoint; an existing one is replaced when the new one is complete."""
        buffer = BytesIO()
        # On a full disk torch.save raises no OSError.
        torch.save(state | {"run": self._digest}, buffer)
        with staged(self.path / name) as path:
            path.write_bytes(buffer.getbuffer())

    def load(self, name: str) -> dict[str, Any] | None:
        """Read a checkpoint, None if there is none.

        InputError if the file is damaged, or of a run with other parameters.
        """
        if not (path := self.path / name).exists():
            return None
        state = read_state(path)
        if state.get("run") != self._digest:
            raise InputError(path, "is of another run", f"a checkpoint of {self.path / RUN_FILE}")
        return state

    @property
    def _digest(self) -> str:
        return file_digest(self.path / RUN_FILE)

    def log(self, history: Sequence[EpochRecord]) -> None:
        """Write ``log.csv``, and events for TensorBoard if it is installed."""
        names = [field.name for field in dataclasses.fields(EpochRecord)]
        log = self.path / "log.csv"
        with staged(log) as path, path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(names)
            writer.writerows(dataclasses.astuple(record) for record in history)
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        epoch = history[-1].epoch
        # A repeated epoch replaces the entries that a killed run logged for it.
        with SummaryWriter(str(self.path / "tensorboard"), purge_step=epoch) as board:
            for name in names[1:]:
                board.add_scalar(name, getattr(history[-1], name), epoch)

    def draw(self, history: Sequence[EpochRecord], references: dict[str, float]) -> None:
        """Draw ``curve.png``: validation error by epoch, and the error (MSE) of each reference."""
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator

        figure = Figure(figsize=(6.6, 3.6), layout="constrained")
        axes = figure.add_subplot()
        errors = [record.val_mse for record in history]
        axes.plot([record.epoch for record in history], errors, "o-", color=INK, ms=4)
        for style, error in zip(("--", ":"), references.values(), strict=True):
            axes.axhline(error, color=MUTED, linestyle=style)
        known = [error for error in errors if math.isfinite(error)]  # The others diverged.
        top = 1.08 * max(*known, *references.values())
        named = {"decoder": known[-1], **references}
        heights = apart([error / top for error in named.values()])
        for name, height in zip(named, heights, strict=True):
            axes.annotate(name, (1.0, height), (6, 0), va="center", textcoords="offset points",
                          xycoords="axes fraction", fontsize=9, color=INK)  # fmt: skip
        axes.set(xlabel="epoch (the first is 0)", ylabel="validation error (mean square)")
        axes.set_ylim(0, top)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(self.path / "curve.png", dpi=120)


def apart(heights: Sequence[float], gap: float = 0.065) -> list[float]:
    """Return heights for labels near the given ones, in the same order and at least `gap` apart.

    >>> apart([0.5, 0.5, 0.1], gap=0.25)
    [0.5, 0.75, 0.1]
    """
    placed = list(heights)
    order = sorted(range(len(placed)), key=lambda k: placed[k])
    for lower, upper in pairwise(order):
        placed[upper] = max(placed[upper], placed[lower] + gap)
    return placed

"""Train a decoder as SLAT-Phys does."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from slatprep.errors import ConfigError, require_one_of
from slatprep.learn.augment import Augmentation
from slatprep.learn.dataset import IGNORED, SlatDataset, SlatLoader, SparseBatch
from slatprep.learn.decoder import SIZES, Prediction, make_decoder
from slatprep.learn.metrics import COLUMNS, fit_baselines, means_of_objects, score_asset
from slatprep.learn.predict import (
    Checkpoint,
    checkpoint_state,
    load_checkpoint,
    predict,
    write_prediction,
)
from slatprep.learn.predictions import PREDICTIONS
from slatprep.learn.runs import BEST, LAST, EpochRecord, open_run
from slatprep.learn.splits import assign_store
from slatprep.readers.files import refusing
from slatprep.readers.splits import HASH, Assignment, Shares, Split
from slatprep.records import USABLE, Place, Verdict, words_of
from slatprep.storage.documents import adapter_of
from slatprep.store import Store, open_store
from slatprep.workers import Progress

PRECISIONS = ("auto", "fp32", "bf16")
KEEPS = ("best", "last")

PROPERTY_WEIGHT = 1.0
CLASS_WEIGHT = 0.5
"""Weights of SLAT-Phys for the MSE of each property and the cross-entropy of the classes."""

SECONDS_BETWEEN_SAVES = 30.0
"""Most seconds of an unfinished epoch that a stopped training loses, apart from one step."""


@dataclass(frozen=True)
class TrainParameters:
    """The parameters of a training run.

    Attributes
    ----------
    size : str
        Size of the decoder: small, medium or large.
    epochs : int
        Passes over the training objects; the cosine schedule ends with the last.
    steps : int, optional
        Steps of the optimiser, instead of `epochs`; the last pass may be incomplete.
    batch_size, accumulate : int
        Assets in a batch, and batches per step of the optimiser.
    learning_rate : float
        Initial learning rate of AdamW; a cosine schedule lowers it to 0.
    precision : str
        ``fp32``, ``bf16`` for mixed precision, or ``auto``: see `precision_of`.
    keep : {"best", "last"}
        Keep the weights of the epoch with the least validation loss, or of the last. ``last``
        needs no objects to validate on and ignores `patience`.
    patience : int
        Training stops after this number of epochs without a better validation loss.
    augmentation : str
        none, upright or all, see `slatprep.learn.augment`.
    verdicts : str or iterable of str
        Only assets with one of these verdicts; ``all`` takes all.
    max_ambiguity : float, optional
        Only assets with at most this ambiguity.
    split_by : str
        The rule of the split, see `slatprep.readers.splits.assign_splits`.
    shares : Shares
        Shares of train, val and test.
    weigh_by_confidence : bool
        Whether to weight each voxel's loss by the probability that its class is right.
    seed : int
        Seed of initial weights, order and augmentation.
    """

    size: str = "large"
    epochs: int = 100
    steps: int | None = None
    batch_size: int = 1
    accumulate: int = 1
    learning_rate: float = 1e-4
    precision: str = "auto"
    keep: Literal["best", "last"] = "best"
    patience: int = 10
    augmentation: Augmentation = "none"
    verdicts: tuple[str, ...] = USABLE
    max_ambiguity: float | None = None
    split_by: str = HASH
    shares: Shares = field(default_factory=Shares)
    weigh_by_confidence: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name, allowed in (("size", tuple(SIZES)), ("precision", PRECISIONS), ("keep", KEEPS)):
            require_one_of(name, getattr(self, name), allowed)
        for name in ("epochs", "steps", "batch_size", "accumulate"):
            if (count := getattr(self, name)) is not None and count < 1:
                raise ConfigError(f"{name} is {count}; expected at least 1")
        words = words_of(self.verdicts)
        object.__setattr__(self, "verdicts", tuple(Verdict if "all" in words else words))


@dataclass(frozen=True)
class TrainSummary:
    """The result of a training run.

    Attributes
    ----------
    history : list of EpochRecord
        All epochs.
    best_epoch : int
        The epoch whose weights are kept.
    references : dict of str to float
        Validation MSE of the training mean and of a per-voxel linear model; empty if there
        are no objects to validate on.
    predictions : Path
        Predictions of the test objects, for `slatprep evaluate`.
    diverged_in : int, optional
        The last epoch, if training ended because its loss is not finite.
    """

    history: list[EpochRecord]
    best_epoch: int
    references: dict[str, float]
    predictions: Path
    diverged_in: int | None = None


def train(
    store: Place,
    out: Path,
    parameters: TrainParameters,
    *,
    device: str = "cpu",
    workers: int = 0,
    progress: Callable[[EpochRecord], None] = lambda _: None,
    steps: Progress = lambda _done, _total: None,
    stop_after: int | None = None,
    note: Callable[[str], None] = lambda _: None,
) -> TrainSummary:
    """Train a decoder into the folder `out`, or resume a run that was stopped.

    On a CPU, a resumed run gets the same weights as an uninterrupted one; on a GPU the last bits
    may differ. `workers` processes read ahead. `steps` gets the number of batches done and of all,
    in this call alone, and `note` a line if the run is resumed. The training stops after
    `stop_after` epochs, as if interrupted; it ends if it diverges. ConfigError if `out` holds
    another run, a split has no asset, or the training diverges before any epoch can be kept.
    InputError if a checkpoint is damaged, or of another run.
    """
    opened = open_store(store, copy=True)
    assignment = assign_store(opened, parameters.split_by, parameters.shares)
    train_set, test_set = (
        _dataset(opened, name, parameters, assignment) for name in ("train", "test")
    )
    val_set = None
    if "val" in assignment.splits.values():
        val_set = _dataset(opened, "val", parameters, assignment)
    elif parameters.keep == "best":
        raise ConfigError(
            "there is no object to validate on, by which the best weights would be chosen; "
            "expected --keep last, or objects to validate on (--shares, or a list val)"
        )
    with open_run(out) as run:
        if parameters.precision == "auto":
            # A resumed run keeps its precision, on whatever processor it continues.
            known = run.parameters.get("precision") or precision_of(device)
            parameters = replace(parameters, precision=known)
        run.begin(asdict(parameters) | {"store": str(opened.attributes["manifest"])}, assignment)
        session = _Session(parameters, train_set, val_set, device, workers)
        state = run.load(LAST)
        run.load(BEST)  # If it is of another run, that is told before any epoch.
        if state is not None:
            with refusing(run.path / LAST, "cannot be read", "a checkpoint of this run"):
                session.restore(state)
            note(f"resumed: from {run.path / LAST}; steps are counted from there")
        while not session.finished and session.epoch != stop_after:
            train_loss, rate = session.run_epoch(steps, lambda: run.save(LAST, session.state()))
            record = EpochRecord(session.epoch, rate, train_loss, *session.validate())
            session.history.append(record)
            if session.diverged(session.best_epoch):
                raise ConfigError(
                    f"{out}: the training diverged in epoch {record.epoch}: its loss is no finite "
                    "number; train with a smaller --learning-rate into another --out"
                )
            # `LAST` is saved last: a run that is killed before that repeats the epoch.
            if session.best_epoch == record.epoch:
                ranges, holds = opened.normalization, opened.contents
                run.save(BEST, checkpoint_state(session.model, parameters.size, ranges, holds))
            run.log(session.history)
            run.save(LAST, session.state())
            progress(record)
        references = {}
        if val_set is not None:
            for one in fit_baselines(opened, train_set.indices.tolist()):
                errors = []
                for index in val_set.indices.tolist():
                    rows = opened.read(index, COLUMNS)
                    errors.append(score_asset(one.predict(rows), rows)[-2])
                references[one.name] = float(_over_objects(val_set, errors))
            run.draw(session.history, references)
        predictions = run.path / PREDICTIONS
        _write_predictions(load_checkpoint(run.path / BEST, device), test_set, predictions)
    diverged_in = session.epoch - 1 if session.diverged() else None
    return TrainSummary(session.history, session.best_epoch, references, predictions, diverged_in)


def _over_objects(dataset: SlatDataset, scores: Sequence[Any]) -> NDArray[np.float64]:
    """Return the mean over objects of scores of a dataset's assets, as `slatprep evaluate` does."""
    objects = dataset.store.column("object_id")[dataset.indices].astype(str)
    _, means = means_of_objects(objects, np.array(scores))
    return np.asarray(means.mean(axis=0))


def precision_of(device: str) -> str:
    """Return the fastest precision of a device: ``bf16`` if it has instructions for it.

    On a CPU without them bf16 takes five times as long as ``fp32``.
    """
    if device != "cpu":
        return "bf16"
    try:
        flags = set(Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").split())
    except OSError:
        return "fp32"  # Not Linux: the instructions are not known.
    return "bf16" if flags & {"amx_bf16", "avx512_bf16"} else "fp32"


def loss_of(prediction: Prediction, batch: SparseBatch, weigh: bool = False) -> Tensor:
    """Return SLAT-Phys's loss over the valid voxels of a batch, a scalar.

    It is the sum of the properties' mean squared errors and half the cross-entropy. With `weigh`,
    confidence weights the means over voxels.
    """
    if not bool(batch.valid.any()):
        return prediction.properties.sum() * 0.0 + prediction.logits.sum() * 0.0
    squared = (prediction.properties - batch.properties)[batch.valid].square()
    if weigh:
        weights = batch.confidence[batch.valid]
        weights = weights / weights.sum()
        entropies = functional.cross_entropy(
            prediction.logits[batch.valid], batch.material[batch.valid], reduction="none"
        )
        return PROPERTY_WEIGHT * (weights @ squared).sum() + CLASS_WEIGHT * weights @ entropies
    entropy = functional.cross_entropy(prediction.logits, batch.material, ignore_index=IGNORED)
    return PROPERTY_WEIGHT * squared.mean(dim=0).sum() + CLASS_WEIGHT * entropy


class _Session:
    """The state of a training run: model, optimiser and history."""

    def __init__(
        self,
        parameters: TrainParameters,
        dataset: SlatDataset,
        val_set: SlatDataset | None,
        device: str,
        workers: int,
    ) -> None:
        torch.manual_seed(parameters.seed)
        torch.use_deterministic_algorithms(device == "cpu")
        self.parameters, self.val_set, self.device = parameters, val_set, device
        self.model = make_decoder(parameters.size, dataset.store.contents).to(device)
        self.optimizer = torch.optim.AdamW(self.model.parameters(), lr=parameters.learning_rate)
        pinned = device != "cpu"
        self.loader = SlatLoader(
            dataset, parameters.batch_size, shuffle=True, workers=workers, pin_memory=pinned
        )
        self.steps = math.ceil(len(self.loader) / parameters.accumulate)
        self.all_steps = parameters.steps or parameters.epochs * self.steps
        self.epochs = math.ceil(self.all_steps / self.steps)
        self.history: list[EpochRecord] = []
        self.losses: list[float] = []  # Losses of the batches of an unfinished epoch.
        self.resumed_at = 0

    @property
    def epoch(self) -> int:
        return len(self.history)

    @property
    def best_epoch(self) -> int:
        if self.parameters.keep == "last":
            return self.epoch - 1
        losses = [record.val_loss for record in self.history]
        return int(np.argmin(np.nan_to_num(losses, nan=np.inf)))  # NaN where training diverged.

    def diverged(self, epoch: int = -1) -> bool:
        """Return whether the loss of an epoch is not finite; then no later loss is, either."""
        record = self.history[epoch]
        return not math.isfinite(record.train_loss if self.val_set is None else record.val_loss)

    @property
    def finished(self) -> bool:
        if not self.history:
            return False
        without_better = self.epoch - 1 - self.best_epoch
        at_end = self.epoch >= self.epochs or without_better >= self.parameters.patience
        return at_end or self.diverged()

    def run_epoch(self, steps: Progress, save: Callable[[], None]) -> tuple[float, float]:
        """Train to the end of an epoch; return the mean loss and the last learning rate.

        `save` is called after a step of the optimiser, every `SECONDS_BETWEEN_SAVES`.
        """
        self.model.train()
        self.loader.set_epoch(self.epoch, len(self.losses))
        accumulate, length = self.parameters.accumulate, len(self.loader)
        before = self.epoch * length - self.resumed_at
        batches = min(length, (self.all_steps - self.epoch * self.steps) * accumulate)
        last = min(length, (self.all_steps - (self.epochs - 1) * self.steps) * accumulate)
        total = (self.epochs - 1) * length + last - self.resumed_at
        if before + len(self.losses) == 0:
            steps(0, total)
        saved = time.monotonic()
        for batch in islice(self.loader, batches - len(self.losses)):
            number = len(self.losses)
            moved = batch.to(self.device)
            loss = loss_of(self._predict(moved), moved, self.parameters.weigh_by_confidence)
            # The last step of an epoch may have fewer batches to average.
            first = number - number % accumulate
            (loss / min(accumulate, length - first)).backward()  # type: ignore[no-untyped-call]
            self.losses.append(float(loss.detach()))
            if (number + 1) % accumulate == 0 or number + 1 == length:
                for group in self.optimizer.param_groups:
                    group["lr"] = self._rate(self.epoch * self.steps + number // accumulate)
                self.optimizer.step()
                self.optimizer.zero_grad(set_to_none=True)
                if time.monotonic() - saved >= SECONDS_BETWEEN_SAVES and number + 1 < batches:
                    save()
                    saved = time.monotonic()
            steps(before + number + 1, total)
        rate = self._rate(self.epoch * self.steps + (batches - 1) // accumulate)
        loss_of_epoch, self.losses = float(np.mean(self.losses)), []
        return loss_of_epoch, rate

    @torch.no_grad()
    def validate(self) -> tuple[float, float, float]:
        """Return loss, MSE and class accuracy, means over objects; NaN where not defined."""
        if self.val_set is None:
            return math.nan, math.nan, math.nan
        self.model.eval()
        scores = []
        for batch in SlatLoader(self.val_set):
            moved = batch.to(self.device)
            prediction = self._predict(moved)
            valid = moved.valid
            error = (prediction.properties - moved.properties)[valid].square().mean()
            right = (prediction.logits.argmax(1) == moved.material)[valid].float().mean()
            scores.append([float(loss_of(prediction, moved)), float(error), float(right)])
        loss, error, accuracy = _over_objects(self.val_set, scores).tolist()
        return loss, error, accuracy if self.val_set.store.contents.classes else math.nan

    def state(self) -> dict[str, Any]:
        return {
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "history": [asdict(record) for record in self.history],
            "losses": torch.tensor(self.losses, dtype=torch.float64),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from a checkpoint; raises ValueError and others if it does not fit the model."""
        # Order, augmentation and learning rate follow from seed and epoch and are not saved.
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        for parameter, moments in self.optimizer.state.items():
            for name in ("exp_avg", "exp_avg_sq"):
                if moments[name].shape != parameter.shape:
                    raise ValueError(f"{name} has shape {tuple(moments[name].shape)}")
        self.history = adapter_of(list[EpochRecord]).validate_python(state["history"])
        self.losses = state["losses"].tolist()
        if not (self.history or self.losses):
            raise ValueError("it has no epoch and no batch")
        if len(self.losses) >= len(self.loader) or len(self.losses) % self.parameters.accumulate:
            raise ValueError(f"it ends after batch {len(self.losses)}, within a step")
        self.resumed_at = self.epoch * len(self.loader) + len(self.losses)

    def _rate(self, step: int) -> float:
        cosine = math.cos(math.pi * step / self.all_steps)
        return self.parameters.learning_rate * 0.5 * (1 + cosine)

    def _predict(self, batch: SparseBatch) -> Prediction:
        mixed = self.parameters.precision == "bf16"
        with torch.autocast(self.device, torch.bfloat16, enabled=mixed):
            prediction: Prediction = self.model(batch.coords, batch.feats)
        return prediction


def _dataset(
    store: Store, split: Split, parameters: TrainParameters, assignment: Assignment
) -> SlatDataset:
    return SlatDataset(
        store,
        split,
        splits=assignment.splits,
        verdicts=parameters.verdicts,
        max_ambiguity=parameters.max_ambiguity,
        augmentation=parameters.augmentation if split == "train" else "none",
        seed=parameters.seed,
    )


def _write_predictions(checkpoint: Checkpoint, dataset: SlatDataset, folder: Path) -> None:
    """Write the predictions for a split, decoded asset by asset."""
    for index, asset_id in zip(dataset.indices.tolist(), dataset.asset_ids, strict=True):
        latents = dataset.store.latents_of(**dataset.store.read(index, ("coords", "feats")))
        (field,) = predict(checkpoint, [latents])
        write_prediction(folder, asset_id, field, checkpoint)

"""Training: the loss by hand, resuming to the bit, stopping, learning, and protocols of others."""

import contextlib
import dataclasses
import errno
import json
import math
import os
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from support.commands import refused, run
from support.made_store import rewrite
from support.predictions import write_predictions
from support.synthetic import Dataset, make_asset

from slatprep import ConfigError, InputError, StoreError, build_store, open_store
from slatprep.learn import train as module
from slatprep.learn.dataset import IGNORED, SlatDataset, SlatLoader, SparseBatch, collate
from slatprep.learn.decoder import Prediction, make_decoder
from slatprep.learn.metrics import fit_baselines
from slatprep.learn.runs import BEST, LAST, EpochRecord, Run, open_run
from slatprep.learn.train import TrainParameters, loss_of, precision_of, train
from slatprep.readers.splits import Assignment, Shares, split_of
from slatprep.storage.atomic import take_lock

SHARES = Shares(0.4, 0.3, 0.3)
SHORT = TrainParameters(
    size="tiny", epochs=3, batch_size=1, accumulate=2, learning_rate=2e-3, shares=SHARES,
    augmentation="upright", seed=1, precision="fp32",
)  # fmt: skip
SMALL = ("--size", "small", "--threads", "1")
BY_FILE = {"train": ["a", "b", "c"], "val": ["d"], "test": ["e", "h.front"]}
FAST = (*SMALL, "--learning-rate", "0.002")


def test_validation_counts_objects_as_evaluate_does(learn_store, tmp_path):
    """Of the two validation objects one has two views."""
    lists, out = tmp_path / "lists.json", tmp_path / "run"
    lists.write_text(json.dumps({"train": [*"abcdf"], "val": ["g", "h"], "test": ["e"]}))
    given = dataclasses.replace(SHORT, split_by=str(lists), epochs=1, keep="best")
    summary = train(learn_store, out, given)
    chosen = ("--checkpoint", out, "--asset", "g", "--asset", "h.front", "--asset", "h.side")
    run("predict", learn_store, *chosen, "--out", tmp_path / "said")
    rule = ("--split", "val", "--split-by", lists, "--json")
    found = json.loads(run("evaluate", tmp_path / "said", "--store", learn_store, *rule).stdout)
    means = found["methods"]["these predictions"]["means"]
    assert summary.history[0].val_accuracy == pytest.approx(means["accuracy"], abs=1e-6)
    assert summary.history[0].val_mse == pytest.approx(means["mean"], abs=1e-6)


def test_loss_by_hand():
    batch = SparseBatch(
        ["a"],
        torch.zeros(3, 4, dtype=torch.int32),
        torch.zeros(3, 8),
        torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, 0.0, 0.0]]),
        torch.tensor([0, 1, IGNORED]),
        torch.tensor([True, True, False]),
        torch.tensor([0.25, 0.75, 0.0]),
    )
    prediction = Prediction(
        torch.tensor([[0.5, 0.0, 0.0], [0.5, 1.0, -1.0], [1.0, 1.0, 1.0]]), torch.zeros(3, 8)
    )
    # (0.25 + 0.25) / 2 + (0 + 1) / 2 + 0, and half of ln 8 for eight equal scores.
    assert float(loss_of(prediction, batch)) == pytest.approx(0.25 + 0.5 + 0.5 * math.log(8))
    # 0.25 * 0.25 + 0.75 * (0.25 + 1), weighed by confidence.
    weighed = 0.0625 + 0.9375 + 0.5 * math.log(8)
    assert float(loss_of(prediction, batch, weigh=True)) == pytest.approx(weighed)
    batch.valid[:] = False
    assert float(loss_of(prediction, batch)) == 0.0


def weights_of(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["model"]


def shown(run: Path, name: str) -> list[tuple[int, float]]:
    """Return the steps and values of a curve as TensorBoard shows it."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    return [(event.step, event.value) for event in events.Scalars(name)]


def test_a_stopped_run_goes_on_to_the_same_bits(learn_store, tmp_path, monkeypatch):
    """Stopped within an epoch, after its last batch but one, and between two epochs."""
    whole = train(learn_store, tmp_path / "whole", SHORT)
    monkeypatch.setattr(module, "SECONDS_BETWEEN_SAVES", 0.0)
    batches = len(SlatLoader(SlatDataset(learn_store, "train", shares=SHARES)))
    assert batches >= 4  # Two steps an epoch, so that the first is within it.

    def part(stop_at: int = -1, stop_after: int | None = None) -> list[tuple[int, int]]:
        seen: list[tuple[int, int]] = []

        def steps(done: int, total: int) -> None:
            seen.append((done, total))
            if done == stop_at:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt) if stop_at > 0 else contextlib.nullcontext():
            train(learn_store, tmp_path / "parts", SHORT, steps=steps, stop_after=stop_after)
        return seen

    part(stop_at=3)  # One step is kept, of two batches; the third is not.
    assert not (tmp_path / "parts" / "log.csv").exists()
    # Goes on with the third batch of the first epoch, and stops after the second of the second.
    seen = part(stop_at=batches)
    assert seen == [(k, 3 * batches - 2) for k in range(batches + 1)]
    part(stop_after=2)
    # Steps are counted from where the run goes on.
    assert part() == [(k, batches) for k in range(batches + 1)]
    resumed = train(learn_store, tmp_path / "parts", SHORT)
    assert resumed.history == whole.history
    for name in (LAST, BEST):
        ours, theirs = (weights_of(tmp_path / run / name) for run in ("whole", "parts"))
        assert all(torch.equal(ours[key], theirs[key]) for key in ours), name
    logs = [(tmp_path / run / "log.csv").read_bytes() for run in ("whole", "parts")]
    assert logs[0] == logs[1]
    assert (tmp_path / "whole" / "curve.png").read_bytes().startswith(b"\x89PNG")
    predicted = {path.stem.partition(".")[0] for path in whole.predictions.iterdir()}
    assert predicted == {one for one in "abcdefgh" if split_of(one, SHARES) == "test"}
    state = torch.load(tmp_path / "parts" / LAST, weights_only=True)
    state["losses"] = torch.ones(batches)
    torch.save(state, tmp_path / "parts" / LAST)
    with pytest.raises(InputError, match=r"last\.pt.*ends after batch"):
        train(learn_store, tmp_path / "parts", SHORT)
    for name in ("learning_rate", "train_loss", "val_loss", "val_mse", "val_accuracy"):
        logged = [(one.epoch, pytest.approx(getattr(one, name))) for one in resumed.history]
        assert shown(tmp_path / "parts", name) == logged, name


@pytest.mark.parametrize("killed", range(3))
def test_a_killed_run_goes_on_with_the_weights_it_names(learn_store, tmp_path, monkeypatch, killed):
    """Before each of the three writes of the end of an epoch, the only one."""
    one, left = dataclasses.replace(SHORT, epochs=1), [killed]

    def kill_before(name: str) -> None:
        write = getattr(Run, name)

        def killed_or_written(*arguments: object) -> None:
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            write(*arguments)

        killing.setattr(Run, name, killed_or_written)

    with monkeypatch.context() as killing, pytest.raises(KeyboardInterrupt):
        kill_before("save")
        kill_before("log")
        train(learn_store, tmp_path, one)
    train(learn_store, tmp_path, one)
    last, best = (weights_of(tmp_path / name) for name in (LAST, BEST))
    assert all(torch.equal(last[key], best[key]) for key in last)
    assert len((tmp_path / "log.csv").read_text().splitlines()) == 2
    assert [step for step, _ in shown(tmp_path, "train_loss")] == [0]


def test_wrong_runs_are_named(learn_store, tmp_path):
    out = tmp_path / "run"
    one = dataclasses.replace(SHORT, epochs=1)
    train(learn_store, out, one)
    with pytest.raises(ConfigError, match=r"other parameters \(seed 1 instead of 2\)"):
        train(learn_store, out, dataclasses.replace(one, seed=2))
    train(learn_store, tmp_path / "other", dataclasses.replace(one, seed=2))
    for name in (LAST, BEST):
        shutil.copytree(out, tmp_path / f"{name} of another")
        shutil.copy(tmp_path / "other" / name, tmp_path / f"{name} of another")
        with pytest.raises(InputError, match=f"{name}: is of another run"):
            train(learn_store, tmp_path / f"{name} of another", one)
    (out / LAST).write_bytes(b"not a checkpoint")
    said: list[str] = []
    with pytest.raises(InputError, match=r"last\.pt"):
        train(learn_store, out, one, note=said.append)
    assert said == []
    run_file = out / "run.json"
    run_file.write_text(json.dumps(json.loads(run_file.read_text()) | {"store": "x", "splits": ""}))
    with pytest.raises(ConfigError, match=r"before it was built anew; choose another --out"):
        train(learn_store, out, one)
    with pytest.raises(ConfigError, match="holds no run"):
        train(learn_store, tmp_path, one)


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, list[torch.Tensor]]]:
    """Note the rate and the gradients of each step of AdamW."""
    noted: list[tuple[float, list[torch.Tensor]]] = []

    class Noting(torch.optim.AdamW):
        def step(self, *given: Any) -> Any:
            (group,) = self.param_groups
            noted.append((group["lr"], [one.grad.clone() for one in group["params"]]))
            return super().step(*given)

    monkeypatch.setattr(torch.optim, "AdamW", Noting)
    return noted


def test_the_rate_falls_as_a_cosine_over_all_epochs(learn_store, tmp_path, steps):
    train(learn_store, tmp_path / "run", dataclasses.replace(SHORT, epochs=2, accumulate=3))
    rates = [rate for rate, _ in steps]
    assert len(rates) == 4
    assert rates == pytest.approx([1e-3 * (1 + math.cos(math.pi * k / 4)) for k in range(4)])


def test_seed_and_choice_reach_the_dataset(learn_store, tmp_path, monkeypatch):
    made = Mock(side_effect=SlatDataset)
    monkeypatch.setattr(module, "SlatDataset", made)
    given = dataclasses.replace(SHORT, epochs=1, seed=7, max_ambiguity=0.9)
    train(learn_store, tmp_path / "run", given)
    told = [call.kwargs for call in made.call_args_list]
    assert len(told) == 3
    assert {(each["seed"], each["max_ambiguity"]) for each in told} == {(7, 0.9)}


def test_the_best_epoch_is_that_of_the_least_loss():
    epochs = [EpochRecord(0, 1, 1, 2.0, 0.1, 0.5), EpochRecord(1, 1, 1, 1.0, 0.2, 0.5)]
    session = Mock(parameters=SHORT, history=epochs, epoch=2)
    assert module._Session.best_epoch.fget(session) == 1


def test_accumulation_is_the_gradient_of_the_mean(learn_store, tmp_path, steps):
    # Equal batches by equal weights: all objects in one step, one at a time, in any order.
    base = dataclasses.replace(SHORT, epochs=1, accumulate=100, augmentation="none")
    plain = train(learn_store, tmp_path / "run", base).history[0].train_loss
    moved = weights_of(tmp_path / "run" / LAST)
    torch.manual_seed(base.seed)
    model = make_decoder("tiny")
    optimizer = torch.optim.AdamW(model.parameters(), lr=base.learning_rate)
    dataset = SlatDataset(learn_store, "train", shares=SHARES)
    batches = [collate([dataset[k]]) for k in range(len(dataset))]
    losses = [loss_of(model(batch.coords, batch.feats), batch) for batch in batches]
    torch.stack(losses).mean().backward()
    # Adam's first step is the same for any multiple of the gradient.
    for parameter, gradient in zip(model.parameters(), steps[0][1], strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-6)
    optimizer.step()
    for name, parameter in model.named_parameters():
        torch.testing.assert_close(moved[name], parameter.detach(), rtol=0, atol=2e-4)
    weighed = dataclasses.replace(base, weigh_by_confidence=True)
    assert train(learn_store, tmp_path / "weighed", weighed).history[0].train_loss != plain


def test_stops_when_validation_gets_no_better(learn_store, tmp_path):
    # At a rate this small nothing moves, so the first epoch stays the best.
    still = dataclasses.replace(SHORT, epochs=50, learning_rate=1e-30, patience=2)
    summary = train(learn_store, tmp_path / "still", still)
    assert summary.best_epoch == 0
    assert len(summary.history) == 3


def test_an_epoch_that_diverged_is_not_the_best_and_is_told(learn_store, tmp_path):
    out = tmp_path / "run"
    words = ("train", learn_store, "--out", out, *FAST, "--epochs", 3, "--shares", "0.4,0.3,0.3")
    same = TrainParameters(size="small", epochs=3, learning_rate=0.002, shares=SHARES)
    train(learn_store, out, same, stop_after=1)
    state = torch.load(out / LAST, weights_only=True)
    state["model"]["regression.bias"].fill_(math.nan)
    torch.save(state, out / LAST)
    said = run(*words).stderr
    assert f"{out}: the training diverged in epoch 1" in said
    assert "the weights of epoch 0 are kept" in said
    again = train(learn_store, out, same)
    # No epoch after it could be any better.
    assert [math.isnan(record.val_loss) for record in again.history] == [False, True]
    assert (again.best_epoch, again.diverged_in) == (0, 1)


def test_a_training_without_an_epoch_to_keep_says_that_it_diverged(learn_store, tmp_path):
    words = ("train", learn_store, "--out", tmp_path / "run", *SMALL, "--shares", "0.4,0.3,0.3")
    said = refused(*words, "--learning-rate", "1e10", "--epochs", "4")
    assert "diverged in epoch" in said and "smaller --learning-rate" in said


def test_baselines_are_what_numpy_finds(learn_store):
    store = open_store(learn_store)
    columns = ("coords", "feats", "properties", "material", "valid")
    items = [store.read(k, columns) for k in range(len(store))]
    all_of = {name: np.concatenate([item[name] for item in items]) for name in columns}
    valid = all_of["valid"]
    places = (all_of["coords"] + 0.5) / 64 - 0.5
    inputs = np.hstack([all_of["feats"], places, np.ones((len(places), 1))])[valid]
    targets = all_of["properties"][valid]
    solution = np.linalg.lstsq(inputs, targets, rcond=None)[0]
    constant, linear = fit_baselines(store, range(len(store)))
    np.testing.assert_allclose(linear.weights[:, :3], solution, atol=1e-6)
    predicted = constant.predict(items[0])
    np.testing.assert_allclose(predicted.properties[0], targets.mean(axis=0), atol=1e-9)
    assert (predicted.material == np.bincount(all_of["material"][valid]).argmax()).all()


def test_commands_train_and_evaluate(learn_store, tmp_path):
    shares = ("--shares", "0.4,0.3,0.3")
    command = ("train", learn_store, "--out", tmp_path / "run", *FAST, "--epochs", 2, *shares,
               "--json")  # fmt: skip
    trained = run(*command)
    assert "resumed" not in trained.stderr
    assert f"resumed: from {tmp_path / 'run' / 'last.pt'}" in run(*command).stderr
    assert "the shares are rough in a small dataset" in trained.stderr
    history = json.loads(trained.stdout)["runs"]["small"]["history"]
    assert history[1]["train_loss"] < history[0]["train_loss"]
    evaluate = ("evaluate", tmp_path / "run/predictions", "--store", learn_store, "--json")
    measured = run(*evaluate, *shares).stdout
    assert json.loads(measured)["missing"] == []
    # The mean of the training voxels, by hand on the same test objects.
    store = open_store(learn_store)
    columns = ("properties", "material", "valid")
    sides: dict[str, list[dict[str, np.ndarray]]] = {"train": [], "test": []}
    for k, object_id in enumerate(store.column("object_id")):
        if (split := split_of(str(object_id), SHARES)) != "val":
            sides[split].append(store.read(k, columns) | {"object": object_id})
    mean = np.concatenate([one["properties"][one["valid"]] for one in sides["train"]]).mean(axis=0)
    errors: dict[str, list[float]] = {}
    for one in sides["test"]:
        error = np.square(one["properties"] - mean)[one["valid"]].mean()
        errors.setdefault(str(one["object"]), []).append(error)
    expected = np.mean([np.mean(own) for own in errors.values()])
    baselines = json.loads(measured)["baselines"]
    assert baselines["mean of the training voxels"]["means"]["mean"] == pytest.approx(expected)
    assert "linear in each voxel" in baselines
    # Without shares those of the run are taken, whose test objects alone were predicted.
    again = run(*evaluate)
    assert again.stdout == measured
    assert f"as {tmp_path / 'run' / 'run.json'} says" in again.stderr
    (tmp_path / "run" / "run.json").write_text("{}")
    assert "run.json" in refused(*evaluate, code=1)
    refused("train", learn_store, "--out", tmp_path, "--shares", "1,2")


def test_a_run_is_trained_by_one_process_at_a_time(tmp_path, monkeypatch):
    (tmp_path / ".lock").touch()  # An empty file of that name stays as it was.
    with open_run(tmp_path):
        assert (tmp_path / ".lock").stat().st_size
        told = rf"another training .* \(process {os.getpid()} on"
        with pytest.raises(StoreError, match=told), open_run(tmp_path):
            pass
    assert (tmp_path / ".lock").read_bytes() == b""

    def late(path: Path, taken: str) -> int:
        path.parent.mkdir()
        (path.parent / "run.json").write_text('{"seed": 7}')
        return take_lock(path, taken)

    monkeypatch.setattr("slatprep.learn.runs.take_lock", late)
    with open_run(tmp_path / "run") as run:  # What another wrote before the lock was ours is read.
        assert run.parameters == {"seed": 7}
    assert not (tmp_path / "run/.lock").exists()


def test_a_run_on_a_full_disk_leaves_no_half_of_its_parameters(tmp_path, monkeypatch):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with monkeypatch.context() as patched, open_run(tmp_path / "run") as run:
        patched.setattr("slatprep.storage.atomic.flush", Mock(side_effect=full))
        with pytest.raises(OSError, match="No space left"):
            run.begin({"seed": 7}, Assignment({}))
        assert not (tmp_path / "run/run.json").exists()
    (tmp_path / "run/.run.json.partial").write_text("{")  # As a killed training leaves it.
    with open_run(tmp_path / "run") as run:
        run.begin({"seed": 7}, Assignment({}))
    with open_run(tmp_path / "run") as run:
        assert run.parameters.keys() == {"seed", "splits"}


@pytest.mark.parametrize(("flags", "precision"), [
    ("avx2 avx512f", "fp32"), ("avx512f avx512_bf16", "bf16"), ("amx_bf16", "bf16"),
])  # fmt: skip
def test_precision_is_that_of_the_processor(flags, precision, monkeypatch):
    text = f"processor : 0\nmodel name : any\nflags : fpu {flags}\n"
    monkeypatch.setattr(Path, "read_text", lambda path, **_: text)
    assert precision_of("cpu") == precision
    assert precision_of("cuda") == "bf16"


def test_a_run_goes_on_in_the_precision_it_began_with(learn_store, tmp_path, monkeypatch):
    moved = dataclasses.replace(SHORT, precision="auto")
    for found in ("fp32", "bf16"):  # As if it were moved to another machine.
        monkeypatch.setattr(module, "precision_of", lambda device, found=found: found)
        train(learn_store, tmp_path / "run", moved, stop_after=1)
        assert '"precision": "fp32"' in (tmp_path / "run" / "run.json").read_text()


def test_failed_assets_are_neither_trained_on_nor_exported_unless_asked_for(tmp_path):
    dataset = Dataset(tmp_path / "sources").having(*"abc")
    rng = np.random.default_rng(0)
    scattered = np.unique(rng.integers(0, 64, (400, 3)), axis=0).astype(np.uint8)
    dataset.write_grid("d", make_asset(3).grid)
    dataset.write_slat("d.npz", scattered, np.zeros((len(scattered), 8), np.float32))
    store = tmp_path / "s.zarr"
    build_store(dataset.parameters(), store)
    assert list(open_store(store).column("verdict")) == ["good"] * 3 + ["failed"]

    for options, count in (((), 3), (("--verdict", "all"), 4), (("--asset", "d"), 1)):
        out = ("--out", tmp_path / f"npz-{count}")
        exported = run("export", store, "--format", "npz", "--json", *out, *options)
        told, left = json.loads(exported.stdout), "left out: 1 failed (--verdict all takes them)"
        assert (told["assets"], told["ok"]) == (count, True)
        assert told["problems"] == ([left] if count == 3 else [])
        assert (left in exported.stderr) is (count == 3)
    trained = run("train", store, "--out", tmp_path / "run", *SMALL, "--epochs", "1")
    assert "left out: 1 failed (--verdict all takes them)" in trained.stderr
    # The folder of a run has its predictions, and chooses assets as the training did.
    measured = run("evaluate", tmp_path / "run", "--store", store, "--split", "all", code=1)
    assert f"left out: 1 failed (as {tmp_path / 'run/run.json'} says)" in measured.stderr
    assert f"{tmp_path / 'run/predictions'}: no prediction of" in measured.stderr
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    assert told["verdicts"] == ["good", "doubtful"]
    told["max_ambiguity"] = 0.125
    (tmp_path / "run" / "run.json").write_text(json.dumps(told))
    rewrite(store, "asset/ambiguity", 0, 0.25)
    measured = run("evaluate", tmp_path / "run", "--store", store, "--split", "all", code=1)
    assert "left out: 1 above the ambiguity 0.125, 1 failed (as " in measured.stderr


@pytest.fixture
def stop(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """End the command where it would train."""
    ending = Mock(side_effect=ConfigError("far enough"))
    monkeypatch.setattr("slatprep.learn.train.train", ending)
    return ending


@pytest.mark.usefixtures("stop")
def test_copies_of_a_slat_in_two_splits_are_named(tmp_path):
    dataset, store = Dataset(tmp_path / "sources").having(*"abcd"), tmp_path / "s.zarr"
    shutil.copy(tmp_path / "sources" / "slat" / "a.npz", tmp_path / "sources" / "slat" / "d.npz")
    build_store(dataset.parameters(), store)
    lists = tmp_path / "lists.json"
    lists.write_text(json.dumps({"train": ["a", "b"], "val": ["c"], "test": ["d"]}))
    command = ("train", store, "--out", tmp_path / "run", "--split-by", lists)
    told = refused(*command)
    assert "1 SLAT with copies in other splits, under other ids (a = d)" in told
    lists.write_text(json.dumps({"train": ["a", "d"], "val": ["c"], "test": ["b"]}))
    assert "with copies" not in refused(*command)


def test_a_run_keeps_its_lists_and_evaluate_takes_them(learn_store, tmp_path):
    lists, out = tmp_path / "lists.json", tmp_path / "run"
    lists.write_text(json.dumps(BY_FILE | {"train": ["a", "b", "c", "nobody"]}))
    command = ("train", learn_store, "--out", out, *FAST, "--epochs", "1", "--split-by", lists)
    told = run(*command).stderr
    assert "3 train, 1 val, 2 test" in told
    assert "1 id without an object of the store that has a valid voxel: nobody\n" in told
    assert "2 ids of the store in none" in told
    kept = json.loads((out / "splits.json").read_text())
    assert kept == {"train": ["a", "b", "c"], "val": ["d"], "test": ["e", "h"]}
    assert json.loads((out / "run.json").read_text())["split_by"] == str(lists)
    assert {path.stem for path in (out / "predictions").iterdir()} == {"e", "h.front", "h.side"}

    words = ("evaluate", out / "predictions", "--store", learn_store, "--json")
    measured = run(*words)
    assert json.loads(measured.stdout)["methods"]["these predictions"]["objects"] == 2
    assert f"as {out / 'run.json'} says: 3 train, 1 val, 2 test" in measured.stderr
    assert run(*words, "--split-by", out / "splits.json").stdout == measured.stdout

    # A link to the predictions is of the same run, and a run without any has not ended.
    (tmp_path / "link").symlink_to(out / "predictions")
    assert run("evaluate", tmp_path / "link", *words[2:]).stdout == measured.stdout
    shutil.rmtree(out / "predictions")
    assert "is a training without predictions" in refused("evaluate", out, *words[2:], code=1)

    # A file that says something else by the time that the run goes on is another run.
    lists.write_text(json.dumps(BY_FILE | {"val": ["d", "g"]}))
    assert "splits" in refused(*command)


@pytest.mark.parametrize("name", ["epochs", "steps", "batch_size", "accumulate"])
def test_a_training_takes_at_least_one_of_each(name):
    with pytest.raises(ConfigError, match=f"{name} is 0; expected at least 1"):
        TrainParameters(**{name: 0})


def test_evaluate_outside_a_run_says_which_split_it_takes(learn_store, tmp_path):
    command = ("evaluate", write_predictions(tmp_path / "p", learn_store), "--store", learn_store)
    bare = run(*command).stderr
    assert "test, by hash, as no run lies beside the predictions" in bare
    assert "--split all" in bare and "--split-by" in bare
    chosen = run(*command, "--split-by", "pixie", "--json")
    assert "by pixie: " in chosen.stderr and "no run" not in chosen.stderr
    assert json.loads(chosen.stdout)["methods"]["these predictions"]["objects"] == 1


@pytest.mark.parametrize("steps", [1, 3, 4])
def test_steps_end_where_they_are_told_to(learn_store, tmp_path, steps):
    chosen = dataclasses.replace(SHORT, steps=steps, epochs=1, keep="last")
    batches = len(SlatLoader(SlatDataset(learn_store, "train", shares=SHARES), 1))
    per_epoch = math.ceil(batches / 2)
    seen: list[tuple[int, int]] = []
    trained = train(learn_store, tmp_path / "run", chosen, steps=lambda *done: seen.append(done))
    history = trained.history
    assert len(history) == math.ceil(steps / per_epoch)
    # The cosine ends with the last step, and the log has the rate of each pass's last one.
    ends = [min(steps, (k + 1) * per_epoch) - 1 for k in range(len(history))]
    cosine = [2e-3 * (1 + math.cos(math.pi * end / steps)) / 2 for end in ends]
    assert [record.learning_rate for record in history] == pytest.approx(cosine)
    full, rest = divmod(steps, per_epoch)
    done = full * batches + min(2 * rest, batches)
    assert seen == [(k, done) for k in range(done + 1)]


def test_without_classes_no_accuracy_is_told(learn_store, tmp_path, monkeypatch):
    monkeypatch.setattr("slatprep.learn.train._Session.validate", lambda _: (0.5, 0.25, math.nan))
    said = run("train", learn_store, "--out", tmp_path / "run", "--epochs", "1", *FAST).output
    assert "MSE 0.2500" in said and "0.25" in said.split("Validation")[1]
    assert "accuracy" not in said and "nan" not in said


def test_the_last_weights_need_no_validation(learn_store, tmp_path):
    shares = Shares(0.9, 0.0, 0.1)
    two = TrainParameters(size="tiny", epochs=2, learning_rate=2e-3, shares=shares, keep="last")
    summary = train(learn_store, tmp_path / "run", two)
    assert summary.best_epoch == 1 and summary.references == {}
    assert all(math.isnan(record.val_loss) for record in summary.history)
    last, kept = (weights_of(tmp_path / "run" / name) for name in (LAST, BEST))
    assert all(torch.equal(last[key], kept[key]) for key in last)
    assert not (tmp_path / "run" / "curve.png").exists()
    with pytest.raises(ConfigError, match="--keep last"):
        train(learn_store, tmp_path / "other", TrainParameters(size="tiny", shares=shares))
    words = ("train", learn_store, "--out", tmp_path / "shown", "--steps", "2")
    kept = ("--keep", "last", "--split-by", "pixie", "--shares", "1,0,0")
    assert "loss nan" not in run(*words, *FAST, *kept).output
    assert "give one of them" in refused(*words, "--epochs", "2")


@pytest.mark.parametrize(
    ("words", "steps", "accumulate"),
    [(("--steps", "1", "--weigh-by-confidence"), 1, 4),
     (("--steps", "1", "--accumulate", "2"), 1, 2), ((), 2000, 4)],
)  # fmt: skip
def test_the_paper_s_preset_is_what_is_not_given(
    words, steps, accumulate, learn_store, tmp_path, stop
):
    told = refused("train", learn_store, "--out", tmp_path / "run", "--preset", "paper", *words)
    assert "far enough" in told
    _, _, chosen = stop.call_args.args
    assert (chosen.steps, chosen.accumulate) == (steps, accumulate)
    assert chosen.weigh_by_confidence is ("--weigh-by-confidence" in words)
    # As the paper prints them.
    assert (chosen.size, chosen.learning_rate, chosen.keep) == ("large", 1e-4, "best")

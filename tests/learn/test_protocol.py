"""Training and measuring by the protocols of others: their splits, steps and weights."""

import json
import math
from pathlib import Path

import pytest
import torch
from support.commands import refused, run
from support.predictions import write_predictions

from slatprep import ConfigError
from slatprep.learn.dataset import SlatDataset, SlatLoader
from slatprep.learn.runs import BEST, LAST
from slatprep.learn.train import TrainParameters, train
from slatprep.readers.splits import Shares

BY_FILE = {"train": ["a", "b", "c"], "val": ["d"], "test": ["e", "h.front"]}
FAST = ("--size", "small", "--learning-rate", "0.002", "--threads", "1")


def test_a_run_keeps_its_lists_and_evaluate_takes_them(learn_store, tmp_path):
    lists, out = tmp_path / "lists.json", tmp_path / "run"
    lists.write_text(json.dumps(BY_FILE | {"train": ["a", "b", "c", "nobody"]}))
    command = ("train", learn_store, "--out", out, *FAST, "--epochs", "1", "--split-by", lists)
    told = run(*command).stderr
    assert "3 train, 1 val, 2 test" in told
    assert "1 ids are of no object" in told and "nobody" in told
    assert "2 ids of the store are in none" in told
    kept = json.loads((out / "splits.json").read_text())
    assert kept == {"train": ["a", "b", "c"], "val": ["d"], "test": ["e", "h"]}
    assert json.loads((out / "run.json").read_text())["split_by"] == str(lists)
    assert {path.stem for path in (out / "predictions").iterdir()} == {"e", "h.front", "h.side"}

    words = ("evaluate", out / "predictions", "--store", learn_store, "--json")
    measured = run(*words)
    assert json.loads(measured.stdout)["overall"]["objects"] == 2
    assert f"as {out / 'run.json'} says: 3 train, 1 val, 2 test" in measured.stderr
    assert run(*words, "--split-by", out / "splits.json").stdout == measured.stdout

    # A file that says something else by the time that the run goes on is another run.
    lists.write_text(json.dumps(BY_FILE | {"val": ["d", "g"]}))
    assert "splits" in refused(*command)


def test_evaluate_outside_a_run_says_which_split_it_takes(learn_store, tmp_path):
    command = ("evaluate", write_predictions(tmp_path / "p", learn_store), "--store", learn_store)
    bare = run(*command).stderr
    assert "test, by hash, as no run lies beside the predictions" in bare
    assert "--split all" in bare and "--split-by" in bare
    chosen = run(*command, "--split-by", "pixie", "--json")
    assert "by pixie: " in chosen.stderr and "no run" not in chosen.stderr
    assert json.loads(chosen.stdout)["overall"]["objects"] == 1


@pytest.mark.parametrize("steps", [1, 3, 4])
def test_steps_end_where_they_are_told_to(learn_store, tmp_path, steps):
    chosen = TrainParameters(
        size="tiny", steps=steps, epochs=1, batch_size=1, accumulate=2, learning_rate=2e-3,
        shares=Shares(0.4, 0.3, 0.3), keep="last",
    )  # fmt: skip
    batches = len(SlatLoader(SlatDataset(learn_store, "train", shares=chosen.shares), 1))
    per_epoch = math.ceil(batches / 2)
    seen: list[tuple[int, int]] = []
    history = train(
        learn_store, tmp_path / "run", chosen, steps=lambda *done: seen.append(done)
    ).history
    assert len(history) == math.ceil(steps / per_epoch)
    # The cosine ends with the last step, and the log has the rate of each pass's last one.
    ends = [min(steps, (k + 1) * per_epoch) - 1 for k in range(len(history))]
    cosine = [2e-3 * (1 + math.cos(math.pi * end / steps)) / 2 for end in ends]
    assert [record.learning_rate for record in history] == pytest.approx(cosine)
    full, rest = divmod(steps, per_epoch)
    done = full * batches + min(2 * rest, batches)
    assert seen == [(k, done) for k in range(done + 1)]


def test_the_last_weights_need_no_validation(learn_store, tmp_path):
    shares = Shares(0.9, 0.0, 0.1)
    two = TrainParameters(size="tiny", epochs=2, learning_rate=2e-3, shares=shares, keep="last")
    summary = train(learn_store, tmp_path / "run", two)
    assert summary.best_epoch == 1 and summary.references == {}
    assert all(math.isnan(record.val_loss) for record in summary.history)
    last, kept = (
        torch.load(tmp_path / "run" / name, weights_only=True)["model"] for name in (LAST, BEST)
    )
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
    words, steps, accumulate, learn_store, tmp_path, monkeypatch
):
    asked: list[TrainParameters] = []

    def stop(store: Path, out: Path, parameters: TrainParameters, **_: object) -> None:
        asked.append(parameters)
        raise ConfigError("far enough")

    monkeypatch.setattr("slatprep.learn.train.train", stop)
    told = refused("train", learn_store, "--out", tmp_path / "run", "--preset", "paper", *words)
    assert "far enough" in told
    (chosen,) = asked
    assert (chosen.steps, chosen.accumulate) == (steps, accumulate)
    assert chosen.weigh_by_confidence is ("--weigh-by-confidence" in words)
    # As the paper prints them.
    assert (chosen.size, chosen.learning_rate, chosen.keep) == ("large", 1e-4, "best")

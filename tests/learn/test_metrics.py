"""Scores against cases done by hand and a second computation."""

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import zarr
from support.commands import document, run
from support.predictions import write_one

from slatprep import InputError, open_store
from slatprep.learn.metrics import METRICS, average_methods, evaluate_store, score_asset
from slatprep.learn.predictions import VoxelPrediction
from slatprep.learn.published import PIXIE_TABLE, SLAT_PHYS_TABLE, read_scores
from slatprep.normalize import PIXIE_RANGES


def test_one_asset_by_hand():
    truth = {
        "properties": np.array([[0, 0, 0], [1, 1, 1], [np.nan] * 3], np.float32),
        "material": np.array([2, 2, 255], np.uint8),
        "valid": np.array([True, True, False]),
    }
    predicted = VoxelPrediction(
        np.array([[0.5, 0, 1], [0.5, 1, 0], [9, 9, 9]]), np.array([2, 3, 4])
    )
    score = score_asset(predicted, truth)
    # E: (0.25 + 0.25) / 2; density: 0; nu: (1 + 1) / 2; their mean; one class of two right.
    assert score.tolist() == [0.25, 0.0, 1.0, pytest.approx(1.25 / 3), 0.5]


def test_objects_count_alike_whatever_their_views():
    scores = [np.full(5, value) for value in (0.0, 2.0, 4.0)]
    columns: dict[str, list[str]] = {"object_id": ["a", "a", "b"], "category": ["x", "x", "y"]}
    store: Any = SimpleNamespace(column=columns.get, normalization=PIXIE_RANGES)
    scored = {row: [own, own + 1] for row, own in enumerate(scores)}
    measured, by_category = average_methods(store, scored, ["m", "other"], "sd")
    overall, groups = measured["m"], {name: own["m"] for name, own in by_category.items()}
    assert measured["other"].means["nu"] == 3.5
    # a is (0 + 2) / 2 = 1, b is 4: mean 2.5, sample deviation 3 / sqrt(2).
    assert overall.objects == 2
    assert overall.means["nu"] == 2.5
    assert overall.spreads["nu"] == pytest.approx(3 / np.sqrt(2))
    assert (groups["x"].means["nu"], groups["y"].means["nu"]) == (1.0, 4.0)
    assert np.isnan(groups["x"].spreads["nu"])


@pytest.fixture(scope="module")
def predicted(learn_store: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Write one set of noisy predictions in each form, one with its voxels shuffled."""
    folder = tmp_path_factory.mktemp("predictions")
    paths = {"npz": folder / "npz", "zarr": folder / "p.zarr", "hdf5": folder / "p.h5"}
    store, rng = open_store(learn_store), np.random.default_rng(0)
    for index, asset_id in enumerate(store.ids):
        rows = store.read(index, ("coords", "properties"))
        count = len(rows["coords"])
        properties = np.nan_to_num(rows["properties"]) + rng.normal(0, 0.3, (count, 3))
        logits = rng.normal(size=(count, 8))
        for form in ("zarr", "hdf5"):
            write_one(paths[form], form, asset_id, {"properties": properties, "logits": logits})
        whole = {"properties": properties, "material": logits.argmax(1), "coords": rows["coords"]}
        order = rng.permutation(count)
        write_one(paths["npz"], "npz", asset_id, {name: v[order] for name, v in whole.items()})
    return paths


@pytest.mark.parametrize("form", ["npz", "zarr", "hdf5"])
def test_against_a_plain_computation(learn_store, predicted, form):
    root = zarr.open_group(learn_store, mode="r")
    offset, objects = np.asarray(root["asset/offset"]), np.asarray(root["asset/object_id"])
    truth, material = np.asarray(root["voxel/properties"]), np.asarray(root["voxel/material"])
    valid = np.asarray(root["voxel/valid"])
    by_object: dict[str, list[list[float]]] = {}
    with h5py.File(predicted["hdf5"]) as file:
        for k, asset_id in enumerate(np.asarray(root["asset/id"])):
            here = slice(offset[k], offset[k + 1])
            squares = (file[f"{asset_id}/properties"][:] - truth[here]) ** 2
            right = file[f"{asset_id}/logits"][:].argmax(axis=1) == material[here]
            means = squares[valid[here]].mean(axis=0)
            row = [*means, means.mean(), right[valid[here]].mean()]
            by_object.setdefault(str(objects[k]), []).append(row)
    rows = [np.mean(views, axis=0) for views in by_object.values()]
    result = evaluate_store(predicted[form], learn_store, None, spread="se")
    assert result.overall.objects == 8
    assert list(result.overall.means.values()) == pytest.approx(np.mean(rows, axis=0).tolist())
    error = np.std(rows, axis=0, ddof=1) / np.sqrt(8)
    assert list(result.overall.spreads.values()) == pytest.approx(error.tolist())


def test_published_rows_agree_with_themselves():
    # The paper prints the mean of the three beside them, so a slip in copying shows.
    for score in (*PIXIE_TABLE, *SLAT_PHYS_TABLE):
        three = [score.means[name] for name in ("log10 E", "log10 density", "nu")]
        assert score.means["mean"] == pytest.approx(np.mean(three), abs=0.0011), score.method


def test_command(learn_store, predicted, tmp_path):
    some, own = Path(shutil.copytree(predicted["npz"], tmp_path / "some")), tmp_path / "scores.csv"
    (some / "a.npz").unlink()
    words = ("evaluate", some, "--store", learn_store, "--split", "all")
    told = document(*words, "--csv", own, code=1)
    means = told["overall"]["means"]
    assert (told["missing"], told["overall"]["objects"], list(means)) == (["a"], 7, list(METRICS))
    last = own.read_text().splitlines()[-1].split(",")
    assert last[:2] == ["all", "7"] and float(last[2]) == pytest.approx(means["log10 E"])
    shown = run(*words, "--beside", "pixie", "--beside", own, code=1)
    assert "no prediction of a" in shown.stderr and "log10 density" in shown.stdout
    lines = shown.stdout.splitlines()
    start = next(k for k, line in enumerate(lines) if "2508.17437" in line)
    assert lines[start + 2].split()[-5:] == [f"{value:.3f}" for value in means.values()]
    assert lines[start + 3].split() == ["NeRF2Physics", "1.115", "0.997", "0.462", "0.858", "0.274"]
    assert any(f"Beside {own}" in line for line in lines)
    last = document(*words, "--beside", own, code=1)["beside"][-1]
    assert last["method"] == "all" and last["means"] == pytest.approx(means)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("method,log10 E,accuracy\nmine,0.1,\n", None),
        ("method,E\nmine,0.1\n", "has the columns method, E"),
        ("method,mean\nmine,good\n", "not numbers"),
        ("method,nu,mean\nmine,0.1\n", "not numbers"),
        ("", "cannot be read"),
        ("method,nu,nu\nmine,0.1,0.2\n", "has the column nu twice"),
        ("method,nu\nmine,0,1\n", "has 3 entries under 2 columns, for 'mine'"),
    ],
)
def test_own_tables(tmp_path, text, message):
    path = tmp_path / "own.csv"
    path.write_text(text)
    if message is None:
        assert [(s.method, s.means) for s in read_scores(path)] == [("mine", {"log10 E": 0.1})]
        return
    with pytest.raises(InputError, match=message):
        read_scores(path)

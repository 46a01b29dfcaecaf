"""Scores of predictions and of grids against cases by hand and a second computation."""

import json
import math
import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import zarr
from scipy.spatial import cKDTree
from support.commands import document, refused, run
from support.made_store import edit_attributes, rewrite
from support.predictions import right, write_one, write_predictions, zeros
from support.synthetic import Dataset

from slatprep import ConfigError, InputError, open_store
from slatprep.learn.evaluate import Evaluation, draw_comparison, evaluate_store
from slatprep.learn.metrics import METRICS, OURS, average_methods
from slatprep.learn.published import PIXIE_TABLE, SLAT_PHYS_TABLE, read_scores
from slatprep.learn.splits import assign_store
from slatprep.normalize import PIXIE_RANGES
from slatprep.parameters import BuildParameters, NormalizeParameters
from slatprep.particles.fields import predicted_field
from slatprep.pipeline.dataset import build_store
from slatprep.records import BACKGROUND, MATERIAL_CLASSES, PROPERTY_COLUMNS


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
    ours = evaluate_store(predicted[form], learn_store, None, spread="se").methods[OURS]
    assert ours.objects == 8
    assert list(ours.means.values()) == pytest.approx(np.mean(rows, axis=0).tolist())
    error = np.std(rows, axis=0, ddof=1) / np.sqrt(8)
    assert list(ours.spreads.values()) == pytest.approx(error.tolist())


def write_changed(
    folder: Path, store: Path, change: Callable[..., Mapping[str, Any]], form: str = "npz"
) -> Path:
    """Write the labels as predictions, changed by number of the asset, arrays and valid voxels."""
    opened = open_store(store)
    for row, asset_id in enumerate(opened.ids):
        truth = opened.read(row, ("coords", "properties", "material", "valid"))
        write_one(folder, form, asset_id, change(row, right(truth), truth))
    return folder


@pytest.mark.parametrize("form", ["npz", "zarr", "hdf5"])
def test_only_labelled_voxels_of_a_prediction_count(learn_store, tmp_path, form):
    def change(_: int, arrays: dict[str, Any], truth: dict[str, Any]) -> dict[str, Any]:
        count, wrong = len(truth["coords"]), ~truth["valid"]
        arrays["properties"][wrong] = np.nan
        arrays["material"][wrong] = 255
        coords = np.hstack([np.zeros((count, 1), np.int32), truth["coords"]])
        return arrays | {"coords": coords, "valid": truth["valid"], "resolution": np.array(64)}

    folder = write_changed(tmp_path / "p.h5", learn_store, change, form)
    means = evaluate_store(folder, learn_store, None).methods[OURS].means
    assert list(means.values()) == [0.0, 0.0, 0.0, 0.0, 1.0]


def test_without_classes_nothing_has_an_accuracy(learn_copy, tmp_path):
    edit_attributes(learn_copy, material_classes=[])
    material = zarr.open_group(learn_copy, mode="r")["voxel/material"][:]
    rewrite(learn_copy, "voxel/material", slice(None), np.where(material == 255, 255, 0))
    folder = write_changed(tmp_path / "p", learn_copy, lambda _, arrays, truth: arrays)
    result = evaluate_store(folder, learn_copy, None)
    assert len(result.baselines) == 2
    for scores in (result.methods[OURS], *result.baselines.values()):
        assert math.isnan(scores.means["accuracy"]) and math.isfinite(scores.means["nu"])


@pytest.mark.parametrize(("name", "words", "said"), [
    ("columns", ["density", "youngs_modulus", "poissons_ratio"],
     "predicts density, youngs_modulus, poissons_ratio"),
    ("classes", MATERIAL_CLASSES[BACKGROUND - 1 :: -1],
     "predicts stationary, snow, .*expected the classes jelly, "),
])  # fmt: skip
def test_columns_and_classes_in_another_order_are_refused(learn_store, tmp_path, name, words, said):
    named = {name: np.array(words)}
    folder = write_changed(tmp_path / "p", learn_store, lambda _, arrays, truth: arrays | named)
    with pytest.raises(InputError, match=said):
        evaluate_store(folder, learn_store, None)
    with pytest.raises(InputError, match=said):
        predicted_field(next(folder.iterdir()), PIXIE_RANGES)


@pytest.mark.parametrize("form", ["zarr", "hdf5"])
def test_columns_of_groups_are_an_attribute(form, learn_store, tmp_path):
    store, path, names = open_store(learn_store), tmp_path / "p", list(PROPERTY_COLUMNS)
    for row, asset_id in enumerate(store.ids):
        write_one(path, form, asset_id, zeros(store.read(row, ("coords",))))

    def name_columns(columns: list[str]) -> None:
        opened = nullcontext(zarr.open_group(path)) if form == "zarr" else h5py.File(path, "r+")
        with opened as file:
            for asset_id in store.ids:
                file[asset_id]["properties"].attrs["columns"] = columns

    name_columns(names)
    assert evaluate_store(path, learn_store, None).problems == []
    name_columns(names[::-1])
    with pytest.raises(InputError, match=f"predicts {', '.join(names[::-1])}"):
        evaluate_store(path, learn_store, None)
    other = tmp_path / "other"
    arrays = zeros(store.read(0, ("coords",))) | {"columns": np.array(names)}
    write_one(other, form, store.ids[0], arrays)
    with pytest.raises(InputError, match="expected the attribute columns of properties"):
        evaluate_store(other, learn_store, None)


def test_equal_scores_are_no_class(learn_store, tmp_path):
    def change(_: int, arrays: dict[str, Any], truth: object) -> dict[str, Any]:
        scores = np.eye(8)[arrays.pop("material")]
        scores[::2] = 0.0
        return arrays | {"logits": scores}

    store = open_store(learn_store)
    result = evaluate_store(write_changed(tmp_path / "p", learn_store, change), learn_store, None)
    by_object: dict[str, list[float]] = {}
    for row, name in enumerate(store.column("object_id")):
        valid = store.read(row, ("valid",))["valid"]
        by_object.setdefault(name, []).append((np.flatnonzero(valid) % 2).mean())
    expected = np.mean([np.mean(views) for views in by_object.values()])
    assert result.methods[OURS].means["accuracy"] == pytest.approx(expected)


def test_accuracy_is_of_the_predictions_with_classes(learn_store, tmp_path):
    folder = write_changed(
        tmp_path / "p", learn_store,
        lambda row, arrays, _: arrays if row else {"properties": arrays["properties"]},
    )  # fmt: skip
    first = open_store(learn_store).ids[0]
    words = ("evaluate", folder, "--store", learn_store, "--split", "all")
    said = f"predictions without a class, not in the accuracy: {first} (1 in all; --json)"
    assert said in run(*words).stderr
    told = document(*words)
    assert told["classless"] == [first]
    assert told["methods"][OURS]["means"]["accuracy"] == 1.0


def test_published_rows_agree_with_themselves_and_what_is_printed():
    # The paper prints the mean of the three beside them, so a slip in copying shows.
    for score in (*PIXIE_TABLE, *SLAT_PHYS_TABLE):
        three = [score.means[name] for name in ("log10 E", "log10 density", "nu")]
        assert score.means["mean"] == pytest.approx(np.mean(three), abs=0.0011), score.method
        assert list(score.spreads) in ([], list(METRICS))
    by_name = {score.method: score.spreads for score in SLAT_PHYS_TABLE}
    assert by_name["SLAT-Phys"]["accuracy"] == 0.112 and by_name["Pixie"]["log10 density"] == 0.009
    assert by_name["SLAT-Phys, small"] == {}


def test_the_command_measures_what_it_can_and_names_the_rest(learn_store, predicted, tmp_path):
    some, own = Path(shutil.copytree(predicted["npz"], tmp_path / "some")), tmp_path / "scores.csv"
    (some / "a.npz").unlink()
    words = ("evaluate", some, "--store", learn_store, "--split", "all")
    told = document(*words, "--csv", own, code=1)
    means = told["methods"][OURS]["means"]
    assert (told["missing"], told["methods"][OURS]["objects"]) == (["a"], 7)
    assert list(means) == list(METRICS)
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
    for name, value, short in (("c", 0, 3), ("d", np.nan, 0), ("e", 7850, 0)):
        with np.load(some / f"{name}.npz") as file:
            properties = np.full_like(file["properties"], value)[short:]
        np.savez(some / f"{name}.npz", properties=properties)
    told = document(*words, code=1)
    assert (told["methods"][OURS]["objects"], told["missing"], told["ok"]) == (4, ["a"], False)
    shown = run(*words, code=1)
    reasons = "no prediction of a", "has shape", "not all finite", "reach 7850"
    for reason, problem in zip(reasons, told["problems"], strict=True):
        assert reason in problem and problem in shown.stderr
    for path in some.iterdir():
        np.savez(path, properties=np.zeros((5, 3)))
    said = refused(*words, code=1)
    assert "has 8 predictions of an asset of split all, and none can be used" in said
    assert "has shape (5, 3)" in said


@pytest.mark.parametrize(("text", "message"), [
    ("method,log10 E,accuracy\nmine,0.1,\n", None),
    ("method,E\nmine,0.1\n", "has the columns method, E"),
    ("method,mean\nmine,good\n", "not numbers"),
    ("method,nu,mean\nmine,0.1\n", "not numbers"),
    ("", "cannot be read"),
    ("method,nu,nu\nmine,0.1,0.2\n", "has the column nu twice"),
    ("method,nu\nmine,0,1\n", "has 3 entries under 2 columns, for 'mine'"),
])  # fmt: skip
def test_own_tables(tmp_path, text, message):
    path = tmp_path / "own.csv"
    path.write_text(text)
    if message is None:
        assert [(s.method, s.means) for s in read_scores(path)] == [("mine", {"log10 E": 0.1})]
        return
    with pytest.raises(InputError, match=message):
        read_scores(path)


# normalization_ranges.yaml of vlongle/pixie: log10 density, log10 E, nu.
LO = np.array([1.7031893730163574, 3.0183002948760986, 0.21027633547782898])
HI = np.array([3.871432304382324, 10.881680488586426, 0.4492689371109009])
NAMES = "abcd"


@dataclass
class Case:
    """A store, its raw grids, and predictions of them by a method that errs."""

    parameters: BuildParameters
    store: Path
    grids: dict[str, np.ndarray]
    predicted: dict[str, np.ndarray]
    results: Path


def normalized(grid: np.ndarray) -> np.ndarray:
    """Normalise density, E and nu (64, 64, 64, 3) as Pixie's loader does."""
    values = grid[..., :3].astype(np.float64)
    values[..., :2] = np.log10(values[..., :2] + 1e-6)
    scaled: np.ndarray = 2 * (np.clip(values, LO, HI) - LO) / (HI - LO) - 1
    return scaled


def written(path: Path, array: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, array)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("compare")
    dataset, rng = Dataset(folder / "sources"), np.random.default_rng(5)
    for seed, name in enumerate(NAMES):
        dataset.add(name, seed)
        grid = dataset.assets[name].grid
        inside = grid[..., 3] != 7
        grid[inside, 0] *= rng.uniform(0.5, 2, inside.sum())
        grid[inside, 1] *= 10 ** rng.normal(0, 2, inside.sum())
        dataset.write_grid(name, grid)
    store = folder / "s.zarr"
    parameters = dataset.parameters("pixie", sample={"method": "nearest"})
    build_store(parameters, store)
    predicted = {}
    grids, cube = {name: dataset.assets[name].grid for name in NAMES}, (64, 64, 64)
    for name, grid in grids.items():
        # A network's output: not clipped, and of the wrong class, background too, here and there.
        values = normalized(grid) + rng.normal(0, 0.4, (*cube, 3))
        classes = np.where(rng.random(cube) < 0.3, rng.integers(0, 8, cube), grid[..., 3])
        own = np.concatenate([values, classes[..., None]], axis=-1).astype(np.float32)
        channels = np.concatenate([own[..., :3], own[..., 3:] == np.arange(8)], axis=-1)
        eleven = np.moveaxis(channels.astype(np.float32), -1, 0)
        written(folder / "eleven" / name / "sample_0_pred.npy", np.ascontiguousarray(eleven))
        written(folder / "four" / f"{name}.npy", np.moveaxis(own, -1, 0).copy())
        predicted[name] = own
    return Case(parameters, store, grids, predicted, folder / "eleven")


def compared(case: Case, root: Path | None = None, **others: Any) -> Evaluation:
    splits = assign_store(open_store(case.store)).splits
    grids = {"m": root or case.results}
    return evaluate_store(None, case.store, None, grids=grids, splits=splits, **others)


def pixie_s_scores(truth: np.ndarray, predicted: np.ndarray) -> list[float]:
    """Score one object as vlongle/pixie's inference does, in the order of METRICS."""
    mask = truth[..., 3] != 7
    squares = (predicted[..., :3].astype(np.float64) - normalized(truth)) ** 2
    density, modulus, ratio = (squares[..., k][mask].sum() / (mask.sum() + 1e-8) for k in range(3))
    accuracy = ((predicted[..., 3] == truth[..., 3]) & mask).sum() / mask.sum()
    return [modulus, density, ratio, (density + modulus + ratio) / 3, accuracy]


@pytest.mark.parametrize("form", ["eleven", "four"])
def test_on_its_own_grid_a_method_scores_as_by_pixie_s_code(case, form):
    scored = (pixie_s_scores(case.grids[name], own) for name, own in case.predicted.items())
    rows = np.array(list(scored))
    # It prints standard errors, or deviations by n, and 1.645 of them for the accuracy.
    eleven, factor = form == "eleven", np.array([1, 1, 1, 1, 1.645])
    errors = rows.std(axis=0, ddof=1) / np.sqrt(len(rows)) if eleven else rows.std(axis=0)
    spread = "pixie" if eleven else "pixie-std"
    found = compared(case, case.results.parent / form, spread=spread).methods["m, own grid"]
    assert found.objects == len(NAMES)
    np.testing.assert_allclose(list(found.means.values()), rows.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(list(found.spreads.values()), errors * factor, atol=1e-6)


def test_the_grids_of_the_labels_have_no_error_also_beyond_the_ranges(case):
    found = compared(case, case.parameters.pixieverse.root).methods["m, own grid"].means
    np.testing.assert_allclose(list(found.values()), [0, 0, 0, 0, 1], atol=1e-6)


def test_at_slat_voxels_the_nearest_annotated_voxel_is_looked_up(case):
    store, rows = open_store(case.store), []
    for index, name in enumerate(NAMES):
        stored = store.read(index, ("place", "properties", "material", "valid"))
        voxels = np.argwhere(case.grids[name][..., 3] != 7)
        distances, nearest = cKDTree((voxels + 0.5) / 64 - 0.5).query(stored["place"], k=2)
        assert (distances[:, 1] - distances[:, 0] > 1e-4).all(), "no ties to argue about"
        grid = case.predicted[name][tuple(voxels[nearest[:, 0]].T)]
        valid = stored["valid"]
        squares = (grid[:, [1, 0, 2]].astype(np.float64) - stored["properties"])[valid] ** 2
        means = squares.mean(axis=0)
        right = (grid[:, 3] == stored["material"])[valid].mean()
        rows.append([*means, means.mean(), right])
    found = compared(case).methods["m, SLAT voxels"]
    np.testing.assert_allclose(list(found.means.values()), np.mean(rows, axis=0), atol=1e-6)


def test_other_ranges_are_brought_to_the_store_s(case, tmp_path):
    store = Path(shutil.copytree(case.store, tmp_path / "s.zarr"))
    build_store(replace(case.parameters, normalize=NormalizeParameters()), store)
    here = open_store(store).normalization.ranges
    assert here != open_store(case.store).normalization.ranges
    width = np.array([one.hi - one.lo for one in here])[[1, 0, 2]]
    rows = []
    for name, grid in case.predicted.items():
        # Mapped values are what both sides have in common.
        mask = case.grids[name][..., 3] != 7
        mapped = (grid[..., :3][mask].astype(np.float64) + 1) / 2 * (HI - LO) + LO
        truth = case.grids[name][..., :3][mask].astype(np.float64)
        truth[:, :2] = np.log10(truth[:, :2])
        rows.append((((mapped - truth) * 2 / width) ** 2).mean(axis=0)[[1, 0, 2]])
    found = compared(replace(case, store=store)).methods["m, own grid"].means
    np.testing.assert_allclose(list(found.values())[:3], np.mean(rows, axis=0), rtol=1e-5)


BAD: dict[str, tuple[Callable[[Path], None], str]] = {
    "missing": (lambda path: path.unlink(), "no grid for id 'b'"),
    "short": (lambda path: path.write_bytes(path.read_bytes()[:-8]) and None, "truncated"),
    "shape": (lambda path: np.save(path, np.zeros((11, 32, 32, 32), np.float32)), "has shape"),
    "class": (lambda path: np.save(path, np.full((4, 64, 64, 64), 9.0)), "unknown class 9"),
    "two": (lambda path: shutil.copy(path, path.with_name("sample_1_pred.npy")), "2 samples"),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_grid_is_named_and_the_rest_goes_on(case, tmp_path, fault):
    results = Path(shutil.copytree(case.results, tmp_path / "results", copy_function=os.link))
    own = results / "b" / "sample_0_pred.npy"
    own.unlink()
    shutil.copy(case.results / "b" / own.name, own)
    spoil, words = BAD[fault]
    spoil(own)
    command = ("evaluate", "--store", case.store, "--split", "all", "--grids", results, "--json")
    done = run(*command, code=1)
    assert words in done.stderr and str(results) in done.stderr
    assert "--samples" not in done.stderr  # An option of builds alone.
    document = json.loads(done.stdout)
    assert {m["objects"] for m in document["methods"].values()} == {len(NAMES) - 1}
    assert len(document["problems"]) == 1


def test_side_by_side_on_the_same_objects(case, tmp_path):
    ours = write_predictions(tmp_path / "ours", case.store, right)
    four = case.results.parent / "four"
    table, picture = tmp_path / "scores.csv", tmp_path / "methods.png"
    command = ("evaluate", ours, "--store", case.store, "--split", "all", "--grids",
               f"Pixie={case.results}", "--grids", four)  # fmt: skip
    done = run(*command, "--csv", table, "--picture", picture, "--beside", "slat-phys")
    assert "as no run lies" not in done.stderr  # All objects are asked for.
    names = [OURS, "Pixie, SLAT voxels", "Pixie, own grid", "four, SLAT voxels", "four, own grid"]
    lines = table.read_text().splitlines()
    assert lines[0].split(",")[:3] == ["method", "objects", "log10 E"]
    assert len(lines) == 1 + len(names) and all(name in done.stdout for name in names)
    assert picture.read_bytes().startswith(b"\x89PNG")
    methods = compared(case).methods
    for form, time in (("svg", b"<dc:date>"), ("pdf", b"CreationDate")):
        drawn, again = (draw_comparison(methods, "all", form) for _ in range(2))
        assert drawn == again and time not in drawn
    assert "SLAT-Phys, small" in done.stdout
    assert "as large as a standard deviation" in done.stdout
    # What one writes the other prints beside.
    (ours / "c.npz").unlink()
    some = run(*command, "--beside", table, "--json", code=1)
    assert "no prediction of c" in some.stderr
    document = json.loads(some.stdout)
    assert [row["method"] for row in document["beside"]] == names
    assert document["beside"][0]["means"]["accuracy"] == 1.0
    assert {m["objects"] for m in document["methods"].values()} == {len(NAMES) - 1}


@pytest.mark.parametrize(("arguments", "message"), [
    ((), "nothing to measure"),
    (("--grids", "nowhere"), "is no folder"),
    (("--grids", "{results}", "--grids", "{results}"), "two folders are called 'eleven'"),
    (("{results}", "--picture", "x.png"), "--picture draws methods"),
    (("--grids", "={results}"), "has no name before ="),
    (("--grids", "{results}", "--picture", "x.gif"), "x.gif ends in none of .png, .svg, .pdf"),
    (("--grids", "M={results}", "--csv", "{results}/a/sample_0_pred.npy"),
     "sample_0_pred.npy lies in {results}, what the command reads"),
])  # fmt: skip
def test_what_cannot_be_compared_is_said(case, arguments, message):
    filled = (argument.format(results=case.results) for argument in arguments)
    told = refused("evaluate", *filled, "--store", case.store)
    assert message.format(results=case.results) in told


def test_nothing_in_common_is_an_error(case, tmp_path):
    written(tmp_path / "other.npy", np.zeros((4, 64, 64, 64), np.float32))
    with pytest.raises(InputError, match="no grid for id 'a'"):
        compared(case, tmp_path)
    ours = write_predictions(tmp_path / "ours", case.store, right)
    grids = {"m": tmp_path}
    with pytest.raises(InputError, match=r"every method .*no grid for id 'a'"):
        evaluate_store(ours, case.store, None, grids=grids, splits={})
    with pytest.raises(ConfigError, match="nothing to measure"):
        evaluate_store(None, case.store, None)
    with pytest.raises(ConfigError, match="spread is 'sdev'"):
        evaluate_store(ours, case.store, None, "sdev")  # type: ignore[arg-type]


def test_with_grids_the_same_reference_models_stand_beside(case, tmp_path):
    folder = write_predictions(tmp_path / "ours", case.store, right)
    for name in NAMES:
        with np.load(folder / f"{name}.npz") as held:
            arrays = dict(held)
        arrays["ranges"] = open_store(case.store).normalization.spans
        np.savez(folder / f"{name}.npz", **arrays)
    splits = dict.fromkeys(NAMES, "train")
    alone = evaluate_store(folder, case.store, "train", splits=splits)
    beside = evaluate_store(folder, case.store, "train", grids={"m": case.results}, splits=splits)
    assert alone.baselines == beside.baselines and len(alone.baselines) == 2
    assert alone.methods[OURS] == beside.methods[OURS]
    assert alone.partly_annotated == 0


def test_occupied_voxels_without_a_class_are_counted(make_dataset, tmp_path):
    dataset = make_dataset("a", "b")
    grid = dataset.assets["a"].grid
    grid[tuple(np.argwhere(grid[..., 3] == 0)[:5].T)] = (0, 0, 0, -1)
    dataset.write_grid("a", grid)
    build_store(dataset.parameters(), tmp_path / "s.zarr")
    one = Case(dataset.parameters(), tmp_path / "s.zarr", {}, {}, dataset.root / "pixieverse")
    found = compared(one)
    assert found.partly_annotated == 1 and found.problems == []
    # Labels by vote, too, are what the grids they are of say.
    for measured in found.methods.values():
        np.testing.assert_allclose(list(measured.means.values()), [0, 0, 0, 0, 1], atol=1e-9)
    done = run("evaluate", "--store", one.store, "--split", "all", "--grids", one.results)
    assert "have no annotation and are not scored: 1;" in done.stderr


@pytest.mark.parametrize(("change", "words"), [
    (lambda grid: np.moveaxis(grid, -1, 0), "a prediction, channels first, is normalised"),
    (lambda grid: grid / [1e3, 1e9, 1, 1], "look like GPa and g/cm"),
    (lambda grid: grid * [1, 1, 100, 1], "Poisson's ratio"),
    # What no material has is a prediction nevertheless.
    (lambda grid: np.where(grid[..., 3:] == 7, grid, [7850, 2e6, 0.3, 1]), None),
])  # fmt: skip
def test_values_that_are_no_prediction_are_refused(case, tmp_path, change, words):
    for name in NAMES:
        written(tmp_path / f"{name}.npy", change(case.grids[name].astype(np.float64)))
    with pytest.raises(InputError, match=words) if words else nullcontext():
        assert compared(case, tmp_path).problems == []

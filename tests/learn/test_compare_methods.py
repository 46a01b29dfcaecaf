"""Predicted grids by Pixie's protocol and at SLAT voxels, against numpy on the files themselves."""

import contextlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.commands import refused, run
from support.predictions import right, write_predictions
from support.synthetic import Dataset

from slatprep import InputError, open_store
from slatprep.learn.compare import Comparison, compare_methods
from slatprep.learn.metrics import METRICS, OURS, SPREADS, measure
from slatprep.learn.published import SLAT_PHYS_TABLE
from slatprep.learn.splits import assign_store
from slatprep.parameters import NormalizeParameters, SampleParameters
from slatprep.pipeline.dataset import build_store

# normalization_ranges.yaml of vlongle/pixie: log10 density, log10 E, nu.
LO = np.array([1.7031893730163574, 3.0183002948760986, 0.21027633547782898])
HI = np.array([3.871432304382324, 10.881680488586426, 0.4492689371109009])
NAMES = "abcd"


@dataclass
class Case:
    """A store, its raw grids, and predictions of them by a method that errs."""

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
    parameters = replace(
        dataset.parameters(),
        normalize=NormalizeParameters("pixie"),
        sample=SampleParameters(method="nearest"),
    )
    build_store(parameters, store)
    predicted = {}
    for name in NAMES:
        # A network's output: not clipped, and of the wrong class, background too, here and there.
        grid = dataset.assets[name].grid
        values = normalized(grid) + rng.normal(0, 0.4, (64, 64, 64, 3))
        classes = np.where(rng.random((64, 64, 64)) < 0.3, rng.integers(0, 8, (64, 64, 64)),
                           grid[..., 3])  # fmt: skip
        predicted[name] = np.concatenate([values, classes[..., None]], axis=-1).astype(np.float32)
    for name, grid in predicted.items():
        hot = (grid[..., 3:] == np.arange(8)).astype(np.float32)
        channels = np.concatenate([grid[..., :3], hot], axis=-1)
        path = folder / "eleven" / name / "sample_0_pred.npy"
        written(path, np.ascontiguousarray(np.moveaxis(channels, -1, 0)))
        written(folder / "four" / f"{name}.npy", np.moveaxis(grid, -1, 0).copy())
    grids = {name: dataset.assets[name].grid for name in NAMES}
    return Case(store, grids, predicted, folder / "eleven")


def compared(case: Case, root: Path | None = None, **others: Any) -> Comparison:
    splits = assign_store(open_store(case.store)).splits
    grids = {"m": root or case.results}
    return compare_methods(None, grids, case.store, None, splits=splits, **others)


def pixie_s_scores(truth: np.ndarray, values: np.ndarray, classes: np.ndarray) -> list[float]:
    """Score one object as vlongle/pixie's inference does, in the order of METRICS."""
    mask = truth[..., 3] != 7
    squares = (values.astype(np.float64) - normalized(truth)) ** 2
    density, modulus, ratio = (squares[..., k][mask].sum() / (mask.sum() + 1e-8) for k in range(3))
    accuracy = ((classes == truth[..., 3]) & mask).sum() / mask.sum()
    return [modulus, density, ratio, (density + modulus + ratio) / 3, accuracy]


@pytest.mark.parametrize("form", ["eleven", "four"])
def test_on_its_own_grid_a_method_scores_as_by_pixie_s_code(case, form):
    rows = np.array(
        [
            pixie_s_scores(case.grids[name], grid[..., :3], grid[..., 3])
            for name, grid in case.predicted.items()
        ]
    )
    found = compared(case, case.results.parent / form, spread="pixie").methods["m, own grid"]
    assert found.objects == len(NAMES)
    np.testing.assert_allclose(list(found.means.values()), rows.mean(axis=0), atol=1e-6)
    # It prints standard errors, and 1.645 of them for the accuracy.
    errors = rows.std(axis=0, ddof=1) / np.sqrt(len(rows)) * [1, 1, 1, 1, 1.645]
    np.testing.assert_allclose(list(found.spreads.values()), errors, atol=1e-6)


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


def test_what_labels_are_of_scores_perfectly(case, tmp_path):
    for name, grid in case.grids.items():
        written(tmp_path / name / "sample_0" / "material_grid.npy", grid)
    found = compared(case, tmp_path)
    for measured in found.methods.values():
        np.testing.assert_allclose(list(measured.means.values()), [0, 0, 0, 0, 1], atol=1e-9)
    assert found.problems == [] and found.partly_annotated == 0


def test_other_ranges_are_brought_to_the_store_s(case, make_dataset, tmp_path):
    dataset = make_dataset(*NAMES)
    for name, grid in case.grids.items():
        dataset.write_grid(name, grid)
    build_store(dataset.parameters(), tmp_path / "s.zarr")
    here = open_store(tmp_path / "s.zarr").normalization.ranges
    width = np.array([one.hi - one.lo for one in here])[[1, 0, 2]]
    rows = []
    for name, grid in case.predicted.items():
        # Mapped values are what both sides have in common.
        mask = case.grids[name][..., 3] != 7
        mapped = (grid[..., :3][mask].astype(np.float64) + 1) / 2 * (HI - LO) + LO
        truth = case.grids[name][..., :3][mask].astype(np.float64)
        truth[:, :2] = np.log10(truth[:, :2])
        rows.append((((mapped - truth) * 2 / width) ** 2).mean(axis=0)[[1, 0, 2]])
    other = replace(case, store=tmp_path / "s.zarr")
    found = compared(other).methods["m, own grid"].means
    np.testing.assert_allclose(list(found.values())[:3], np.mean(rows, axis=0), rtol=1e-5)


BAD: dict[str, tuple[Callable[[Path], None], str]] = {
    "missing": (lambda path: path.unlink(), "no grid for id 'b'"),
    "short": (lambda path: path.write_bytes(path.read_bytes()[:-8]) and None, "truncated"),
    "shape": (lambda path: np.save(path, np.zeros((11, 32, 32, 32), np.float32)), "has shape"),
    "class": (lambda path: np.save(path, np.full((4, 64, 64, 64), 9.0)), "unknown class 9"),
    "two": (
        lambda path: shutil.copy(path, path.with_name("sample_1_pred.npy")) and None,
        "2 samples",
    ),
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
    names = [OURS, "Pixie, SLAT voxels", "Pixie, own grid", "four, SLAT voxels", "four, own grid"]
    lines = table.read_text().splitlines()
    assert lines[0].split(",")[:3] == ["method", "objects", "log10 E"]
    assert len(lines) == 1 + len(names) and all(name in done.stdout for name in names)
    assert picture.read_bytes().startswith(b"\x89PNG")
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "nothing to measure"),
        (("--grids", "nowhere"), "is no folder"),
        (("--grids", "{results}", "--grids", "{results}"), "two folders are called 'eleven'"),
        (("{results}", "--picture", "x.png"), "--picture draws methods"),
        (("--grids", "={results}"), "has no name before ="),
        (("--grids", "{results}", "--picture", "x.gif"), "x.gif does not end in .png"),
    ],
)
def test_what_cannot_be_compared_is_said(case, arguments, message):
    filled = (argument.format(results=case.results) for argument in arguments)
    assert message in refused("evaluate", *filled, "--store", case.store)


def test_nothing_in_common_is_an_error(case, tmp_path):
    written(tmp_path / "other.npy", np.zeros((4, 64, 64, 64), np.float32))
    with pytest.raises(InputError, match="no grid for id 'a'"):
        compared(case, tmp_path)


def test_occupied_voxels_without_a_class_are_counted(make_dataset, tmp_path):
    dataset = make_dataset("a", "b")
    grid = dataset.assets["a"].grid
    grid[tuple(np.argwhere(grid[..., 3] == 0)[:5].T)] = (0, 0, 0, -1)
    dataset.write_grid("a", grid)
    build_store(dataset.parameters(), tmp_path / "s.zarr")
    one = Case(tmp_path / "s.zarr", {}, {}, dataset.root / "pixieverse")
    found = compared(one)
    assert found.partly_annotated == 1
    # Labels by vote, too, are what the grids they are of say.
    for measured in found.methods.values():
        np.testing.assert_allclose(list(measured.means.values()), [0, 0, 0, 0, 1], atol=1e-9)
    done = run("evaluate", "--store", one.store, "--split", "all", "--grids", one.results)
    assert "have no annotation and are not scored: 1;" in done.stderr


def test_spreads_by_hand():
    rows = np.array([[0.0] * 5, [1.0] * 5, [5.0] * 5])
    found = {spread: list(measure(rows, spread).spreads.values()) for spread in SPREADS}
    sd = np.sqrt((4 + 1 + 9) / 2)
    assert found["sd"] == pytest.approx([sd] * 5)
    assert found["se"] == pytest.approx([sd / np.sqrt(3)] * 5)
    assert found["pixie"] == pytest.approx([sd / np.sqrt(3)] * 4 + [1.645 * sd / np.sqrt(3)])
    by_n = np.sqrt(14 / 3)
    assert found["pixie-std"] == pytest.approx([by_n] * 4 + [1.645 * by_n])


def test_published_spreads_are_those_printed():
    by_name = {score.method: score for score in SLAT_PHYS_TABLE}
    assert by_name["SLAT-Phys"].spreads["accuracy"] == 0.112
    assert by_name["Pixie"].spreads["log10 density"] == 0.009
    assert by_name["SLAT-Phys, small"].spreads == {}
    assert all(list(score.spreads) in ([], list(METRICS)) for score in SLAT_PHYS_TABLE)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda grid: np.moveaxis(grid, -1, 0), "a prediction, channels first, is normalised"),
        (lambda grid: grid / [1e3, 1e9, 1, 1], "look like GPa and g/cm"),
        (lambda grid: grid * [1, 1, 100, 1], "Poisson's ratio"),
        # What no material has is a prediction nevertheless.
        (lambda grid: np.where(grid[..., 3:] == 7, grid, [7850, 2e6, 0.3, 1]), None),
    ],
)
def test_values_that_are_no_prediction_are_refused(case, tmp_path, change, words):
    for name in NAMES:
        written(tmp_path / f"{name}.npy", change(case.grids[name].astype(np.float64)))
    refusal = pytest.raises(InputError, match=words) if words else contextlib.nullcontext()
    with refusal:
        assert compared(case, tmp_path).problems == []

"""Forty mistakes of units, layout, names and links: what is said of each; none is silent."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import Dataset

from slatprep.errors import SlatprepError
from slatprep.parameters import BuildParameters
from slatprep.readers import discover, read_field, read_latents

GRID = "pixieverse/a/sample_0/material_grid.npy"
SLAT = "slat/a.npz"


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    made = Dataset(tmp_path / "data")
    made.add("a", 0)
    return made


def said(parameters: BuildParameters) -> str:
    """Return what is said of the first asset before anything is made of it; empty if nothing."""
    try:
        (pair, *_) = discover(parameters)
        if pair.problem:
            return pair.problem
        return " ".join((*read_field(pair).warnings, *read_latents(pair).warnings))
    except SlatprepError as error:
        return str(error)


def grid(change: Callable[[np.ndarray], object]) -> Callable[[Dataset], None]:
    """Return what changes the grid's file; `change` returns a new one or changes it in place."""

    def run(dataset: Dataset) -> None:
        values = np.load(dataset.root / GRID)
        new = change(values)
        np.save(dataset.root / GRID, values if new is None else np.asarray(new))

    return run


def channel(k: int, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Dataset], None]:
    def run(values: np.ndarray) -> None:
        inside = values[..., 3] != 7
        values[inside, k] = change(values[inside, k])

    return grid(run)


def stuff(*values: float) -> Callable[[Dataset], None]:
    """Return what gives all voxels the same density, modulus, ratio and perhaps class."""

    def run(whole: np.ndarray) -> None:
        whole[whole[..., 3] != 7, : len(values)] = values

    return grid(run)


def both_in_log10(dataset: Dataset) -> None:
    for k in (0, 1):
        channel(k, np.log10)(dataset)


def order(*channels: int) -> Callable[[Dataset], None]:
    return grid(lambda values: values[..., list(channels)])


def slat(**change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Dataset], None]:
    def run(dataset: Dataset) -> None:
        with np.load(dataset.root / SLAT) as file:
            arrays = {name: change.get(name, lambda one: one)(file[name]) for name in file}
        np.savez(dataset.root / SLAT, **arrays)

    return run


def shell(change: Callable[[Path], object]) -> Callable[[Dataset], None]:
    return lambda dataset: change(dataset.root) and None


def normalised(values: np.ndarray) -> None:
    inside = values[..., 3] != 7
    values[inside, :3] = np.column_stack(
        [
            np.log10(values[inside, 0]) - 3.2,
            np.log10(values[inside, 1]) / 8 - 1,
            0 * values[inside, 2] - 0.3,
        ]
    )


def classes(table: dict[int, int]) -> Callable[[Dataset], None]:
    def run(values: np.ndarray) -> None:
        for old, new in table.items():
            values[values[..., 3] == old, 3] = new + 100
        values[values[..., 3] >= 100, 3] -= 100

    return grid(run)


def deeper(root: Path) -> None:
    (root / "pixieverse").rename(root / "batch1")
    (root / "pixieverse").mkdir()
    (root / "batch1").rename(root / "pixieverse/batch1")


def outside(root: Path) -> None:
    shutil.move(root / GRID, root.parent / "grid.npy")
    (root / GRID).symlink_to(root.parent / "grid.npy")


def group_of_two(values: np.ndarray) -> np.ndarray:
    with_batch = np.concatenate([np.zeros((len(values), 1), np.int32), values], axis=1)
    with_batch[len(values) // 2 :, 0] = 1
    return with_batch


UNITS = {
    "E in GPa": (channel(1, lambda e: e / 1e9), "look like GPa"),
    "E in MPa": (channel(1, lambda e: e / 1e6), "MPa"),
    "E in kPa, of steel": (stuff(7850, 2e5, 0.3), "metal's density"),
    "density in g/cm^3": (channel(0, lambda d: d / 1e3), "look like g/cm^3"),
    "E in GPa and density in g/cm^3": (
        grid(lambda v: (v / (1e3, 1e9, 1, 1)).astype(np.float32)),
        "GPa and g/cm^3",
    ),
    "log10 E": (channel(1, np.log10), "log10 Pa"),
    "log10 density": (channel(0, np.log10), "log10 kg/m^3"),
    "log10 of E and of density": (both_in_log10, "log10 Pa and log10 kg/m^3"),
    "normalised for raw": (grid(normalised), "look like normalised ones|unphysical"),
    "rubber as dense as steel": (stuff(7850, 2e6, 0.3), "metal's density"),
    "nu in percent": (
        channel(2, lambda n: n * 100),
        "Poisson's ratio 30, and all materials have|unphysical",
    ),
    "negative E": (channel(1, lambda e: -e), "unphysical"),
    "E above 65,504 in float16": (
        grid(lambda v: v.astype(np.float16)),
        "float16 holds nothing above 65,504",
    ),
    "E of 0": (channel(1, lambda e: e * 0), "unphysical"),
}
LAYOUT = {
    "a raw grid, channels first": (
        grid(lambda v: np.moveaxis(v, -1, 0)),
        "raw grid in SI units, channels first",
    ),
    "E before density": (order(1, 0, 2, 3), "swapped columns"),
    "nu first": (order(2, 1, 0, 3), "swapped columns"),
    "class id first": (order(3, 0, 1, 2), "unknown class"),
    "a prediction, channels last": (
        grid(lambda v: np.zeros((64, 64, 64, 11), np.float32)),
        "has shape (64, 64, 64, 11)",
    ),
    "a grid of 32^3": (grid(lambda v: v[::2, ::2, ::2]), "has shape (32, 32, 32, 4)"),
    "a grid of integers": (grid(lambda v: v.astype(np.int64)), "has dtype"),
    "a pickled grid": (grid(lambda v: np.array([{"grid": 1}], object)), "pickle"),
    "class ids of PhysGaussian's own table": (stuff(200, 1e5, 0.2, 4), "PhysGaussian's table"),
    "a class id above 7": (classes({0: 8}), "unknown class 8"),
    "all background": (classes({0: 7, 1: 7}), "all are background"),
    "coords beyond the grid": (slat(coords=lambda c: c.astype(np.int32) * 4), "out of range"),
    "coords of 32^3": (
        slat(coords=lambda c: np.unique(c // 2, axis=0), feats=lambda f: f),
        "rows of coords|no coordinate is above",
    ),
    "two assets in a file": (slat(coords=group_of_two), "more than one asset"),
    "coords twice": (slat(coords=lambda c: np.vstack([c[:-1], c[:1]])), "occurs twice"),
    "feats first": (slat(feats=lambda f: f.T), "has shape"),
    "feats of another encoder": (slat(feats=lambda f: np.tile(f, 4)), "slat.encoder: trellis"),
    "NaN in feats": (slat(feats=lambda f: f * np.nan), "feats is nan"),
    "standardised feats": (
        slat(feats=lambda f: (f - f.mean(0)) / f.std(0)),
        "look standardised already",
    ),
}
NAMES = {
    "no sample folder": (
        shell(lambda r: (r / GRID).rename(r / "pixieverse/a/material_grid.npy")),
        "no grid",
    ),
    "roots one too deep": (shell(deeper), "no grid|batch1"),
    "an id in capitals": (
        shell(lambda r: (r / SLAT).rename(r / "slat/A.npz")),
        "no SLAT|no id occurs|A",
    ),
    "two grids of one object": (
        shell(lambda r: shutil.copytree(r / "pixieverse/a/sample_0", r / "pixieverse/a/sample_1")),
        "sample",
    ),
    "an empty file": (shell(lambda r: (r / GRID).write_bytes(b"")), "zero bytes"),
    "half a file": (
        shell(lambda r: (r / GRID).write_bytes((r / GRID).read_bytes()[:-1000])),
        "truncated or damaged",
    ),
    "a link out of the root": (shell(outside), "out of its root"),
    "a link to nothing": (
        shell(lambda r: ((r / GRID).unlink(), (r / GRID).symlink_to("gone"))),
        "is a link that leads nowhere",
    ),
}
MISTAKES = {**UNITS, **LAYOUT, **NAMES}


def test_without_a_mistake_nothing_is_said(dataset):
    assert said(dataset.parameters()) == ""


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_told(dataset, name):
    change, words = MISTAKES[name]
    change(dataset)
    text = said(dataset.parameters())
    assert any(word in text for word in words.split("|")), text


def test_the_page_lists_them_with_what_is_said():
    page = (Path(__file__).parents[2] / "docs" / "design" / "mistakes.md").read_text("utf-8")
    rows = page.splitlines()
    listed = [tuple(row.strip("| ").split(" | ")) for row in rows if row.startswith("| ")][2:]
    assert listed == [(name, f"`{words.split('|')[0]}`") for name, (_, words) in MISTAKES.items()]

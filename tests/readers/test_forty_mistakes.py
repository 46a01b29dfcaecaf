"""Forty mistakes of units, layout, names and links: what is said of each; none is silent."""

import shutil
from collections.abc import Callable
from functools import partial
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


Change = Callable[[np.ndarray], np.ndarray]


def grid(change: Change) -> Callable[[Dataset], None]:
    """Return what replaces the grid's file."""

    def run(dataset: Dataset) -> None:
        np.save(dataset.root / GRID, change(np.load(dataset.root / GRID)))

    return run


def values(**changes: Change) -> Callable[[Dataset], None]:
    """Return what changes the density, E, nu or class of all voxels but the background."""

    def run(whole: np.ndarray) -> np.ndarray:
        inside = whole[..., 3] != 7
        for name, change in changes.items():
            at = ("density", "e", "nu", "material").index(name)
            whole[inside, at] = change(whole[inside, at])
        return whole

    return grid(run)


def over(factor: float) -> Change:
    return lambda one: one / factor


def all_of(**stuff: float) -> Callable[[Dataset], None]:
    """Return what gives all voxels the same values."""
    return values(**{name: partial(np.full_like, fill_value=v) for name, v in stuff.items()})


def order(*channels: int) -> Callable[[Dataset], None]:
    return grid(lambda whole: whole[..., list(channels)])


def slat(**change: Change) -> Callable[[Dataset], None]:
    def run(dataset: Dataset) -> None:
        with np.load(dataset.root / SLAT) as file:
            arrays = {name: change.get(name, lambda one: one)(file[name]) for name in file}
        np.savez(dataset.root / SLAT, **arrays)

    return run


def group_of_two(coords: np.ndarray) -> np.ndarray:
    batch = np.arange(len(coords)) >= len(coords) // 2
    return np.column_stack([batch.astype(np.int32), coords])


def shell(change: Callable[[Path], object]) -> Callable[[Dataset], None]:
    return lambda dataset: change(dataset.root) and None


def deeper(root: Path) -> None:
    (root / "pixieverse").rename(root / "batch1")
    (root / "pixieverse").mkdir()
    (root / "batch1").rename(root / "pixieverse/batch1")


def outside(root: Path) -> None:
    shutil.move(root / GRID, root.parent / "grid.npy")
    (root / GRID).symlink_to(root.parent / "grid.npy")


def nowhere(root: Path) -> None:
    (root / GRID).unlink()
    (root / GRID).symlink_to("gone")


NORMALISED = values(
    density=lambda d: np.log10(d) - 3.2, e=lambda e: np.log10(e) / 8 - 1, nu=lambda n: 0 * n - 0.3
)
UNITS = {
    "E in GPa": (values(e=over(1e9)), "look like GPa"),
    "E in MPa": (values(e=over(1e6)), "MPa"),
    "E in kPa, of steel": (all_of(density=7850, e=2e5, nu=0.3), "metal's density"),
    "density in g/cm^3": (values(density=over(1e3)), "look like g/cm^3"),
    "E in GPa and density in g/cm^3": (values(e=over(1e9), density=over(1e3)), "GPa and g/cm^3"),
    "log10 E": (values(e=np.log10), "log10 Pa"),
    "log10 density": (values(density=np.log10), "log10 kg/m^3"),
    "log10 of E and of density": (
        values(e=np.log10, density=np.log10),
        "log10 Pa and log10 kg/m^3",
    ),
    "normalised for raw": (NORMALISED, "look like normalised ones|unphysical"),
    "rubber as dense as steel": (all_of(density=7850, e=2e6, nu=0.3), "metal's density"),
    "nu in percent": (
        values(nu=over(0.01)),
        "Poisson's ratio 30, and all materials have|unphysical",
    ),
    "negative E": (values(e=np.negative), "unphysical"),
    "E above 65,504 in float16": (
        grid(lambda whole: whole.astype(np.float16)),
        "float16 holds nothing above 65,504",
    ),
    "E of 0": (values(e=np.zeros_like), "unphysical"),
}
LAYOUT = {
    "a raw grid, channels first": (
        grid(lambda whole: np.moveaxis(whole, -1, 0)),
        "raw grid in SI units, channels first",
    ),
    "E before density": (order(1, 0, 2, 3), "swapped columns"),
    "nu first": (order(2, 1, 0, 3), "swapped columns"),
    "class id first": (order(3, 0, 1, 2), "unknown class"),
    "a prediction, channels last": (
        grid(lambda whole: np.zeros((64, 64, 64, 11), np.float32)),
        "has shape (64, 64, 64, 11)",
    ),
    "a grid of 32^3": (grid(lambda whole: whole[::2, ::2, ::2]), "has shape (32, 32, 32, 4)"),
    "a grid of integers": (grid(lambda whole: whole.astype(np.int64)), "has dtype"),
    "a pickled grid": (grid(lambda whole: np.array([{"grid": 1}], object)), "pickle"),
    "class ids of PhysGaussian's own table": (
        all_of(density=200, e=1e5, nu=0.2, material=4),
        "PhysGaussian's table",
    ),
    "a class id above 7": (
        values(material=lambda one: np.where(one == 0, 8, one)),
        "unknown class 8",
    ),
    "all background": (all_of(material=7), "all are background"),
    "coords beyond the grid": (slat(coords=lambda c: c.astype(np.int32) * 4), "out of range"),
    "coords of 32^3": (
        slat(coords=lambda c: np.unique(c // 2, axis=0)),
        "rows of coords|no coordinate is above",
    ),
    "two assets in a file": (slat(coords=group_of_two), "more than one asset"),
    "coords twice": (slat(coords=lambda c: np.vstack([c[:-1], c[:1]])), "occurs twice"),
    "feats first": (slat(feats=np.transpose), "has shape"),
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
    "a link to nothing": (shell(nowhere), "is a link that leads nowhere"),
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

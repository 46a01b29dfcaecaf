"""Mistakes of units, layout, names and links: what docs/design/mistakes.md tells is said."""

import re
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
MISTAKES: dict[str, Callable[[Dataset], object]] = {
    "E in GPa": values(e=over(1e9)),
    "E in MPa": values(e=over(1e6)),
    "E in kPa, of steel": all_of(density=7850, e=2e5, nu=0.3),
    "density in g/cm^3": values(density=over(1e3)),
    "E in GPa and density in g/cm^3": values(e=over(1e9), density=over(1e3)),
    "log10 E": values(e=np.log10),
    "log10 density": values(density=np.log10),
    "log10 of E and of density": values(e=np.log10, density=np.log10),
    "normalised for raw": NORMALISED,
    "rubber as dense as steel": all_of(density=7850, e=2e6, nu=0.3),
    "nu in percent": values(nu=over(0.01)),
    "negative E": values(e=np.negative),
    "E above 65,504 in float16": grid(lambda whole: whole.astype(np.float16)),
    "E of 0": values(e=np.zeros_like),
    "a raw grid, channels first": grid(lambda whole: np.moveaxis(whole, -1, 0)),
    "E before density": order(1, 0, 2, 3),
    "nu first": order(2, 1, 0, 3),
    "class id first": order(3, 0, 1, 2),
    "a prediction, channels last": grid(lambda whole: np.zeros((64, 64, 64, 11), np.float32)),
    "a grid of 32^3": grid(lambda whole: whole[::2, ::2, ::2]),
    "a grid of integers": grid(lambda whole: whole.astype(np.int64)),
    "a pickled grid": grid(lambda whole: np.array([{"grid": 1}], object)),
    "class ids of PhysGaussian's own table": all_of(density=200, e=1e5, nu=0.2, material=4),
    "a class id above 7": values(material=lambda one: np.where(one == 0, 8, one)),
    "all background": all_of(material=7),
    "coords beyond the grid": slat(coords=lambda c: c.astype(np.int32) * 4),
    "coords of 32^3": slat(coords=lambda c: np.unique(c // 2, axis=0)),
    "two assets in a file": slat(coords=group_of_two),
    "coords twice": slat(coords=lambda c: np.vstack([c[:-1], c[:1]])),
    "feats first": slat(feats=np.transpose),
    "feats of another encoder": slat(feats=lambda f: np.tile(f, 4)),
    "NaN in feats": slat(feats=lambda f: f * np.nan),
    "standardised feats": slat(feats=lambda f: (f - f.mean(0)) / f.std(0)),
    "no sample folder": shell(lambda r: (r / GRID).rename(r / "pixieverse/a/material_grid.npy")),
    "roots one too deep": shell(deeper),
    "an id in capitals": shell(lambda r: (r / SLAT).rename(r / "slat/A.npz")),
    "two grids of one object": shell(
        lambda r: shutil.copytree(r / "pixieverse/a/sample_0", r / "pixieverse/a/sample_1")
    ),
    "an empty file": shell(lambda r: (r / GRID).write_bytes(b"")),
    "half a file": shell(lambda r: (r / GRID).write_bytes((r / GRID).read_bytes()[:-1000])),
    "a link out of the root": shell(outside),
    "a link to nothing": shell(nowhere),
}


def test_without_a_mistake_nothing_is_said(dataset):
    assert said(dataset.parameters()) == ""


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_told(dataset, name):
    MISTAKES[name](dataset)
    assert listed()[name] in said(dataset.parameters())


def test_the_page_lists_them_all():
    assert list(listed()) == list(MISTAKES)


def listed() -> dict[str, str]:
    """Return what is said of each mistake, as the page tells it."""
    page = (Path(__file__).parents[2] / "docs" / "design" / "mistakes.md").read_text("utf-8")
    return dict(re.findall(r"^\| (.+) \| `(.+)` \|$", page, re.M))

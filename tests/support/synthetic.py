"""Small assets made of numpy alone, with everything about them known by construction."""

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Self

import numpy as np

from slatprep.parameters import (
    AlignParameters,
    BuildParameters,
    NormalizeParameters,
    PixieverseSource,
    SlatSource,
    StoreParameters,
)
from slatprep.records import FEATS_MEAN, FEATS_STD

SMALL_SHARDS = StoreParameters(
    voxel_chunk=128, voxel_chunks_per_shard=4, grid_assets_per_shard=2, compression_level=1
)

# What the two parts of every asset are made of: class, then E, density, nu.
JELLY = (0, 1.0e5, 1.0e3, 0.30)
METAL = (1, 2.0e11, 8.0e3, 0.28)

# A quarter turn about z, (x, y, z) -> (-y, x, z), PixieVerse frame to SLAT frame.
QUARTER_TURN = np.array(
    [[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass
class Asset:
    """One made asset: the grid as Pixie writes it, the SLAT as TRELLIS writes it."""

    grid: np.ndarray
    coords: np.ndarray
    feats: np.ndarray


def make_asset(seed: int = 0) -> Asset:
    """Make an L of two materials, and its surface voxels turned by `QUARTER_TURN`."""
    rng = np.random.default_rng(seed)
    length, width, height = 24 + 2 * (seed % 4), 14, 8
    grid = np.zeros((64, 64, 64, 4), dtype=np.float32)
    grid[..., 3] = 7

    def fill(part: tuple[slice, slice, slice], stuff: tuple[float, ...]) -> None:
        material, modulus, density, ratio = stuff
        grid[part] = (density, modulus, ratio, material)

    fill(np.s_[20 : 20 + length, 22 : 22 + width, 26 : 26 + height], JELLY)
    fill(np.s_[20:26, 22 : 22 + width, 26 : 26 + height + 10], METAL)
    fill(np.s_[20:24, 22:28, 40 : 40 + height], METAL)

    occupied = grid[..., 3] != 7
    buried = np.ones_like(occupied)
    for axis in range(3):
        for step in (-1, 1):
            buried &= np.roll(occupied, step, axis)
    surface = np.argwhere(occupied & ~buried)
    turned = np.stack([63 - surface[:, 1], surface[:, 0], surface[:, 2]], axis=1)
    turned = turned[rng.permutation(len(turned))]
    # As TRELLIS's latents are: those of mean 0 and spread 1 would pass for standardised ones.
    feats = rng.normal(FEATS_MEAN, FEATS_STD, size=(len(turned), 8)).astype(np.float32)
    return Asset(grid, turned.astype(np.uint8), feats)


@dataclass
class Dataset:
    """A folder of sources, and the parameters that build it."""

    shards: ClassVar[StoreParameters] = SMALL_SHARDS

    root: Path
    assets: dict[str, Asset] = field(default_factory=dict)

    def add(self, object_id: str, seed: int, views: tuple[str, ...] = ("",)) -> None:
        """Write an object's grid and one SLAT a view."""
        for number, view in enumerate(views):
            asset = make_asset(seed)
            asset.feats += number
            self.write_grid(object_id, asset.grid)
            name = f"{object_id}/{view}.npz" if view else f"{object_id}.npz"
            self.write_slat(name, asset.coords, asset.feats)
            self.assets[f"{object_id}.{view}" if view else object_id] = asset

    def having(self, *ids: str, seed: int = 0) -> Self:
        """Add objects, each with the next seed."""
        for number, object_id in enumerate(ids, seed):
            self.add(object_id, number)
        return self

    def remove(self, *ids: str) -> None:
        """Take objects of one view away, or what there is of them."""
        for object_id in ids:
            shutil.rmtree(self.root / "pixieverse" / object_id, ignore_errors=True)
            (self.root / "slat" / f"{object_id}.npz").unlink(missing_ok=True)

    def write_grid(
        self, object_id: str, grid: np.ndarray, sample: int = 0, source: str = "pixieverse"
    ) -> None:
        """Write a grid as PixieVerse lays it out."""
        path = self.root / source / object_id / f"sample_{sample}" / "material_grid.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, grid)

    def write_slat(self, name: str, coords: np.ndarray, feats: np.ndarray) -> None:
        """Write a SLAT as TRELLIS's toolkit does."""
        path = self.root / "slat" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, coords=coords, feats=feats)

    def change_slat(self, object_id: str, by: float = 1.0) -> None:
        """Write other latents of an object."""
        asset = self.assets[object_id]
        self.write_slat(f"{object_id}.npz", asset.coords, asset.feats + np.float32(by))

    @property
    def sides(self) -> tuple[object, ...]:
        """Return the options by which a command is told of the sources."""
        return "--pixieverse", self.root / "pixieverse", "--slat", self.root / "slat"

    def parameters(self, ranges: str = "dataset", **groups: dict[str, object]) -> BuildParameters:
        """Return the parameters of a build with many small shards, and with others of groups."""
        usual = BuildParameters(
            PixieverseSource(self.root / "pixieverse"),
            SlatSource(self.root / "slat"),
            align=AlignParameters(),
            normalize=NormalizeParameters(ranges),
            store=self.shards,
        )
        changed = {name: replace(getattr(usual, name), **group) for name, group in groups.items()}
        return replace(usual, **changed)


def definition(parameters: BuildParameters) -> str:
    """Return the text of a definition with these roots, ranges and shards."""
    shards = "".join(f"{name} = {value}\n" for name, value in asdict(parameters.store).items())
    return (
        f'[pixieverse]\nroot = "{parameters.pixieverse.root}"\n'
        f'[slat]\nroot = "{parameters.slat.root}"\n'
        f'[normalize]\nranges = "{parameters.normalize.ranges}"\n[store]\n{shards}'
    )


Made = tuple[Dataset, Path]
"""Sources, and the store of them."""

MakeDataset = Callable[..., Dataset]

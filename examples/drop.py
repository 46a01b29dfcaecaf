"""Drop a steel ball that lies in a block of jelly: from a store, by way of transfer, to a picture.

    pip install 'slatprep[simulate]'
    python examples/drop.py --out docs/images/drop.png

An object of two materials is made in both layouts, built into a store, filled
with particles, and given its materials by `slatprep.transfer`; the PLY that
comes out is all the simulation reads. The unit cube is one metre.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import plyfile
from drop_picture import draw

from slatprep import transfer
from slatprep.build import build_store
from slatprep.geometry import boundary, filled, occupancy_of, voxel_centres
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.records import BACKGROUND, RESOLUTION
from slatprep.simulate import drop, rigid_deviation, strain
from slatprep.store import open_store

# Class, then density [kg/m^3], Young's modulus [Pa] and Poisson's ratio, as PixieVerse orders them.
JELLY = (0, 1050.0, 3.0e4, 0.42)
STEEL = (1, 7200.0, 5.0e10, 0.29)


def main() -> None:
    """Make, transfer, drop, measure and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("drop.png"))
    parser.add_argument("--particles", type=int, default=32, help="along each axis of the cube")
    parser.add_argument("--seconds", type=float, default=0.5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        write_sources(Path(folder))
        positions, material, properties = particles(Path(folder), options.particles)
        spacing = 1.0 / options.particles
        print(f"{len(positions)} particles, {np.count_nonzero(material == 1)} of steel")
        begin = time.perf_counter()
        frames = drop(positions, material, properties, spacing, seconds=options.seconds)
        print(f"simulated {options.seconds} s in {time.perf_counter() - begin:.0f} s")
        strains = np.stack([strain(frames[0], frame, material, spacing) for frame in frames])
        steel = material == 1
        mean = [np.nanmean(strains[:, here], axis=1) for here in (~steel, steel)]
        worst = int(np.argmax(mean[0]))
        apart = max(rigid_deviation(frames[0][steel], frame[steel]) for frame in frames)
        print(f"jelly: mean strain up to {mean[0].max():.3f}, at {worst / 60:.2f} s")
        print(f"steel: mean strain up to {mean[1].max():.4f}, {mean[1][worst]:.4f} at that time")
        print(f"steel: at most {1000 * apart:.2f} mm (rms) from a rigid motion")
        asset = open_store(Path(folder) / "drop.zarr").asset("drop")
        chosen = (0, 13, worst, len(frames) - 1)
        draw(options.out, positions, frames, strains, material, asset, chosen)


def write_sources(folder: Path) -> None:
    """Write the object as PixieVerse and TRELLIS would, a quarter turn about z apart."""
    grid = np.zeros((RESOLUTION,) * 3 + (4,), dtype=np.float32)
    grid[..., 3] = BACKGROUND
    x, y, z = voxel_centres(np.argwhere(grid[..., 3] > 0)).T.reshape(3, *(RESOLUTION,) * 3)
    block = (abs(x) < 0.34) & (abs(y) < 0.25) & (abs(z + 0.2) < 0.16)
    ball = (x - 0.09) ** 2 + (y - 0.03) ** 2 + (z - 0.07) ** 2 < 0.17**2
    for part, (number, density, modulus, ratio) in ((block, JELLY), (ball, STEEL)):
        grid[part] = (density, modulus, ratio, number)
    path = folder / "pixieverse" / "drop" / "sample_0" / "material_grid.npy"
    path.parent.mkdir(parents=True)
    np.save(path, grid)
    surface = np.argwhere(boundary(block | ball))
    turned = np.column_stack([RESOLUTION - 1 - surface[:, 1], surface[:, 0], surface[:, 2]])
    feats = np.random.default_rng(0).normal(size=(len(turned), 8)).astype(np.float32)
    (folder / "slat").mkdir()
    np.savez(folder / "slat" / "drop.npz", coords=turned.astype(np.uint8), feats=feats)


def particles(folder: Path, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fill the SLAT with a lattice of particles and give them the store's materials."""
    sources = BuildParameters(PixieverseSource(folder / "pixieverse"), SlatSource(folder / "slat"))
    build_store(sources, folder / "drop.zarr")
    store = open_store(folder / "drop.zarr")
    inside = filled(occupancy_of(store.asset("drop").coords))
    lattice = (np.argwhere(np.ones((count,) * 3)) + 0.5) / count - 0.5
    voxels = np.floor((lattice + 0.5) * RESOLUTION).astype(int)
    np.save(folder / "solid.npy", lattice[inside[tuple(voxels.T)]])

    # What `slatprep transfer solid.npy --store drop.zarr --asset drop --points grid` does.
    solid = transfer.read_particles(folder / "solid.npy")
    field = transfer.stored_field(store, "drop", points="grid")
    result = transfer.transfer(solid.in_slat(), field, far="drop")
    transfer.write_transferred(folder / "solid.ply", solid, result, max_distance=2.0, in_slat=True)

    vertex = plyfile.PlyData.read(folder / "solid.ply")["vertex"]
    columns = [np.column_stack([vertex[n] for n in names]) for names in
               (("x", "y", "z"), ("E", "density", "nu"))]  # fmt: skip
    return columns[0], np.asarray(vertex["material_id"]), columns[1]


if __name__ == "__main__":
    main()

"""Drop an object of a store: by way of transfer, to a picture.

    pip install 'slatprep[simulate,paper]'
    python examples/drop.py --out docs/images/drop.png
    python examples/drop.py --store demo.zarr --asset ID --size 0.2 --out drop.png

Without a store, a steel ball that lies in a block of jelly is made in both
layouts and built into one. The SLAT is filled with particles, which get their
materials by `slatprep.particles.transfer`; the PLY that comes out is all the simulation
reads.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from slatprep.errors import SlatprepError
from slatprep.geometry.frames import voxel_centres
from slatprep.geometry.voxels import boundary, filled, occupancy_of
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.particles.fields import stored_field
from slatprep.particles.motion import particles_of
from slatprep.particles.read import read_particles
from slatprep.particles.simulate import simulate_motion
from slatprep.particles.transfer import transfer, write_transferred
from slatprep.pipeline.dataset import build_store
from slatprep.records import BACKGROUND, MATERIAL_CLASSES, RESOLUTION
from slatprep.records.yielding import ELASTIC
from slatprep.store import Store, open_store

try:
    import plyfile
    from drop_picture import Part, draw
except ImportError as error:
    raise SystemExit(
        f"drop.py: {error}; it simulates and draws with pip install 'slatprep[simulate,paper]'"
    ) from None

RATE = 60
"""Frames a second."""

# Class, then density [kg/m^3], Young's modulus [Pa] and Poisson's ratio, as PixieVerse orders them.
JELLY = (0, 1050.0, 3.0e4, 0.42)
STEEL = (1, 7200.0, 5.0e10, 0.29)


def main() -> None:
    """Parse the options, and say in one line what cannot be done."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("drop.png"), help="picture to write")
    add("--store", type=Path, help="store of the object; without, a steel ball in jelly is made")
    add("--asset", help="id of the object in the store")
    add("--size", type=float, default=1.0, help="edge of the unit cube [m]")
    add("--particles", type=int, default=32, help="particles along each axis of the cube")
    add("--seconds", type=float, default=0.5, help="length of the motion, at least a 60th")
    add("--substeps", type=int, default=2, help="time steps a 60th of a second")
    options = parser.parse_args()
    if options.seconds < 1 / RATE:
        parser.error(f"--seconds is {options.seconds}; expected at least {1 / RATE:.3f}, one frame")
    if (options.store is None) != (options.asset is None):
        parser.error("--store and --asset go together")
    try:
        run(options)
    except SlatprepError as error:
        parser.exit(1, f"{parser.prog}: error: {error}\n")


def run(options: argparse.Namespace) -> None:
    """Make, transfer, drop, measure and draw."""
    with tempfile.TemporaryDirectory() as folder:
        path, name = options.store, options.asset
        if path is None:
            path, name = make_store(Path(folder)), "drop"
        store = open_store(path)
        require_elastic(store, name)
        positions, material, properties = particles(store, name, options.particles, Path(folder))
        asset = store.asset(name)
    spacing = options.size / options.particles
    begin = time.perf_counter()
    frames = simulate_motion(
        options.size * positions, material, properties, spacing, height=0.25 * options.size,
        seconds=options.seconds, rate=RATE, substeps=options.substeps,
    ).positions  # fmt: skip
    print(
        f"{len(positions)} particles, simulated {options.seconds} s in "
        f"{time.perf_counter() - begin:.0f} s"
    )
    strains = np.stack([strain(frames[0], frame, material, spacing) for frame in frames])
    present = sorted(set(material.tolist()))
    worst = int(np.argmax(np.nanmean(strains[:, material == present[0]], axis=1)))
    parts = []
    for number in present:
        here = material == number
        modulus = in_pascal(float(np.median(properties[here, 0])))
        kind = MATERIAL_CLASSES[number]
        parts.append(Part(number, f"{kind}, E = {modulus}", shiny=number == 1))
        mean = np.nanmean(strains[:, here], axis=1)
        apart = max(rigid_deviation(frames[0][here], frame[here]) for frame in frames)
        print(
            f"{kind}: {here.sum()} particles, E = {modulus}; mean strain {mean[worst]:.4f} at "
            f"{worst / RATE:.2f} s, at most {mean.max():.4f}; at most {1000 * apart:.2f} mm (rms) "
            "from a rigid motion"
        )
    chosen = chosen_frames(len(frames), 0.25 * options.size, worst)
    draw(options.out, positions, frames / options.size, strains, material, asset, parts, chosen)


def require_elastic(store: Store, name: str) -> None:
    """Refuse, before anything is computed, an object of what flows: its strain says nothing."""
    other = sorted(set(store.asset(name).field.material.tolist()) - set(ELASTIC))
    if other:
        words = [[MATERIAL_CLASSES[number] for number in numbers] for numbers in (other, ELASTIC)]
        raise SlatprepError(
            f"{name} has {', '.join(words[0])}; expected an object of {', '.join(words[1])} alone"
        )


def strain(rest: np.ndarray, moved: np.ndarray, part: np.ndarray, spacing: float) -> np.ndarray:
    """Return the largest principal Green-Lagrange strain (F^T F - I) / 2 around each particle (N,).

    F is the least-squares fit to the motion of those of the 26 neighbours on the lattice at rest
    that are of the same `part` (N,); NaN if they do not span the space. Rigid motion has none.
    """
    pairs = cKDTree(rest).query_pairs(1.8 * spacing, output_type="ndarray")
    pairs = pairs[part[pairs[:, 0]] == part[pairs[:, 1]]]
    here, there = np.concatenate([pairs, pairs[:, ::-1]]).T
    old, new = rest[there] - rest[here], moved[there] - moved[here]
    spread, motion = np.zeros((2, len(rest), 3, 3))
    np.add.at(spread, here, old[:, :, None] * old[:, None, :])
    np.add.at(motion, here, new[:, :, None] * old[:, None, :])
    spans = np.linalg.eigvalsh(spread)[:, 0] > 1e-3 * spacing**2
    gradient = motion[spans] @ np.linalg.inv(spread[spans])
    green = (gradient.transpose(0, 2, 1) @ gradient - np.eye(3)) / 2
    result = np.full(len(rest), np.nan)
    result[spans] = np.abs(np.linalg.eigvalsh(green)).max(axis=1)
    return result


def rigid_deviation(rest: np.ndarray, moved: np.ndarray) -> float:
    """Return the root mean square distance of points (N, 3), N >= 3, from their best rigid motion.

    Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta
    Crystallographica A32 (1976).
    """
    before, after = rest - rest.mean(axis=0), moved - moved.mean(axis=0)
    turn, _ = Rotation.align_vectors(after, before)
    return float(np.sqrt(((turn.apply(before) - after) ** 2).sum(axis=1).mean()))


def chosen_frames(count: int, height: float, worst: int) -> tuple[int, ...]:
    """Return the frames to draw: first, last in the air, most strained, last; each once."""
    fall = int(RATE * np.sqrt(2 * height / 9.81))
    return tuple(sorted({0, min(fall, count - 1), worst, count - 1}))


def in_pascal(value: float) -> str:
    """Write a modulus with two digits and a fitting unit."""
    scale, unit = next(pair for pair in ((1e9, "GPa"), (1e6, "MPa"), (1e3, "kPa"), (0.0, "Pa"))
                       if value >= pair[0])  # fmt: skip
    return f"{value / (scale or 1.0):.2g} {unit}"


def make_store(folder: Path) -> Path:
    """Build the steel ball in jelly into a store."""
    write_sources(folder)
    sources = BuildParameters(PixieverseSource(folder / "pixieverse"), SlatSource(folder / "slat"))
    build_store(sources, folder / "drop.zarr")
    return folder / "drop.zarr"


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


def particles(
    store: Store, name: str, count: int, folder: Path
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fill a SLAT with a lattice of particles and give them the store's materials."""
    np.save(folder / "solid.npy", fill(store.asset(name).coords, count))

    # What `slatprep transfer solid.npy --store STORE --asset NAME --points grid --far drop` does.
    solid = read_particles(folder / "solid.npy")
    field = stored_field(store, name, points="grid")
    result = transfer(solid.in_slat(), field, far="drop")
    write_transferred(folder / "solid.ply", solid, result, max_distance=2.0, in_slat=True)

    vertex = plyfile.PlyData.read(folder / "solid.ply")["vertex"]
    columns = [np.column_stack([vertex[n] for n in names]) for names in
               (("x", "y", "z"), ("E", "density", "nu"))]  # fmt: skip
    return columns[0], np.asarray(vertex["material_id"]), columns[1]


def fill(coords: np.ndarray, count: int) -> np.ndarray:
    """Return a lattice of particles (N, 3) inside SLAT voxels, `count` along the unit cube."""
    return particles_of(filled(occupancy_of(coords)), count)


if __name__ == "__main__":
    main()

"""Let objects of a store, or predicted ones, fall or stand in the wind; draw a strip or a GIF.

    pip install 'slatprep[simulate,paper]'
    python examples/scenes.py --store demo.zarr --asset ID --asset ID --out fall.png
    python examples/scenes.py --prediction out/cup.npz --wind 8 --seconds 1.5 --out cup.gif

Each SLAT is filled with particles, which take the material of the nearest voxel
by `slatprep.particles.transfer`: of the PixieVerse field of a stored asset, or of
a prediction of `slatprep predict`. What each class does beyond its elastic limit
is `slatprep.records.yielding.YIELDING`. Without wind the objects fall; in the
wind, along x, they stand, held at the foot and where they are stationary or soil,
in the shape in which they bear their weight already, so without gravity.
"""

from __future__ import annotations

import argparse
import io
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from slatprep.errors import SlatprepError
from slatprep.geometry.voxels import shown_in_cells
from slatprep.normalize import PIXIE_RANGES
from slatprep.particles.fields import VoxelField, predicted_field, stored_field
from slatprep.particles.simulate import simulate_motion
from slatprep.particles.transfer import transfer
from slatprep.readers.ranges import read_ranges
from slatprep.records import MATERIAL_CLASSES, MATERIAL_COLOURS
from slatprep.store import open_store

try:
    import open3d as o3d
    from drop import fill
    from drop_picture import Shape, trace
except ImportError as error:
    raise SystemExit(
        f"scenes.py: {error}; it simulates and draws with pip install 'slatprep[simulate,paper]'"
    ) from None

RATE = 30
"""Frames a second."""
HELD = [MATERIAL_CLASSES.index(name) for name in ("stationary", "sand")]
"""Pots and soil, which hold what grows in them."""


class Scene(NamedTuple):
    """An object in motion: frames (F, N, 3) in edges of the unit cube, each particle's class."""

    name: str
    frames: np.ndarray
    material: np.ndarray


def main() -> None:
    """Parse the options, and say in one line what cannot be done."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    add = parser.add_argument
    add("--store", type=Path, help="store of the objects")
    add("--asset", action="append", default=[], help="an object in the store; may be repeated")
    add("--prediction", type=Path, action="append", default=[], help="or an npz; may be repeated")
    add("--ranges", help="of a prediction without SI values: pixie, or a file")
    add("--wind", type=float, default=0.0, help="along x [m/s]")
    add("--size", type=float, default=0.4, help="edge of the unit cube [m]")
    add("--particles", type=int, default=32, help="particles along each axis of the cube")
    add("--seconds", type=float, default=0.6, help="length of the motion")
    add("--substeps", type=int, default=4, help="time steps a 30th of a second")
    add("--pictures", type=int, default=5, help="pictures in a strip")
    add("--out", type=Path, default=Path("scenes.png"), help="strip (png) or animation (gif)")
    options = parser.parse_args()
    if bool(options.asset) != bool(options.store) or not options.asset + options.prediction:
        parser.error("expected --store with --asset, or --prediction, or both")
    if options.out.suffix.lower() not in (".png", ".gif"):
        parser.error(f"--out is {options.out}; expected a name that ends in .png or .gif")
    if options.seconds < 1 / RATE or options.pictures < 2:
        parser.error("expected --seconds of a frame at least, a 30th, and two --pictures or more")
    try:
        scenes = [run(name, field, options) for name, field in objects(options).items()]
    except SlatprepError as error:
        parser.exit(1, f"{parser.prog}: error: {error}\n")
    write(options.out, scenes, options.pictures, options.particles)


def objects(options: argparse.Namespace) -> dict[str, tuple[np.ndarray, VoxelField]]:
    """Return the SLAT voxels and the materials of each object."""
    found = {}
    if options.asset:
        store = open_store(options.store)
        for name in options.asset:
            asset = store.asset(store.ids[store.match(name)])
            cells, _ = shown_in_cells(asset.coords, asset.latents.resolution)
            found[asset.asset_id] = cells, stored_field(store, asset.asset_id, "grid")
    ranges = options.ranges
    if ranges is not None:
        ranges = PIXIE_RANGES if ranges == "pixie" else read_ranges(Path(ranges))
    for path in options.prediction:
        field = predicted_field(path, ranges)
        found[path.stem] = field.cells, field
    return found


def run(name: str, source: tuple[np.ndarray, VoxelField], options: argparse.Namespace) -> Scene:
    """Fill an object with particles and move them."""
    coords, field = source
    positions = fill(coords, options.particles)
    given = transfer(positions, field, far="nearest")
    spacing = options.size / options.particles
    foot = positions[:, 2] < positions[:, 2].min() + 1.5 / options.particles
    windy = options.wind != 0
    begin = time.perf_counter()
    frames = simulate_motion(
        options.size * positions, given.material, given.properties, spacing,
        height=0.0 if windy else 0.25 * options.size, gravity=0.0 if windy else 9.81,
        wind=(options.wind, 0.0, 0.0),
        fixed=(foot | np.isin(given.material, HELD)) if windy else None,
        seconds=options.seconds, rate=RATE, substeps=options.substeps,
    ).positions  # fmt: skip
    counts = {MATERIAL_CLASSES[k]: int(n) for k, n in enumerate(np.bincount(given.material)) if n}
    print(
        f"{name}: {counts}, {options.seconds} s in {time.perf_counter() - begin:.0f} s; moved "
        f"{np.linalg.norm(frames[-1] - frames[0], axis=1).mean():.3f} m on average, height "
        f"{np.ptp(frames[0][:, 2]):.2f} m to {np.ptp(frames[-1][:, 2]):.2f} m",
        flush=True,
    )
    return Scene(name, frames / options.size, given.material)


def picture(scene: Scene, frame: int, count: int) -> np.ndarray:
    """Return a picture of one moment, each particle a ball in the colour of its class."""
    ball = o3d.geometry.TriangleMesh.create_icosahedron(1.0)
    corners, faces = np.asarray(ball.vertices), np.asarray(ball.triangles)
    centres = scene.frames[frame]
    vertices = (centres[:, None] + 0.75 / count * corners).reshape(-1, 3)
    triangles = (faces + len(corners) * np.arange(len(centres))[:, None, None]).reshape(-1, 3)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(triangles)
    )
    colours = np.array([to_rgb(MATERIAL_COLOURS[number]) for number in scene.material])
    normals = np.tile(corners[faces], (len(centres), 1, 1))
    values = np.repeat(colours, len(faces), axis=0)[:, None].repeat(3, axis=1)
    return trace([Shape(mesh, normals, values, lambda value: value, 0.0)], angle=38.0)


def write(path: Path, scenes: list[Scene], count: int, particles: int) -> None:
    """Write a row of pictures for each object, or all of them side by side in motion."""
    if path.suffix.lower() == ".gif":
        moments = range(len(scenes[0].frames))
        shown = [np.hstack([picture(scene, k, particles) for scene in scenes]) for k in moments]
        first, *others = (Image.fromarray((255 * image).astype(np.uint8)) for image in shown)
        first.save(path, save_all=True, append_images=others, duration=1000 // RATE, loop=0)
        return
    chosen = np.linspace(0, len(scenes[0].frames) - 1, count).round().astype(int)
    figure = Figure(figsize=(2.4 * count, 2.45 * len(scenes)), dpi=100)
    axes = figure.subplots(len(scenes), count, squeeze=False)
    figure.subplots_adjust(left=0, right=1, bottom=0, top=1 - 0.25 / (2.45 * len(scenes)),
                           wspace=0, hspace=0)  # fmt: skip
    for row, scene in zip(axes, scenes, strict=True):
        for axis, frame in zip(row, chosen, strict=True):
            axis.imshow(picture(scene, frame, particles))
            axis.set_axis_off()
    for axis, frame in zip(axes[0], chosen, strict=True):
        axis.set_title(f"{frame / RATE:.2f} s", fontsize=10)
    drawn = io.BytesIO()
    figure.savefig(drawn)
    # Few colours and their shades: a palette is a third of the size.
    Image.open(drawn).convert("RGB").quantize(192).save(path, optimize=True)


if __name__ == "__main__":
    main()

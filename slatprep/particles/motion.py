"""Turn voxels with materials, and Gaussians, into frames of moved Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError
from slatprep.export.ply import has_comment
from slatprep.geometry.voxels import filled, occupancy_of
from slatprep.particles import gaussians as splats
from slatprep.particles.fields import VoxelField
from slatprep.particles.read import FRAMES, Axes, Particles, read_particles
from slatprep.particles.transfer import doubt_axes, recognise_axes, transfer
from slatprep.records import BACKGROUND, MATERIAL_CLASSES, RESOLUTION
from slatprep.storage.atomic import staged, writing

CLASSES = MATERIAL_CLASSES[:BACKGROUND]

_HELD = tuple(MATERIAL_CLASSES.index(name) for name in ("stationary", "sand"))
"""Classes of pots and soil, which stay fixed in the wind and hold the plants in them."""


class Scene(NamedTuple):
    """Particles (N, 3) in the SLAT frame, their materials, and the Gaussians that they carry.

    `vertices` are the Gaussians as rows of a PLY, and `places` (G, 3) lie in the SLAT frame.
    """

    positions: NDArray[np.float64]
    spacing: float
    material: NDArray[np.uint8]
    properties: NDArray[np.float32]
    vertices: NDArray[Any]
    places: NDArray[np.float64]
    axes: Axes
    notes: tuple[str, ...]


def prepare(
    field: VoxelField,
    gaussians: Path | None,
    axes: Axes | None,
    count: int,
    material: str | None = None,
    young: float | None = None,
    density: float | None = None,
) -> Scene:
    """Fill the object with particles, `count` to a side of the unit cube, and get its Gaussians.

    The SLAT's voxels are the surface of the object. Class, Young's modulus [Pa] and density
    [kg/m^3] are for the whole object; None keeps the field's.
    """
    surface = field
    if (cells := field.surface) is not None:
        nothing = np.zeros(len(cells), np.uint8), np.ones((len(cells), 3), np.float32)
        surface = VoxelField(cells, *nothing)
    solid = filled(occupancy_of(surface.cells))
    positions = particles_of(solid, count)
    size, notes = (len(positions) / count**3) / solid.mean(), []
    if len(positions) and abs(size - 1.0) > 0.02:
        notes.append(
            f"the particles fill {size:.3g} times the object's volume, and weigh {size:.3g} times "
            f"as much; --particles {RESOLUTION} fills it exactly"
        )
    given = transfer(positions, field, far="nearest")
    classes, properties = given.material.copy(), given.properties.copy()
    if material is not None:
        classes[:] = MATERIAL_CLASSES.index(material)
    for column, value in ((0, young), (1, density)):
        if value is not None:
            properties[:, column] = value
    own = positions, 1 / count, classes, properties
    if gaussians is None:
        made = splats.gaussians_of(positions, classes, 1 / count)
        return Scene(*own, made, positions, "slat", tuple(notes))
    read, told = _read(gaussians, axes, field, surface)
    vertices = splats.require_gaussians(read.vertices, gaussians)
    return Scene(*own, vertices, read.in_slat(), read.axes, (*notes, *told))


def particles_of(solid: NDArray[np.bool_], count: int) -> NDArray[np.float64]:
    """Return centres (N, 3), in the unit cube, of the cubes of a lattice that a solid fills.

    The solid (64, 64, 64) must fill at least half of a cube. The lattice has `count` to a side.
    """
    # In parts of a voxel's edge, `count` to a voxel: whole numbers, which float32 holds exactly.
    voxels, cubes = count * np.arange(RESOLUTION), RESOLUTION * np.arange(count)[:, None]
    ends = np.minimum(cubes + RESOLUTION, voxels + count)
    parts = np.maximum(ends - np.maximum(cubes, voxels), 0).astype(np.float32)
    shares = solid.astype(np.float32)
    for _ in range(3):  # Each product puts the first axis last.
        shares = np.tensordot(shares, parts, (0, 1))
    return (np.argwhere(2 * shares >= RESOLUTION**3) + 0.5) / count - 0.5


def _read(
    path: Path, axes: Axes | None, field: VoxelField, surface: VoxelField
) -> tuple[Particles, tuple[str, ...]]:
    """Read Gaussians, and check that they lie where the object does."""
    read, recognised = recognise_axes(read_particles(path, axes), field)
    doubt = doubt_axes(read, surface, transfer(read.in_slat(), surface), 2.0)
    notes = [f"{path}: {text}" for text in (recognised, doubt) if text]
    names = read.vertices.dtype.names if read.vertices is not None else None
    if "f_rest_0" in (names or ()):
        notes.append(f"{path}: colours that depend on the view (f_rest_*) do not turn along")
    return read, tuple(notes)


def run(
    scene: Scene, *, size: float, height: float, wind: float, device: str | None, **options: Any
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Simulate the particles; return positions (F, N, 3) in the SLAT frame, and gradients.

    The unit cube is `size` [m] wide. The object falls from `height` [m], or stands in the `wind`
    [m/s] along x without gravity. The default `device` is the GPU if there is one. `options` are
    others of `simulate_motion`.
    """
    from slatprep.particles.simulate import preferred_device, simulate_motion

    windy = wind != 0
    heights = scene.positions[:, 2]
    foot = heights < heights.min(initial=np.inf) + 1.5 * scene.spacing
    moved = simulate_motion(
        scene.positions * size,
        scene.material,
        scene.properties,
        scene.spacing * size,
        height=0.0 if windy else height,
        gravity=0.0 if windy else 9.81,
        wind=(wind, 0.0, 0.0),
        fixed=(foot | np.isin(scene.material, _HELD)) if windy else None,
        device=device or preferred_device(),
        **options,
    )
    # In the first frame the object lies where the SLAT has it.
    shift = moved.positions[0] - scene.positions * size
    return (moved.positions - shift) / size, moved.gradients


def old_frames(out: Path) -> list[Path]:
    """Return the frames of an earlier run; ConfigError if another file has such a name."""
    named = [one for one in out.glob("frame-*.ply") if one.stem.removeprefix("frame-").isdigit()]
    for one in named:
        if not has_comment(one, *FRAMES.values()):
            raise ConfigError(
                f"{one} is no frame of slatprep; move it away, or choose another --out"
            )
    return named


def require_writable(*folders: Path) -> None:
    """Make the folders, and raise StoreError if no file can be written to one of them."""
    for folder in folders:
        with writing(str(folder), folder.parent):
            folder.mkdir(parents=True, exist_ok=True)
            TemporaryFile(dir=folder).close()


def write_frames(
    out: Path,
    scene: Scene,
    moved: tuple[NDArray[np.float64], NDArray[np.float32]],
    rate: int,
    picture: Path | None,
    stretch: bool,
    progress: Callable[[int, int], None],
) -> int:
    """Write ``frame-0000.ply`` and so on, and the picture; return the number of frames.

    Of the `old_frames` in `out` those are removed in the end that this run does not have.
    """
    out.mkdir(parents=True, exist_ok=True)
    left = set(old_frames(out))
    carrier = splats.bind(scene.places, scene.positions, scene.spacing)
    low = moved[0].min(axis=(0, 1)) - scene.spacing
    high = moved[0].max(axis=(0, 1)) + scene.spacing
    pictures = []
    frames = len(moved[0])
    for number, (positions, gradients) in enumerate(zip(*moved, strict=True)):
        places, local = splats.carry(carrier, positions, gradients)
        rows = splats.deform(scene.vertices, places, local, scene.axes, stretch=stretch)
        file = out / f"frame-{number:04d}.ply"
        with staged(file) as path:
            splats.write_gaussians(path, rows, FRAMES[scene.axes])
        left.discard(file)
        if picture is not None:
            pictures.append(splats.draw(rows, places, low, high))
        progress(number + 1, frames)
    if picture is not None:
        splats.write_picture(picture, pictures, rate)
    for file in left:
        file.unlink()
    return frames

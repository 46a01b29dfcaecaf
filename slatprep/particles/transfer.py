"""Transfer materials from voxels to particles, such as the Gaussians of a PLY.

Simulations use particles, while stores and predictions have voxels. Each particle takes the
values of its nearest voxel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.errors import ConfigError, require_one_of
from slatprep.export import target
from slatprep.export.ply import UNITS, VERTEX, has_comment, write_points
from slatprep.geometry.voxels import filled, occupancy_of
from slatprep.particles.fields import VoxelField
from slatprep.particles.read import FRAMES, Axes, Particles
from slatprep.records import BACKGROUND, RESOLUTION

Far = Literal["background", "drop", "nearest"]

MANY_FAR, MOST_FAR = 0.2, 0.5
"""Shares of far particles above which other axes are tried, and above which it is an error."""


_GAUSSIAN_AXES: tuple[Axes, Axes] = ("trellis", "slat")
"""Axes in which TRELLIS and SAM 3D Objects save Gaussians."""

_ALIKE, _SLACK, _SAME = 1.2, 0.1, 0.99
"""Factor and sum within which two axes' mean distances [voxel] count as equal, and smallest share
of particles with equal materials at which the choice of axes does not matter."""


@dataclass(frozen=True)
class Transferred:
    """Materials at particles, in SI units.

    Attributes
    ----------
    rows : ndarray of intp, shape (M,)
        The particle of each row, ascending; all particles unless some were dropped.
    material : ndarray of uint8, shape (M,)
        Class 0..6; 7 for background.
    properties : ndarray of float32, shape (M, 3)
        Young's modulus [Pa], density [kg/m^3], Poisson's ratio; 0 for background.
    distance : ndarray of float64, shape (M,)
        Distance to the nearest voxel, in voxels of a 64^3 grid.
    far : int
        Number of particles without a voxel within `max_distance`.
    """

    rows: NDArray[np.intp]
    material: NDArray[np.uint8]
    properties: NDArray[np.float32]
    distance: NDArray[np.float64]
    far: int


def transfer(
    points: ArrayLike, field: VoxelField, *, max_distance: float = 2.0, far: Far = "background"
) -> Transferred:
    """Give each particle (N, 3) of the SLAT frame the material of the nearest voxel.

    A particle without a voxel within `max_distance` voxels is far. It gets class 7 and properties 0
    (background), no row (drop), or the nearest voxel's material (nearest).
    """
    require_one_of("far", far, get_args(Far))
    if not max_distance > 0:
        raise ConfigError(f"max_distance is {max_distance}; expected a number above 0")
    distance, used = field.nearest(points)
    near = distance <= max_distance
    taken = near | (far == "nearest")
    material = np.where(taken, field.material[used], np.uint8(BACKGROUND))
    properties = np.where(taken[:, None], field.properties[used], np.float32(0.0))
    rows = np.flatnonzero(near) if far == "drop" else np.arange(len(near))
    return Transferred(
        rows, material[rows], properties[rows], distance[rows], int(np.count_nonzero(~near))
    )


def recognise_axes(
    particles: Particles, field: VoxelField, max_distance: float = 2.0
) -> tuple[Particles, str]:
    """Tell TRELLIS's Gaussians from those of SAM 3D Objects, which have the same fields.

    Returns the particles with the axes that fit, and a remark if these are not TRELLIS's.
    ConfigError if both fit alike but give different materials, as for a ball or a crate.
    """
    if not particles.guessed:
        return particles, ""
    tried, apart = {}, {}
    for axes in _GAUSSIAN_AXES:
        points = _some(particles, axes)
        tried[axes] = transfer(points, field, max_distance=max_distance, far="nearest")
        apart[axes] = float(np.minimum(tried[axes].distance, 2 * max_distance).mean())
    best, other = sorted(_GAUSSIAN_AXES, key=lambda axes: apart[axes])
    if apart[other] <= _ALIKE * apart[best] + _SLACK:
        one, two = tried[best], tried[other]
        alike = (one.material == two.material) & np.isclose(
            one.properties, two.properties, rtol=1e-3
        ).all(axis=1)
        if alike.mean() < _SAME:
            raise ConfigError(
                "TRELLIS and SAM 3D Objects save the same fields in other axes. This object fits "
                f"either, {apart['trellis']:.2f} and {apart['slat']:.2f} voxels from the nearest "
                f"voxel, with other materials for {1 - alike.mean():.0%}. Give --axes trellis for "
                "Gaussians of TRELLIS, --axes slat for those of SAM 3D Objects"
            )
        best = "trellis"
    if best == "trellis":
        return particles, ""
    return replace(particles, axes=best), (
        f"the Gaussians are not turned as TRELLIS turns them: {apart['trellis']:.2f} voxels from "
        f"the nearest voxel, {apart['slat']:.2f} as they are. So they are read as SAM 3D Objects "
        "saves them: --axes slat"
    )


def doubt_axes(
    particles: Particles, field: VoxelField, result: Transferred, max_distance: float
) -> str:
    """Explain why many particles are far: wrong axes, another scale, or a surface of voxels.

    Returns one line, empty if at most the share `MANY_FAR` is far. ConfigError with the same line
    if more than `MOST_FAR` are far, or if other axes would leave less than a tenth of them far.
    """
    count = len(particles.positions)
    if result.far <= MANY_FAR * count:
        return ""
    shares: dict[Axes, float] = {}
    for axes in get_args(Axes):
        some = _some(particles, axes)
        shares[axes] = transfer(some, field, max_distance=max_distance).far / len(some)
    points = particles.in_slat()
    distance = transfer(points, field, max_distance=max_distance).distance
    far = distance > max_distance
    why = (
        f"{result.far:,} of {count:,} particles have no voxel within {max_distance:g} voxels "
        f"({result.far / count:.0%}, half of them none within {np.median(distance[far]):.3g}), "
        f"as the file is read with --axes {particles.axes}"
    )
    fitting = min(shares, key=lambda axes: shares[axes])
    inside = _enclosed(field, points[far])
    if shares[fitting] < 0.5 * shares[particles.axes]:
        why += f"; with --axes {fitting} {shares[fitting]:.0%} would be far"
    elif inside > 0.5:
        why += (
            f"; {inside:.0%} of them lie inside the object, whose voxels here are its surface: "
            "--points grid has materials inside"
        )
    else:
        low, high = particles.positions.min(), particles.positions.max()
        why += (
            f", and no other --axes brings them nearer; they lie between {low:.3g} and "
            f"{high:.3g}, expected positions of this object in the unit cube, -0.5 to 0.5"
        )
    if particles.foreign:
        why += f"; the Gaussians are another tool's than TRELLIS, in its scale: {particles.foreign}"
    if result.far > MOST_FAR * count or shares[fitting] < 0.1 * shares[particles.axes]:
        raise ConfigError(f"{why}. If all is right, --max-distance may be larger")
    return why


def _some(particles: Particles, axes: Axes) -> NDArray[np.float64]:
    """Return positions in the SLAT frame, read with `axes`, of at most 40,000 particles."""
    some = particles.positions[:: max(1, len(particles.positions) // 20_000)]
    return Particles(some, axes).in_slat()


def _enclosed(field: VoxelField, points: NDArray[np.float64]) -> float:
    """Return the share of points in the SLAT frame that the field's voxels enclose."""
    voxels = np.floor((field.locate(points) + 0.5) * RESOLUTION).astype(int)
    there = ((voxels >= 0) & (voxels < RESOLUTION)).all(axis=1)
    solid = filled(occupancy_of(field.cells))
    return float(solid[tuple(voxels[there].T)].sum() / max(len(points), 1))


def write_transferred(
    path: Path, particles: Particles, result: Transferred, *, max_distance: float, in_slat: bool
) -> None:
    """Write the materials of particles as Pixie's PLY for PhysGaussian.

    Attributes of Gaussians follow Pixie's fields. ``conf`` falls to 0 at `max_distance`
    voxels. ConfigError if another file is at `path`.
    """
    frame = FRAMES["slat" if in_slat else particles.axes]
    positions = particles.in_slat() if in_slat else particles.positions
    held, more = particles.vertices, {}
    if held is not None:
        names = [name for name in held.dtype.names or () if name not in (VERTEX.names or ())]
        kept = (name for name in names if held.dtype[name].kind in "fiu")
        more = {(name, ""): held[name][result.rows] for name in kept}
    with target.file(path, lambda there: has_comment(there, UNITS)) as new:
        write_points(
            new,
            positions[result.rows],
            result.material,
            result.properties,
            np.clip(1.0 - result.distance / max_distance, 0.0, 1.0),
            frame,
            more,
        )

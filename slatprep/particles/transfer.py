"""Transfer materials from voxels to particles, such as the Gaussians of a PLY.

Simulations use particles, while stores and predictions have voxels. Each particle takes the
values of its nearest voxel.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.errors import ConfigError
from slatprep.particles.fields import VoxelField
from slatprep.particles.read import FRAMES, Axes, Particles
from slatprep.records import BACKGROUND, RESOLUTION

Far = Literal["background", "drop", "nearest"]

MANY_FAR, MOST_FAR = 0.2, 0.5
"""Shares of far particles above which other axes are tried, and above which it is an error."""


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
        Distance to the nearest voxel, in voxels of the field.
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
    """Give each particle the material of the nearest voxel.

    Parameters
    ----------
    points : array_like, shape (N, 3)
        Particles in the SLAT frame, the unit cube [-0.5, 0.5]^3, z up.
    field : VoxelField
        The materials.
    max_distance : float
        Distance [voxel] to the nearest voxel above which a particle is far.
    far : {"background", "drop", "nearest"}
        What far particles get: class 7 and properties 0, like empty voxels of PixieVerse; no
        row; or the nearest voxel's material.

    Returns
    -------
    Transferred
        Materials in the order of the particles.

    Raises
    ------
    ConfigError
        If `far` or `max_distance` is not an allowed value.
    """
    from slatprep.geometry.nearest import Lattice

    if far not in get_args(Far):
        raise ConfigError(f"far is {far!r}; expected one of {', '.join(get_args(Far))}")
    if not max_distance > 0:
        raise ConfigError(f"max_distance is {max_distance}; expected a number above 0")
    distance, used = Lattice(field.voxels).nearest(field.locate(points))
    near = distance <= max_distance
    material = np.where(near | (far == "nearest"), field.material[used], np.uint8(BACKGROUND))
    properties = np.where(
        (near | (far == "nearest"))[:, None], field.properties[used], np.float32(0.0)
    )
    rows = np.flatnonzero(near) if far == "drop" else np.arange(len(near))
    return Transferred(
        rows, material[rows], properties[rows], distance[rows], int(np.count_nonzero(~near))
    )


def doubt_axes(
    particles: Particles, field: VoxelField, result: Transferred, max_distance: float
) -> str:
    """Explain why many particles are far: wrong axes, another scale, or a surface of voxels.

    Parameters
    ----------
    particles : Particles
        The particles.
    field : VoxelField
        The materials.
    result : Transferred
        From `transfer`.
    max_distance : float
        As for `transfer` [voxel].

    Returns
    -------
    str
        One line; empty if at most `MANY_FAR` of the particles are far.

    Raises
    ------
    ConfigError
        With the same line, if more than `MOST_FAR` of them are far, or with other axes less
        than a tenth as many.
    """
    count = len(particles.positions)
    if result.far <= MANY_FAR * count:
        return ""
    shares: dict[Axes, float] = {}
    for axes in get_args(Axes):
        some = Particles(particles.positions[:: max(1, count // 20_000)], axes)
        tried = transfer(some.in_slat(), field, max_distance=max_distance)
        shares[axes] = tried.far / len(some.positions)
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


def _enclosed(field: VoxelField, points: NDArray[np.float64]) -> float:
    """Return the share of points in the SLAT frame that the field's voxels enclose."""
    from slatprep.geometry.voxels import filled, occupancy_of

    voxels = np.floor((field.locate(points) + 0.5) * RESOLUTION).astype(int)
    there = ((voxels >= 0) & (voxels < RESOLUTION)).all(axis=1)
    solid = filled(occupancy_of(field.voxels))
    return float(solid[tuple(voxels[there].T)].sum() / max(len(points), 1))


def write_transferred(
    path: Path, particles: Particles, result: Transferred, *, max_distance: float, in_slat: bool
) -> None:
    """Write the materials of particles as Pixie's PLY for PhysGaussian.

    Parameters
    ----------
    path : Path
        The file; an existing material PLY is replaced.
    particles : Particles
        The particles.
    result : Transferred
        From `transfer`.
    max_distance : float
        Distance [voxel] at which ``conf`` is 0.
    in_slat : bool
        Whether to write positions in the SLAT frame instead of the file's.

    Raises
    ------
    ConfigError
        If another file is at `path`.
    SlatprepError
        If it cannot be written.
    """
    from slatprep.export import target
    from slatprep.export.ply import write_points

    frame = FRAMES["slat" if in_slat else particles.axes]
    positions = particles.in_slat() if in_slat else particles.positions
    with target.file(path, _is_material_ply) as new:
        write_points(
            new,
            positions[result.rows],
            result.material,
            result.properties,
            np.clip(1.0 - result.distance / max_distance, 0.0, 1.0),
            frame,
        )


def _is_material_ply(path: Path) -> bool:
    from slatprep.export.ply import UNITS

    with path.open("rb") as stream:
        return UNITS.encode() in stream.read(1024)

"""How the two sides of a demo asset differ: frames, scale, warp and damage, by level.

======  ==========================================================================
level   the PixieVerse side against the SLAT side
======  ==========================================================================
0       a quarter turn
1       plus a tilt up to 15 degrees and a shift up to 1.5 voxels, one scale
2       plus a scale mismatch of 2 to 10 percent, bites and floaters
3       any rotation, both sides scaled by their own bounding boxes, damage as 2
4       as 1, plus a smooth warp of the SLAT side of about one voxel
======  ==========================================================================
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from slatprep.demo.shapes import Solid, bounding_box
from slatprep.geometry.frames import VOXEL_SIZE, make_transform, voxel_centres
from slatprep.geometry.voxels import boundary
from slatprep.records import RESOLUTION

Rng = np.random.Generator
Array = NDArray[np.float64]

# A hair less than the cube, so that no surface lies on its very faces.
_FULL = 1.0 - 1e-4


UNLABELLED = -2
"""Marks the occupied voxels of a damaged grid that carry no label (-1 in PixieVerse)."""


@dataclass(frozen=True)
class Difficulty:
    """What makes one level: angles in degrees, lengths in voxels, scale as a share."""

    tilt: float = 0.0
    shift: float = 0.0
    scale: tuple[float, float] = (0.0, 0.0)
    any_rotation: bool = False
    damaged: bool = False
    warp: float = 0.0


LEVELS: dict[int, Difficulty] = {
    0: Difficulty(),
    1: Difficulty(tilt=15.0, shift=1.5),
    2: Difficulty(tilt=15.0, shift=1.5, scale=(0.02, 0.10), damaged=True),
    3: Difficulty(any_rotation=True, damaged=True),
    4: Difficulty(tilt=15.0, shift=1.5, warp=1.0),
}


def _quarter_turns() -> tuple[Array, ...]:
    matrices = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                matrices.append(matrix)
    return tuple(matrices)


QUARTER_TURNS = _quarter_turns()
"""The 24 rotations of a cube."""


@dataclass(frozen=True)
class Pose:
    """Where an object lies in a frame: ``x = scale * rotation @ (p - centre) + shift``."""

    rotation: Array
    scale: float
    centre: Array
    shift: Array

    def matrix(self) -> Array:
        """Return the pose as a 4x4 transform, object to frame."""
        shift = self.shift - self.scale * self.rotation @ self.centre
        return make_transform(self.rotation, shift, self.scale)

    def to_object(self, points: Array) -> Array:
        """Map points (P, 3) of the frame to the object."""
        mapped: Array = (points - self.shift) / self.scale @ self.rotation + self.centre
        return mapped


@dataclass(frozen=True)
class Warp:
    """A smooth displacement: a sum of plane sine waves.

    ``amplitude`` and ``wave`` are (W, 3), in units of the cube and radians
    across it; ``phase`` is (W,).
    """

    amplitude: Array
    wave: Array
    phase: Array

    def __call__(self, points: Array) -> Array:
        """Return the displaced points."""
        moved: Array = points + np.sin(points @ self.wave.T + self.phase) @ self.amplitude
        return moved

    @property
    def reach(self) -> float:
        """No point moves farther than this."""
        return float(np.linalg.norm(self.amplitude, axis=1).sum())

    @property
    def stretch(self) -> float:
        """No distance grows by more than this factor."""
        lengths = np.linalg.norm(self.amplitude, axis=1) * np.linalg.norm(self.wave, axis=1)
        return 1.0 + float(lengths.sum())


@dataclass(frozen=True)
class Frames:
    """The two poses of one asset, and the warp of its SLAT side (none where None)."""

    pixieverse: Pose
    slat: Pose
    warp: Warp | None

    def transform(self) -> Array:
        """Return the true transform, PixieVerse frame to SLAT frame; the warp is not in it."""
        slat, pixieverse = self.slat, self.pixieverse
        rotation = slat.rotation @ pixieverse.rotation.T
        scale = slat.scale / pixieverse.scale
        offset = slat.scale * slat.rotation @ (pixieverse.centre - slat.centre) + slat.shift
        return make_transform(rotation, offset - scale * rotation @ pixieverse.shift, scale)

    def slat_to_object(self, points: Array) -> Array:
        """Map points (P, 3) of the SLAT frame to the object."""
        return self.slat.to_object(self.warp(points) if self.warp else points)

    def slat_distance(self, solid: Solid) -> Callable[[Array], Array]:
        """Return the distance bound of a solid in the SLAT frame."""
        factor = self.slat.scale / (self.warp.stretch if self.warp else 1.0)
        return lambda points: factor * solid.distance(self.slat_to_object(points))

    def pixieverse_distance(self, solid: Solid) -> Callable[[Array], Array]:
        """Return the distance bound of a solid in the PixieVerse frame."""
        pose = self.pixieverse
        return lambda points: pose.scale * solid.distance(pose.to_object(points))


def draw_frames(rng: Rng, solid: Solid, difficulty: Difficulty, quarter: Array) -> Frames:
    """Draw the poses of one asset.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the random parts.
    solid : Solid
        The object.
    difficulty : Difficulty
        What its level asks for.
    quarter : ndarray, shape (3, 3)
        Quarter turn of the PixieVerse side; the SLAT side stands upright.

    Returns
    -------
    Frames
        Poses that keep both sides within their cubes.
    """
    middle = solid.extent.mean(axis=0)
    warp = _draw_warp(rng, difficulty.warp) if difficulty.warp else None
    room = _FULL - 2.0 * warp.reach if warp else _FULL
    slat_scale = room / float((solid.extent[1] - solid.extent[0]).max())

    if difficulty.any_rotation:
        rotation = _any_rotation(rng)
        box = bounding_box(solid.shapes, rotation)
        pixieverse = Pose(
            rotation, _FULL / float((box[1] - box[0]).max()), rotation.T @ box.mean(0), np.zeros(3)
        )
        return Frames(pixieverse, Pose(np.eye(3), slat_scale, middle, np.zeros(3)), warp)

    rotation = _tilt(rng, difficulty.tilt) @ quarter if difficulty.tilt else quarter
    shift = np.zeros(3)
    if difficulty.shift:
        shift = _direction(rng) * rng.uniform(0.0, difficulty.shift) * VOXEL_SIZE
    box = bounding_box(solid.shapes, rotation) - rotation @ middle
    # The largest scale at which neither side of the shifted box leaves the cube.
    largest = float(np.min(np.stack([_FULL / 2 + shift, _FULL / 2 - shift]) / np.abs(box)))
    mismatch = 1.0
    if difficulty.scale[1]:
        mismatch += rng.choice([-1.0, 1.0]) * rng.uniform(*difficulty.scale)
    slat_scale = min(slat_scale, largest * mismatch)
    return Frames(
        Pose(rotation, slat_scale / mismatch, middle, shift),
        Pose(np.eye(3), slat_scale, middle, np.zeros(3)),
        warp,
    )


def _direction(rng: Rng) -> Array:
    vector = rng.normal(size=3)
    unit: Array = vector / np.linalg.norm(vector)
    return unit


def _tilt(rng: Rng, degrees: float) -> Array:
    """Return a rotation about any axis by up to `degrees` (Rodrigues' formula)."""
    x, y, z = _direction(rng)
    angle = np.radians(rng.uniform(0.0, degrees))
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    tilt: Array = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return tilt


def _any_rotation(rng: Rng) -> Array:
    """Return a rotation drawn uniformly: a unit quaternion of four normal deviates."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _draw_warp(rng: Rng, voxels: float, waves: int = 3) -> Warp:
    """Return a warp whose root mean square displacement is about `voxels`."""
    size = voxels * VOXEL_SIZE * np.sqrt(2.0 / waves)
    amplitude = np.stack([size * _direction(rng) for _ in range(waves)])
    wave = np.stack([2.0 * np.pi * rng.uniform(0.7, 1.3) * _direction(rng) for _ in range(waves)])
    return Warp(amplitude, wave, rng.uniform(0.0, 2.0 * np.pi, waves))


def damage(
    rng: Rng, stuff: NDArray[np.int16], distance: Callable[[Array], Array], stuffs: int
) -> NDArray[np.int16]:
    """Bite pieces out of a grid and add floaters, as a NeRF's density does.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the random parts.
    stuff : ndarray of int16, shape (64, 64, 64)
        Index of the stuff of each voxel, -1 where empty.
    distance : callable
        Distance bound of the solid in the grid's frame.
    stuffs : int
        How many stuffs the asset has; a floater is of any.

    Returns
    -------
    ndarray of int16, shape (64, 64, 64)
        The damaged grid; `UNLABELLED` marks the occupied voxels of one floater that
        carries no label.
    """
    damaged = stuff.copy()
    index = np.argwhere(np.ones(stuff.shape, dtype=bool))
    skin = np.argwhere(boundary(stuff >= 0))
    for _ in range(rng.integers(1, 4)):
        centre, radius = skin[rng.integers(len(skin))], rng.uniform(2.5, 5.0)
        damaged[tuple(index[((index - centre) ** 2).sum(axis=1) < radius**2].T)] = -1

    wanted = int(rng.integers(2, 5))
    places = rng.integers(3, RESOLUTION - 3, (200, 3))
    free = places[distance(voxel_centres(places)) > 4.5 * VOXEL_SIZE][:wanted]
    for k, centre in enumerate(free):
        radii = rng.uniform(1.0, 2.5, 3)
        blob = index[(((index - centre) / radii) ** 2).sum(axis=1) < 1.0]
        empty = blob[damaged[tuple(blob.T)] == -1]
        damaged[tuple(empty.T)] = UNLABELLED if k == 0 else rng.integers(stuffs)
    return damaged

"""Differences between the two sides of a demo asset, by level: frames, scale, warp, damage.

======  ==========================================================================
level   PixieVerse side compared with the SLAT side
======  ==========================================================================
0       a quarter turn
1       plus a tilt up to 15 degrees and a shift up to 1.5 voxels, one scale
2       plus a scale mismatch of 2 to 10 percent, bites and floaters
3       any rotation, both sides scaled by their own bounding boxes, damage as 2
4       as 1, plus a smooth warp of the SLAT side of about one voxel
5       tilt and shift as 1, the SLAT side a generated shape (`slatprep.demo.generated`),
        bites and floaters
6       tilt and shift as 1, the PixieVerse side a NeRF's field (`slatprep.demo.nerf`)
7       both in any rotation
======  ==========================================================================

From level 5 on, each side is scaled by its own bounding box.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slatprep.demo.generated import Distortion, Waves, draw_distortion
from slatprep.demo.model import Rng, direction
from slatprep.demo.shapes import Solid, bounding_box
from slatprep.geometry.frames import VOXEL_SIZE, Array, cube_symmetries, make_transform

# Slightly smaller than the cube, so that no surface lies exactly on its faces.
_FULL = 1.0 - 1e-4


@dataclass(frozen=True)
class Difficulty:
    """Settings of a level: angles in degrees, lengths in voxels, scale as a share.

    ``bend`` is that of a generated shape, see `slatprep.demo.generated.draw_distortion`. ``room``
    is the margin for a NeRF's field on each side of the grid.
    """

    tilt: float = 0.0
    shift: float = 0.0
    scale: tuple[float, float] = (0.0, 0.0)
    any_rotation: bool = False
    damaged: bool = False
    warp: float = 0.0
    own_boxes: bool = False
    bend: float = 0.0
    nerf: bool = False
    room: float = 0.0

    @property
    def generated(self) -> bool:
        """Whether the SLAT side is a generated shape."""
        return self.bend > 0.0

    @property
    def has_places(self) -> bool:
        """Whether the truth gives a place for each SLAT voxel."""
        return self.generated or self.nerf or self.warp > 0.0


LEVELS: dict[int, Difficulty] = {
    0: Difficulty(),
    1: Difficulty(tilt=15.0, shift=1.5),
    2: Difficulty(tilt=15.0, shift=1.5, scale=(0.02, 0.10), damaged=True),
    3: Difficulty(any_rotation=True, damaged=True),
    4: Difficulty(tilt=15.0, shift=1.5, warp=1.0),
    5: Difficulty(tilt=15.0, shift=1.5, own_boxes=True, damaged=True, bend=2.0),
    6: Difficulty(tilt=15.0, shift=1.5, own_boxes=True, nerf=True, room=2.0),
    7: Difficulty(any_rotation=True, own_boxes=True, bend=2.0, nerf=True, room=2.0),
}

SAME_SHAPE_LEVELS = (0, 1, 2, 3, 4)
"""Levels on which both sides come from the same shape; the default of a demo."""

QUARTER_TURNS = tuple(turn.astype(float) for turn in cube_symmetries() if np.linalg.det(turn) > 0)
"""The 24 rotations of a cube."""


@dataclass(frozen=True)
class Pose:
    """Placement of an object in a frame: ``x = scale * rotation @ (p - centre) + shift``."""

    rotation: Array
    scale: float
    centre: Array
    shift: Array

    def to_object(self, points: Array) -> Array:
        """Map points (P, 3) of the frame to object coordinates."""
        return np.asarray((points - self.shift) / self.scale @ self.rotation + self.centre)

    def from_object(self, points: Array) -> Array:
        """Map points (P, 3) in object coordinates to the frame."""
        return np.asarray(self.scale * (points - self.centre) @ self.rotation.T + self.shift)


@dataclass(frozen=True)
class Frames:
    """The two poses of an asset, and the warp or the distortion of its SLAT side, if any."""

    pixieverse: Pose
    slat: Pose
    warp: Waves | None
    distortion: Distortion | None = None

    def transform(self) -> Array:
        """Return the transform from the PixieVerse to the SLAT frame, from the poses alone."""
        slat, pixieverse = self.slat, self.pixieverse
        rotation = slat.rotation @ pixieverse.rotation.T
        scale = slat.scale / pixieverse.scale
        offset = slat.scale * slat.rotation @ (pixieverse.centre - slat.centre) + slat.shift
        return make_transform(rotation, offset - scale * rotation @ pixieverse.shift, scale)

    def slat_to_object(self, points: Array) -> Array:
        """Map points (P, 3) of the SLAT frame to object coordinates."""
        mapped = self.slat.to_object(self.warp(points) if self.warp else points)
        return self.distortion(mapped) if self.distortion else mapped

    def places(self, points: Array) -> Array:
        """Map points (P, 3) of the SLAT frame to the PixieVerse frame."""
        return self.pixieverse.from_object(self.slat_to_object(points))

    def slat_distance(self, solid: Solid) -> Callable[[Array], Array]:
        """Return the distance bound of a solid in the SLAT frame."""
        factor = self.slat.scale / (self.warp.stretch if self.warp else 1.0)
        if self.distortion:
            factor /= self.distortion.stretch
        return lambda points: factor * solid.distance(self.slat_to_object(points))

    def pixieverse_distance(self, solid: Solid) -> Callable[[Array], Array]:
        """Return the distance bound of a solid in the PixieVerse frame."""
        pose = self.pixieverse
        return lambda points: pose.scale * solid.distance(pose.to_object(points))


def draw_frames(rng: Rng, solid: Solid, difficulty: Difficulty, quarter: Array) -> Frames:
    """Draw the poses of an asset such that both sides lie within their cubes.

    `quarter` (3, 3) is the quarter turn of the PixieVerse side; the SLAT side stands upright.
    """
    middle = solid.extent.mean(axis=0)
    warp = Waves.draw(rng, difficulty.warp, (0.7, 1.3)) if difficulty.warp else None
    room = _FULL - 2.0 * warp.reach if warp else _FULL
    slat_scale = room / float((solid.extent[1] - solid.extent[0]).max())
    full = _FULL - 2.0 * difficulty.room * VOXEL_SIZE

    centre, shift = middle, np.zeros(3)
    if difficulty.any_rotation:
        rotation = _any_rotation(rng)
        box = bounding_box(solid.shapes, rotation)
        centre = rotation.T @ box.mean(0)
        scale = full / float((box[1] - box[0]).max())
    else:
        rotation = _tilt(rng, difficulty.tilt) @ quarter if difficulty.tilt else quarter
        if difficulty.shift:
            shift = direction(rng) * rng.uniform(0.0, difficulty.shift) * VOXEL_SIZE
        box = bounding_box(solid.shapes, rotation) - rotation @ middle
        # This is the largest scale at which the shifted box lies within the cube.
        scale = float(np.min(np.stack([full / 2 + shift, full / 2 - shift]) / np.abs(box)))
        if not difficulty.own_boxes:
            mismatch = 1.0
            if difficulty.scale[1]:
                mismatch += rng.choice([-1.0, 1.0]) * rng.uniform(*difficulty.scale)
            slat_scale = min(slat_scale, scale * mismatch)
            scale = slat_scale / mismatch
    slat = Pose(np.eye(3), slat_scale, middle, np.zeros(3))
    return Frames(Pose(rotation, scale, centre, shift), slat, warp)


def generate(rng: Rng, frames: Frames, bend: float, solid: Solid, skin: Array) -> Frames:
    """Replace the SLAT side of an asset by a generated shape that fills the cube.

    `draw_distortion` defines `bend`. `frames` has no warp; its SLAT side keeps its rotation, and
    the rest of the pose is fitted to the shape. `skin` (K, 3) are points on the object's surface,
    at most a voxel apart.
    """
    distortion = draw_distortion(rng, solid.extent, bend)
    turned = distortion.inverse(skin) @ frames.slat.rotation.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    # The surface may extend a voxel farther between these points.
    size = (_FULL - 2.0 * VOXEL_SIZE) / float((high - low).max())
    middle = frames.slat.rotation.T @ ((low + high) / 2.0)
    pose = Pose(frames.slat.rotation, size, middle, np.zeros(3))
    return replace(frames, slat=pose, distortion=distortion)


def _tilt(rng: Rng, degrees: float) -> Array:
    """Return a rotation about any axis by up to `degrees` (Rodrigues' formula)."""
    x, y, z = direction(rng)
    angle = np.radians(rng.uniform(0.0, degrees))
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


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

"""Draw voxels as shaded cubes with numpy.

An orthographic view shows at most three sides of every cube, each as the same parallelogram. Its
pixels are computed once and copied to every exposed face, with a depth buffer: ten thousand voxels
take some hundredths of a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.geometry.frames import VOXEL_SIZE, apply_transform, voxel_centres
from slatprep.geometry.voxels import occupancy_of

SUPERSAMPLING = 3
"""Number of pixels drawn per pixel of the picture, along each edge."""

LIGHT = np.array([-0.35, 0.75, 0.56])
"""Direction to the light in the axes of the picture: upper left, behind the viewer."""

_DEPTH_STEPS = 1 << 20
_FACE_BITS = 24
_SEAM = 0.9
_OUTLINE = 0.5
_OUTLINE_STEP = 2.5 * VOXEL_SIZE


@dataclass(frozen=True)
class View:
    """An orthographic camera.

    Attributes
    ----------
    rotation : ndarray of float64, shape (3, 3)
        Rows are the directions right, up and towards the viewer.
    centre : ndarray of float64, shape (3,)
        Point in the middle of the picture.
    half_width : float
        Half the width of the picture, in edges of the cube.
    size : int
        Number of pixels along each side of the picture.
    """

    rotation: NDArray[np.float64]
    centre: NDArray[np.float64]
    half_width: float
    size: int

    def to_view(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return points (N, 3) in the axes right, up and towards the viewer."""
        return np.asarray((np.asarray(points) - self.centre) @ self.rotation.T)


@dataclass(frozen=True)
class Drawing:
    """A picture of one voxel set: ``rgb`` (n, n, 3) in 0..1 and ``cover`` (n, n) in 0..1.

    ``rgb`` is white where no voxel covers it.
    """

    rgb: NDArray[np.float64]
    cover: NDArray[np.float64]


def view_rotation(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Return the axes (3, 3) of a view with z upwards; rows are right, up and towards the viewer.

    `azimuth` is the angle [degree] about z from the x axis to the viewer, `elevation` the angle
    [degree] above the xy plane.

    >>> (view_rotation(270, 0).round() + 0.0).tolist()  # from in front: x right, z up
    [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    """
    a, e = np.radians([azimuth, elevation])
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def draw_voxels(
    voxels: NDArray[np.integer],
    colours: NDArray[np.float64],
    transform: ArrayLike,
    view: View,
    contrast: float = 1.0,
) -> Drawing:
    """Draw voxels (N, 3) in 0..63 as shaded cubes, with colours (N, 3) in 0..1.

    `transform` (4, 4) maps to the frame of the view. `contrast` in 0..1 darkens the sides that
    face away from the light; small values keep colours comparable with a scale.
    """
    side = view.size * SUPERSAMPLING
    pixels_per_unit = side / (2 * view.half_width)
    buffer = np.full(side * side, -1, dtype=np.int64)
    linear = view.rotation @ np.asarray(transform, dtype=np.float64)[:3, :3]
    edges = linear * VOXEL_SIZE
    centres = view.to_view(apply_transform(transform, voxel_centres(voxels)))
    empty = ~np.pad(occupancy_of(voxels), 1)
    voxels = np.asarray(voxels, dtype=np.intp)
    owners: list[NDArray[np.intp]] = []
    shades: list[NDArray[np.float64]] = []
    drawn = 0
    for axis in range(3):
        sign = 1 if edges[2, axis] > 0 else -1
        step = sign * np.eye(3, dtype=np.intp)[axis]
        exposed = np.flatnonzero(empty[tuple((voxels + 1 + step).T)])
        spanned = np.delete(edges, axis, axis=1)
        template = _side_pixels(spanned * pixels_per_unit)
        if template is None or len(exposed) == 0:
            continue
        offsets, depths, seams = template
        middle = centres[exposed] + sign * edges[:, axis] / 2
        column = np.rint(middle[:, 0] * pixels_per_unit + side / 2 - 0.5).astype(np.int64)
        row = np.rint(side / 2 - 0.5 - middle[:, 1] * pixels_per_unit).astype(np.int64)
        x = column[:, None] + offsets[:, 0]
        y = row[:, None] - offsets[:, 1]
        depth = (middle[:, 2, None] + depths / pixels_per_unit) / view.half_width
        quantised = np.clip((depth / 8 + 0.5) * _DEPTH_STEPS, 0, _DEPTH_STEPS - 1)
        face = drawn + np.arange(len(exposed), dtype=np.int64)
        key = (quantised.astype(np.int64) << _FACE_BITS) | (face[:, None] << 1) | seams
        inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
        # The largest key is the nearest face, whatever the order of the faces.
        np.maximum.at(buffer, (y * side + x)[inside], key[inside])
        normal = sign * linear[:, axis] / np.linalg.norm(linear[:, axis])
        owners.append(exposed)
        lambert = max(float(normal @ LIGHT / np.linalg.norm(LIGHT)), 0.0)
        shades.append(np.full(len(exposed), 1.0 - contrast * 0.34 * (1.0 - lambert)))
        drawn += len(exposed)
    if not drawn:
        return Drawing(np.ones((view.size, view.size, 3)), np.zeros((view.size, view.size)))
    lit = colours[np.concatenate(owners)] * np.concatenate(shades)[:, None]
    return _resolve(buffer.reshape(side, side), lit, view)


def _side_pixels(
    spanned: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]] | None:
    """Return the pixels of a cube's side relative to its centre, their depths, and its seams.

    `spanned` (3, 2) has the two edges of the side in pixels. Returns None for a side seen edge-on.
    """
    plane = spanned[:2]
    if abs(np.linalg.det(plane)) < 1e-3:
        return None
    reach = int(np.ceil(np.abs(plane).sum(axis=1).max() / 2)) + 1
    grid = np.arange(-reach, reach + 1)
    offsets = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    along = offsets @ np.linalg.inv(plane).T
    # Every edge gets half a pixel more, because centres are rounded to pixels.
    slack = 0.5 * np.abs(np.linalg.inv(plane)).sum(axis=1)
    inside = (np.abs(along) <= 0.5 + slack).all(axis=1)
    seam = (np.abs(along) > 0.5 - slack).any(axis=1)
    return offsets[inside], (along @ spanned[2])[inside], (~seam[inside]).astype(np.int64)


def _resolve(buffer: NDArray[np.int64], lit: NDArray[np.float64], view: View) -> Drawing:
    """Convert the buffer to colours at the picture's size, with darker seams and outlines."""
    covered = buffer >= 0
    face = (buffer & ((1 << _FACE_BITS) - 1)) >> 1
    tone = np.where(buffer & 1, 1.0, _SEAM)
    depth = np.where(covered, (buffer >> _FACE_BITS) / _DEPTH_STEPS * 8 * view.half_width, -np.inf)
    tone = np.where(covered & _steps_down(depth), _OUTLINE, tone)
    white = np.ones((1, 3))
    table = np.concatenate([np.clip(lit, 0, 1), white])
    rgb = table[np.where(covered, face, len(lit))] * np.where(covered, tone, 1.0)[..., None]
    return Drawing(_averaged(rgb), _averaged(covered.astype(np.float64)))


def _averaged(image: NDArray[np.float64]) -> NDArray[np.float64]:
    k = SUPERSAMPLING
    total = sum(image[y::k, x::k] for y in range(k) for x in range(k))
    return np.asarray(total) / k**2


def _steps_down(depth: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the pixels that have a much farther neighbour."""
    from scipy.ndimage import minimum_filter1d

    beside = (minimum_filter1d(depth, 3, axis, mode="constant", cval=-np.inf) for axis in (0, 1))
    return np.asarray(np.minimum(*beside) < depth - _OUTLINE_STEP)

"""Frames, voxels and transforms.

Both frames are the unit cube [-0.5, 0.5]^3 with voxel ``i`` centred at
``(i + 0.5) / 64 - 0.5`` on each axis. Transforms are 4x4 homogeneous matrices
that map points of the PixieVerse frame to points of the SLAT frame.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.records import RESOLUTION
from slatprep.records.json_types import MAX_SHEAR

Array = NDArray[np.float64]

VOXEL_SIZE = 1.0 / RESOLUTION
"""Edge of a voxel in the unit cube."""


def voxel_centres(voxels: ArrayLike, resolution: int = RESOLUTION) -> NDArray[np.float64]:
    """Return the centres of voxels in the unit cube.

    Parameters
    ----------
    voxels : array_like of int, shape (N, 3)
        Voxel indices in 0..resolution - 1.
    resolution : int
        Voxels along each axis of the cube.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Points in [-0.5, 0.5]^3 of the same frame.

    Raises
    ------
    ValueError
        If `voxels` is an occupancy.

    Examples
    --------
    >>> voxel_centres([[0, 32, 63]]).tolist()
    [[-0.4921875, 0.0078125, 0.4921875]]
    """
    indices = np.asarray(voxels)
    if indices.dtype == bool:
        raise ValueError(
            f"an occupancy {indices.shape} is given; expected the indices of voxels (N, 3)"
        )
    return (indices.astype(np.float64) + 0.5) / resolution - 0.5


def apply_transform(transform: ArrayLike, points: ArrayLike) -> NDArray[np.float64]:
    """Map points by a homogeneous transform.

    Parameters
    ----------
    transform : array_like, shape (4, 4)
        Homogeneous transform that multiplies columns; its last row is 0, 0, 0, 1.
    points : array_like, shape (N, 3)
        Points of the transform's source frame.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Points of its target frame.

    Raises
    ------
    ValueError
        If the transform has another shape or another last row.

    Examples
    --------
    >>> quarter_turn = [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    >>> apply_transform(quarter_turn, [[2, 3, 4]]).tolist()
    [[-2.0, 2.0, 4.0]]
    """
    matrix = _homogeneous(transform)
    mapped: NDArray[np.float64] = np.asarray(points, dtype=np.float64) @ matrix[:3, :3].T
    for axis in range(3):  # numpy takes five times as long along narrow rows.
        mapped[..., axis] += matrix[axis, 3]
    return mapped


def _homogeneous(transform: ArrayLike) -> NDArray[np.float64]:
    """Return a transform as a matrix (4, 4); raise ValueError if it does not multiply columns."""
    matrix = np.asarray(transform, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"a transform is a finite 4x4 matrix, got shape {matrix.shape}")
    if matrix[3].tolist() != [0, 0, 0, 1]:
        raise ValueError(
            f"the last row of a transform must be 0, 0, 0, 1, got {matrix[3].tolist()}; "
            "transpose a matrix that multiplies rows"
        )
    return matrix


def make_transform(
    rotation: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0), scale: float = 1.0
) -> NDArray[np.float64]:
    """Return ``x -> scale * rotation @ x + translation`` as a matrix (4, 4).

    The rotation is (3, 3), the translation (3,) in edges of the unit cube.
    """
    transform = np.eye(4)
    transform[:3, :3] = scale * np.asarray(rotation, dtype=np.float64)
    transform[:3, 3] = translation
    return transform


def split_transform(transform: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Split a similarity transform into rotation (3, 3), translation (3,) and scale.

    Raise ValueError if the matrix is not 4x4, not finite, mirrors, or is no similarity.
    """
    if not np.isfinite(transform).all():
        raise ValueError("a transform is a finite 4x4 matrix, got NaN or an infinity")
    matrix = _homogeneous(transform)
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if determinant <= 0:
        raise ValueError(f"a transform must not mirror or flatten, got determinant {determinant:g}")
    scale = determinant ** (1.0 / 3.0)
    rotation = matrix[:3, :3] / scale
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > MAX_SHEAR:
        raise ValueError(
            "a transform must be a rotation, a uniform scale and a shift, without shear"
        )
    return rotation, matrix[:3, 3].copy(), scale


def invert_transform(transform: ArrayLike) -> NDArray[np.float64]:
    """Return the inverse of a similarity transform (4, 4); raise as `split_transform` does."""
    rotation, translation, scale = split_transform(transform)
    linear = rotation.T / scale
    return make_transform(linear, -linear @ translation)


def places_of(points: ArrayLike, transform: ArrayLike) -> NDArray[np.float64]:
    """Return where points (N, 3) of the SLAT frame lie in the PixieVerse frame."""
    return apply_transform(invert_transform(transform), points)


def displacement(transform: ArrayLike, reference: ArrayLike, points: ArrayLike) -> float:
    """Return the mean distance [voxel] of SLAT points (N, 3), mapped back by two transforms (4, 4).

    Both are inverted, so the distance is measured in the PixieVerse frame, where the annotation
    lies.
    """
    here, there = places_of(points, transform), places_of(points, reference)
    return float(np.linalg.norm(here - there, axis=1).mean() * RESOLUTION)


def nearest_similarity(
    source: NDArray[np.floating[Any]], target: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the similarity (4, 4) that maps points (P, 3) onto others by least squares.

    At least three of the points must not lie on a line. S. Umeyama, "Least-squares estimation of
    transformation parameters between two point patterns", IEEE TPAMI 13(4), 1991.
    """
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, values, v = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    linear = (u * signs) @ v * (float(values @ signs) / float((a * a).sum()))
    return make_transform(linear, target.mean(axis=0) - linear @ source.mean(axis=0))


def even_directions(count: int) -> NDArray[np.float64]:
    """Return unit vectors (count, 3) spread evenly over the sphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def cube_symmetries() -> NDArray[np.int64]:
    """Return the symmetries of a cube, signed permutation matrices (48, 3, 3), identity first."""
    matrices = np.zeros((48, 3, 3), np.int64)
    orders, flips = itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)
    for matrix, (order, signs) in zip(matrices, itertools.product(orders, flips), strict=True):
        matrix[range(3), order] = signs
    return matrices

"""A voxel set as the signed distance to its surface.

The two sides show one object differently: PixieVerse as a filled solid, TRELLIS
as the voxels that the surface passes through. Filling the SLAT makes them
comparable: neither a missing inside nor half a voxel of thickness biases the
alignment.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.voxels import above, bounding_box, filled, occupancy_of
from slatprep.records import RESOLUTION, Ground, MaterialField, StructuredLatents

CENTRE = (RESOLUTION - 1) / 2
"""Index of the cube's centre; positions below are in voxels relative to it."""

DILATION = 0.5
"""Distance, in voxels, of the outer faces of a voxelised surface from the surface.

A voxel belongs to the set if the surface passes through it anywhere. So the set is thicker than the
object: by half a voxel on average on a face along the grid, and by somewhat more on slanted ones.
This matters if the two sides have different scales, as half a voxel is then not the same length on
both.
"""

BAND = 1.0
"""Largest distance, in voxels, of the surface's samples (lattice points) from the outer faces."""

_MARGIN = 4


class Samples(NamedTuple):
    """A surface in the form that kernels take: samples, and the field that the other side reads."""

    columns: NDArray[np.float64]  # (3, M), voxels from the cube's centre
    values: NDArray[np.float64]  # (M,), signed distance [voxel]
    distance: NDArray[np.float32]  # (a, b, c), signed distance [voxel]
    origin: NDArray[np.float64]  # (3,), where distance[0, 0, 0] lies


@dataclass(frozen=True)
class Surface:
    """Signed distance to the surface of a voxel set, and samples of it near the surface.

    Attributes
    ----------
    distance : ndarray of float32, shape (a, b, c)
        Signed distance in voxels, negative inside, on a box around the set.
    origin : ndarray of float64, shape (3,)
        Position of ``distance[0, 0, 0]``, in voxels from the cube's centre.
    points : ndarray of float64, shape (M, 3)
        Lattice points near the surface, in voxels from the cube's centre.
    values : ndarray of float64, shape (M,)
        The signed distance at `points`.
    boundary : ndarray of uint8, shape (B, 3)
        The boundary voxels of the filled set.
    """

    distance: NDArray[np.float32]
    origin: NDArray[np.float64]
    points: NDArray[np.float64]
    values: NDArray[np.float64]
    boundary: NDArray[np.uint8]
    _subsets: dict[tuple[int, int], Surface] = field(init=False, default_factory=dict)

    @cached_property
    def samples(self) -> Samples:
        """The surface in the form that kernels take."""
        columns = np.ascontiguousarray(self.points.T)
        return Samples(columns, self.values, self.distance, self.origin)

    @cached_property
    def centroid(self) -> NDArray[np.float64]:
        """Mean of the surface's samples, in voxels from the cube's centre."""
        return np.asarray(self.points.mean(axis=0))

    @cached_property
    def size(self) -> float:
        """Root mean square distance of the surface's samples from their centroid, in voxels."""
        return float(np.sqrt(((self.points - self.centroid) ** 2).sum(axis=1).mean()))

    def mirrored(self) -> Surface:
        """Return the surface of the set that is mirrored in its first axis."""
        flip = np.array([-1.0, 1.0, 1.0])
        origin = self.origin * flip
        origin[0] -= self.distance.shape[0] - 1
        boundary = self.boundary.copy()
        boundary[:, 0] = RESOLUTION - 1 - boundary[:, 0]
        distance = np.ascontiguousarray(self.distance[::-1])
        points = self.points * flip
        return replace(self, distance=distance, origin=origin, points=points, boundary=boundary)

    def subset(self, count: int, first: int = 0) -> Surface:
        """Return the same surface with at most `count` evenly chosen samples.

        Samples from number `first` on differ from the first ones, unless there are too few.
        Subsets are cached, as many fits use the same.
        """
        if (count, first) not in self._subsets:
            chosen = np.arange(len(self.points))
            if len(chosen) > count:
                chosen = even_choice(len(chosen), count, first)
                # The indices are sorted, so comparing neighbours finds repeats.
                chosen = chosen[np.append(True, chosen[1:] > chosen[:-1])]
            some = replace(self, points=self.points[chosen], values=self.values[chosen])
            self._subsets[count, first] = some
        return self._subsets[count, first]


def even_choice(total: int, count: int, first: int = 0) -> NDArray[np.intp]:
    """Return `count` sorted, evenly spread indices below `total`; some repeat if it is small.

    Indices from number `first` on differ from the first ones.
    """
    return (_fractions(count, first) * total).astype(np.intp)


@lru_cache(maxsize=16)
def _fractions(count: int, first: int) -> NDArray[np.float64]:
    """Return `count` sorted, evenly spread fractions of 1, for `even_choice`."""
    # Multiples of the golden ratio fill an interval evenly, without regular steps,
    # which would alias with the lattice.
    return np.sort((np.arange(first, first + count) * 0.618033988749895) % 1.0)


def surface_of(occupancy: NDArray[np.bool_]) -> Surface:
    """Fill a voxel set (64, 64, 64), a solid or a shell, and measure the distance to its surface.

    The distance is Euclidean and exact: to the nearest voxel centre of the other kind, less half a
    voxel for the face between the two. `DILATION` is added to it.
    """
    from slatprep.geometry.distance import near_surface, signed_distance

    full = filled(occupancy)
    box = bounding_box(full)
    solid = np.pad(full[box], _MARGIN)
    distance = signed_distance(solid)
    near, values = near_surface(distance, BAND)
    # A voxel is half a voxel deep exactly if it touches an empty one by a face.
    boundary = near.take(np.flatnonzero(values == -0.5), axis=0)
    corner = np.array([side.start - _MARGIN for side in box])
    boundary += corner.astype(np.uint8)
    distance += np.float32(DILATION)
    origin = corner - CENTRE
    return Surface(
        distance=distance,
        origin=origin,
        points=near + origin,
        values=values.astype(np.float64) + DILATION,
        boundary=boundary,
    )


def surfaces_of(
    field: MaterialField, latents: StructuredLatents, ground: Ground | None = None
) -> tuple[Surface, Surface]:
    """Return the surfaces of the SLAT and of the field; ground in the field is left out."""
    slat = surface_of(occupancy_of(latents.coords, latents.resolution))
    return slat, surface_of(above(field.occupancy, ground))


def normals_of(surface: Samples) -> NDArray[np.float64]:
    """Return unit normals (M, 3) at a surface's samples, by differences of the distance."""
    distance = surface.distance
    flat = distance.reshape(-1)
    strides = np.array(distance.strides) // distance.itemsize
    # Samples are lattice points, and the box has a margin around all of them.
    at = np.rint(surface.columns.T - surface.origin).astype(np.intp) @ strides
    normals = np.stack([flat[at + step] - flat[at - step] for step in strides], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.maximum(length, 1e-6))

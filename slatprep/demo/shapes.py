"""Define primitive solids as signed distance bounds, and their materials.

Every shape gives a number at any point: negative inside, positive outside, and never larger in
magnitude than the distance to its surface. The voxelisation relies on this bound. A shape also
has a support function, which gives exact bounding boxes in any orientation.

The distance functions follow Inigo Quilez, "Distance functions"
(https://iquilezles.org/articles/distfunctions/).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Points = NDArray[np.float64]
Region = Callable[[Points], Points]


@dataclass(frozen=True)
class Shape:
    """A solid: a signed distance bound and a support function.

    ``distance`` maps points (P, 3) to (P,); ``support`` maps a unit direction
    (3,) to the largest projection of the solid on it.
    """

    distance: Region
    support: Callable[[Points], float]


def bounding_box(shapes: Sequence[Shape], rotation: Points) -> NDArray[np.float64]:
    """Return the bounding box (2, 3) of the union of shapes after a rotation (3, 3)."""
    upper = [max(shape.support(axis) for shape in shapes) for axis in rotation]
    lower = [-max(shape.support(-axis) for shape in shapes) for axis in rotation]
    return np.array([lower, upper])


def _vector(value: ArrayLike) -> Points:
    return np.asarray(value, dtype=np.float64)


def _lengths(vectors: Points) -> Points:
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


def sphere(centre: ArrayLike, radius: float) -> Shape:
    """Return a ball."""
    c = _vector(centre)
    return Shape(lambda p: _lengths(p - c) - radius, lambda d: float(c @ d) + radius)


def ellipsoid(centre: ArrayLike, radii: ArrayLike, rotation: ArrayLike | None = None) -> Shape:
    """Return an ellipsoid; the columns of `rotation` are its axes."""
    c, r = _vector(centre), _vector(radii)
    axes = np.eye(3) if rotation is None else _vector(rotation)
    return Shape(
        lambda p: (_lengths((p - c) @ (axes / r)) - 1.0) * r.min(),
        lambda d: float(c @ d + np.linalg.norm(r * (d @ axes))),
    )


def dome(centre: ArrayLike, radii: ArrayLike) -> Shape:
    """Return the upper half of an axis-parallel ellipsoid, standing on z = centre z."""
    c, r = _vector(centre), _vector(radii)
    whole = ellipsoid(c, r)

    def support(d: Points) -> float:
        return whole.support(d) if d[2] >= 0 else float(c @ d + np.hypot(*(r * d)[:2]))

    return Shape(lambda p: np.maximum(whole.distance(p), c[2] - p[:, 2]), support)


def capsule(start: ArrayLike, end: ArrayLike, radius: float) -> Shape:
    """Return the solid of all points within `radius` of a segment."""
    a, b = _vector(start), _vector(end)
    axis = b - a

    def distance(p: Points) -> Points:
        along = np.clip((p - a) @ axis / (axis @ axis), 0.0, 1.0)
        return _lengths(p - a - along[:, None] * axis) - radius

    return Shape(distance, lambda d: float(max(a @ d, b @ d)) + radius)


def cone(start: ArrayLike, end: ArrayLike, radius: float, end_radius: float) -> Shape:
    """Return a frustum with flat ends: `radius` at `start`, `end_radius` at `end`."""
    a, b = _vector(start), _vector(end)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length
    slope = (end_radius - radius) / length

    def distance(p: Points) -> Points:
        along = (p - a) @ axis
        around = _lengths(p - a - along[:, None] * axis)
        side = (around - radius - slope * along) / np.hypot(1.0, slope)
        return np.asarray(np.maximum(side, np.maximum(-along, along - length)))

    def support(d: Points) -> float:
        across = float(np.sin(np.arccos(np.clip(axis @ d, -1.0, 1.0))))
        return float(max(a @ d + radius * across, b @ d + end_radius * across))

    return Shape(distance, support)


def cylinder(start: ArrayLike, end: ArrayLike, radius: float) -> Shape:
    """Return a cylinder with flat ends."""
    return cone(start, end, radius, radius)


def box(
    centre: ArrayLike, half: ArrayLike, rotation: ArrayLike | None = None, rounding: float = 0.0
) -> Shape:
    """Return a box with half edges `half`, which include the rounding of its edges."""
    c, h = _vector(centre), _vector(half) - rounding
    axes = np.eye(3) if rotation is None else _vector(rotation)

    def distance(p: Points) -> Points:
        beyond = np.abs((p - c) @ axes) - h
        outside = _lengths(np.maximum(beyond, 0.0))
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0) - rounding)

    return Shape(distance, lambda d: float(c @ d + h @ np.abs(d @ axes)) + rounding)


def torus(centre: ArrayLike, axis: ArrayLike, radius: float, thickness: float) -> Shape:
    """Return a ring of tube radius `thickness` around `axis`."""
    c = _vector(centre)
    n = _vector(axis) / np.linalg.norm(_vector(axis))

    def distance(p: Points) -> Points:
        along = (p - c) @ n
        around = _lengths(p - c - along[:, None] * n)
        return np.asarray(np.hypot(around - radius, along) - thickness)

    def support(d: Points) -> float:
        across = float(np.sin(np.arccos(np.clip(n @ d, -1.0, 1.0))))
        return float(c @ d) + radius * across + thickness

    return Shape(distance, support)


def polytope(normals: ArrayLike, offsets: ArrayLike) -> Shape:
    """Return the intersection of half-spaces ``normal @ p <= offset``; it must be bounded.

    `normals` (F, 3) are outward unit vectors; `offsets` (F,) are the planes' distances from the
    origin.
    """
    n, o = _vector(normals), _vector(offsets)
    corners = []
    for triple in combinations(range(len(n)), 3):
        planes = n[list(triple)]
        if abs(np.linalg.det(planes)) > 1e-6:
            corner = np.linalg.solve(planes, o[list(triple)])
            if np.all(n @ corner <= o + 1e-9):
                corners.append(corner)
    vertices = np.array(corners)
    # The largest distance to a plane is at most the distance to the solid.
    return Shape(lambda p: (p @ n.T - o).max(axis=1), lambda d: float((vertices @ d).max()))


def carve(solid: Shape, tool: Shape) -> Shape:
    """Return `solid` minus `tool`; the tool must not change the solid's bounding box."""
    return Shape(lambda p: np.maximum(solid.distance(p), -tool.distance(p)), solid.support)


def half_space(point: ArrayLike, normal: ArrayLike) -> Region:
    """Return a region that is negative on the side of a plane to which `normal` points."""
    q, n = _vector(point), _vector(normal)
    return lambda p: -((p - q) @ n)


class Stuff(NamedTuple):
    """The material of a part: class 0..6, and properties in Pa, kg/m^3 and 1."""

    material: int
    youngs_modulus: float
    density: float
    poissons_ratio: float


@dataclass(frozen=True)
class Part:
    """A shape of one stuff; a coat replaces the stuff at points where its region is negative."""

    shape: Shape
    stuff: Stuff
    coats: tuple[tuple[Region, Stuff], ...] = ()


class Solid:
    """The union of at least one part, with the distance and the stuff at any point.

    A point belongs to the part with the smallest distance at the point. Distances are computed up
    to the share `reach` of the largest edge of the solid's box.
    """

    def __init__(self, parts: Sequence[Part], reach: float = 0.08) -> None:
        self.parts = tuple(parts)
        self.shapes = tuple(part.shape for part in self.parts)
        self.extent = bounding_box(self.shapes, np.eye(3))
        # A part is evaluated only near its own box. Elsewhere its distance is at least `reach`,
        # and the voxelisation needs no larger distances.
        self.reach = reach * float((self.extent[1] - self.extent[0]).max())
        self._boxes = [bounding_box([shape], np.eye(3)) for shape in self.shapes]
        self.stuffs: list[Stuff] = []
        self._first_stuff: list[int] = []
        for part in self.parts:
            self._first_stuff.append(len(self.stuffs))
            self.stuffs += [part.stuff, *(stuff for _, stuff in part.coats)]

    def evaluate(self, points: Points) -> tuple[Points, NDArray[np.intp]]:
        """Return the signed distance bound (P,), at most `reach`, and the part (P,) or -1."""
        best = np.full(len(points), self.reach)
        owner = np.full(len(points), -1, dtype=np.intp)
        x, y, z = np.ascontiguousarray(points.T)
        for k, (shape, (lo, hi)) in enumerate(zip(self.shapes, self._boxes, strict=True)):
            lo, hi = lo - self.reach, hi + self.reach
            near = np.flatnonzero((x > lo[0]) & (x < hi[0]))
            near = near[(y[near] > lo[1]) & (y[near] < hi[1])]
            near = near[(z[near] > lo[2]) & (z[near] < hi[2])]
            if near.size:
                distance = shape.distance(points[near])
                closer = distance < best[near]
                best[near[closer]] = distance[closer]
                owner[near[closer]] = k
        return best, owner

    def distance(self, points: Points) -> Points:
        """Return the signed distance bound (P,) alone."""
        return self.evaluate(points)[0]

    def stuff_at(self, points: Points) -> NDArray[np.intp]:
        """Return the index (P,) into `stuffs` at points inside the solid or near its surface."""
        owner = self.evaluate(points)[1]
        if np.any(owner < 0):
            raise ValueError("a point too far from the solid has no part")
        stuff = np.array(self._first_stuff)[owner]
        for k, part in enumerate(self.parts):
            for coat, (region, _) in enumerate(part.coats, self._first_stuff[k] + 1):
                mine = np.flatnonzero(owner == k)
                stuff[mine[region(points[mine]) < 0]] = coat
        return stuff

    def table(self) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return class (S,) uint8 and Young's modulus, density, Poisson's ratio (S, 3) float32."""
        rows = np.array(self.stuffs)
        return rows[:, 0].astype(np.uint8), rows[:, 1:].astype(np.float32)

"""Ground under an object: a flat layer at one end of an annotation that a SLAT never has.

A NeRF's field may hold the object on a piece of the floor, as wide as the grid. Then the
sizes and the centroids of the two sides say nothing of each other, and the surface of the
floor outweighs that of the object.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slatprep.align.surface import DILATION, Surface, even_choice
from slatprep.geometry.deformation import GRAIN
from slatprep.geometry.frames import VOXEL_SIZE, even_directions
from slatprep.records import Alignment, Ground

Array = NDArray[np.float64]

DIRECTIONS, SAMPLES, VOXELS = 250, 500, 10_000
"""Directions in which a layer is looked for, samples of the surface that are looked at there, and
voxels of the solid from which its top is taken."""

ENDS, END = 3, 6.0
"""So many ends of the annotation are looked at: those with most samples within so many voxels."""

SAME = 0.999
"""Layers whose normals have such a cosine, and whose tops lie within half a voxel, are one."""

BLOBS = 0.02
"""Share of the samples that may lie below the ground."""

NARROWINGS = 6
"""How often the plane of a layer is fitted to the samples near the one before."""

HALF_LAYER = 3.5
"""Samples so near the middle of a layer, in voxels, belong to it."""

LEAST_FACE = 0.04
"""A layer is looked at whose face is this share of the annotation's surface, both sides counted."""

LEAST_ABOVE = 0.05
"""This share of the voxels lies above ground at least: less is a board's lid, and not an object."""

RAISED = (0.0, 1.0, 2.0)
"""Voxels above a layer's top at which it is cut off: an object stands in its ground, and that is
rough."""

LEAST_GAIN = 0.05
"""A layer is ground if without it the score rises by so much."""


def find_layers(surface: Surface) -> list[Ground]:
    """Find flat layers at the ends of the PixieVerse side, widest first; any may be the object's.

    The ends with most samples of the surface are looked at. There a plane is fitted to the samples
    near it, again and again. The layer's top is where most voxels go away from one height to the
    next, and the face is as large as these are many. Faces are at least `LEAST_FACE` large.
    """
    points = surface.subset(SAMPLES).points
    solid = np.flatnonzero(surface.distance < DILATION)
    total = len(solid)
    if total > VOXELS:
        solid = solid[even_choice(total, VOXELS)]
    inside = np.stack(np.unravel_index(solid, surface.distance.shape), axis=1) + surface.origin
    least = 0.5 * LEAST_FACE * len(surface.points) * len(solid) / total
    found = [_layer(points, inside, end) for end in _ends(points)]
    kept: list[tuple[Array, float, float]] = []
    for normal, top, wide in sorted(found, key=lambda layer: -layer[2]):
        if wide > least and all(normal @ n < SAME or abs(top - t) > 0.5 for n, t, _ in kept):
            kept.append((normal, top, wide))
    return [_rounded(normal, top * VOXEL_SIZE) for normal, top, _ in kept]


def raised(layer: Ground, voxels: float) -> Ground:
    """Return a layer with its top so many voxels higher."""
    return _rounded(layer.normal, layer.height + voxels * VOXEL_SIZE)


def gain(without: Alignment, found: Alignment) -> float:
    """Return by how much the score of unused samples rises without a layer.

    What may bend fits nearly anything to a slab. So two fits are compared before any deformation;
    and as they are, if that says more, where both may bend alike.
    """
    here, there = without.figures, found.figures
    if here is None or there is None:
        return -np.inf
    rise = here.score_similarity - there.score_similarity
    if without.model is not found.model:
        return rise
    slat, pixie = here.score_slat - there.score_slat, here.score_pixieverse - there.score_pixieverse
    return max(rise, 0.5 * (slat + pixie))


def _rounded(normal: Array, height: float) -> Ground:
    rounded = np.rint(np.append(normal, height) / GRAIN) * GRAIN
    return Ground(rounded[:3], float(rounded[3]))


def _ends(points: Array) -> list[Array]:
    """Return the directions from the ends with most points to the middle, no two alike."""
    directions = even_directions(DIRECTIONS)
    heights = directions @ points.T
    rank = int(BLOBS * len(points))
    lowest = np.partition(heights, rank, axis=1)[:, rank]
    within = (heights < lowest[:, None] + END).sum(axis=1)
    ends: list[Array] = []
    for k in np.argsort(-within, kind="stable"):
        if all(directions[k] @ end < 0.9 for end in ends):
            ends.append(directions[k])
        if len(ends) == ENDS:
            break
    return ends


def _layer(points: Array, inside: Array, normal: Array) -> tuple[Array, float, float]:
    """Return the normal of the layer at an end, its top, and how many voxels go away there."""
    heights = points @ normal
    middle = float(np.quantile(heights, BLOBS)) + 0.5 * (END - 2.0)
    reach = 0.5 * (END + 2.0)
    for _ in range(NARROWINGS):
        layer = points[np.abs(heights - middle) < reach]
        if len(layer) < 4:
            break
        axis = np.linalg.eigh(np.cov(layer.T))[1][:, 0]
        normal = axis if axis @ normal > 0 else -axis
        heights = points @ normal
        middle, reach = float(np.median(layer @ normal)), HALF_LAYER
    # Voxels of a height, every half a voxel, and how much fewer there are one above than below.
    edges = middle + np.arange(-8.0, 9.0, 0.5)
    inside_heights = inside @ normal
    halves = np.histogram(inside_heights, edges)[0].astype(np.float64)
    slices = halves[:-1] + halves[1:]
    fewer = 0.5 * (slices[:-4] + slices[1:-3] - slices[3:-1] - slices[4:])
    tops = edges[3 : 3 + len(fewer)]
    above = len(inside) - np.searchsorted(np.sort(inside_heights), tops + 1.0, side="right")
    fewer[above < LEAST_ABOVE * len(inside)] = 0.0
    at = int(np.argmax(fewer))
    return normal, float(tops[at]), float(fewer[at])

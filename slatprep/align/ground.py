"""Find ground under an object: a flat layer at one end of an annotation that no SLAT has.

A NeRF's field may hold the object on a piece of the floor, as wide as the grid. Then sizes and
centroids of the two sides do not match, and the floor has more surface than the object.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slatprep.align.surface import DILATION, Surface, even_choice
from slatprep.geometry.deformation import GRAIN
from slatprep.geometry.frames import VOXEL_SIZE, Array, even_directions
from slatprep.records import Alignment, Ground

DIRECTIONS, SAMPLES, VOXELS = 250, 500, 10_000
"""Number of directions in which a layer is searched, of surface samples used for that, and of
voxels of the solid that determine the layer's top."""

ENDS, END = 3, 6.0
"""Number of the annotation's ends that are searched, and their depth in voxels. The ends with most
samples are taken."""

SAME = 0.999
"""Smallest cosine of the normals of layers that count as one, with tops within half a voxel."""

BLOBS = 0.02
"""Share of the samples that may lie below the ground."""

NARROWINGS = 6
"""Number of times that a layer's plane is fitted to the samples near the last plane."""

HALF_LAYER = 3.5
"""Largest distance, in voxels, of a layer's samples from its middle."""

LEAST_FACE = 0.04
"""Smallest face of a layer, both sides counted, as a share of the annotation's surface."""

LEAST_ABOVE = 0.05
"""Smallest share of the voxels above ground; less is the lid of a board, not an object."""

RAISED, BETWEEN = (0.0, 1.0), (0.5, 1.5, 2.0)
"""Heights of the cut above a layer's top, in voxels: ground is rough, and objects stand in it. At
the latter ones the placements that the former ones found are refined."""

TRIED = 2
"""Number of cuts without which placements are finished: those with the largest sum of the score
after the search and the weighted width."""

GROUND_GAIN, LIKELY_GAIN = 0.05, -0.01
"""Rise of the score without a layer above which the layer is ground. The second one holds for a
layer of width `WIDE` without which another placement fits best: that of a plate, say, no longer in
its ground but on it."""

WIDTH, WIDE = 0.3, 1.2
"""Weight of a layer's width, over that of what stands on it, beside the rise of the score, and the
largest such ratio: wider ones count as this. Ground is seldom the narrower one."""

SEARCHED = 0.01
"""How much more the score may rise once a placement is finished than it did after the search.
A rise by deformation alone may be larger, and is not foreseen."""


def find_layers(surface: Surface) -> list[Ground]:
    """Find flat layers at the ends of the PixieVerse side, widest first.

    A layer may also belong to the object. Only the ends with most surface samples are searched. At
    each end a plane is fitted repeatedly to the samples near it. The layer's top is the height at
    which the number of voxels drops most. The drop measures the face, which must be at least
    `LEAST_FACE`.
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
    """Return a layer with its top higher by `voxels`."""
    return _rounded(layer.normal, layer.height + voxels * VOXEL_SIZE)


def gain(without: Alignment, found: Alignment) -> float:
    """Return the rise of the score on unused samples without a layer.

    With a deformation nearly anything fits a slab, so the scores before deformation are compared.
    If both models are the same, the rise after deformation counts instead if it is larger.
    """
    here, there = without.figures, found.figures
    if here is None or there is None:
        return -np.inf
    rise = here.score_similarity - there.score_similarity
    if without.model is not found.model:
        return rise
    slat, pixie = here.score_slat - there.score_slat, here.score_pixieverse - there.score_pixieverse
    return max(rise, 0.5 * (slat + pixie))


def relative_width(layer: Ground, occupancy: NDArray[np.bool_], solid: NDArray[np.bool_]) -> float:
    """Return a layer's width over that of what stands on it, `WIDE` at most.

    The layer is what `occupancy` has and `solid` lacks.
    """
    left_out, standing = (_width(voxels, layer.normal) for voxels in (occupancy & ~solid, solid))
    return min(left_out / max(standing, 1.0), WIDE)


def _width(voxels: NDArray[np.bool_], normal: Array) -> float:
    """Return the radius of 95 % of a set's voxels around their mean, seen along the normal."""
    places = np.argwhere(voxels).astype(np.float64)
    if not len(places):
        return 0.0
    places -= places.mean(axis=0)
    places -= np.outer(places @ normal, normal)
    return float(np.quantile(np.linalg.norm(places, axis=1), 0.95))


def _rounded(normal: Array, height: float) -> Ground:
    rounded = np.rint(np.append(normal, height) / GRAIN) * GRAIN
    return Ground(rounded[:3], float(rounded[3]))


def _ends(points: Array) -> list[Array]:
    """Return the inward directions at the ends with most points, no two of them similar."""
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
    """Return a layer's normal, its top, and by how many voxels the count drops there."""
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
    # Voxels in slices of height, in steps of half a voxel, and their drop from below to above.
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

"""Generalised ICP of the package small_gicp, from the paper's start orientations.

Plane-to-plane distances do not lock to the lattice as point-to-point ones do.
The starts run on thinned clouds, the best one again on all voxels. This engine
stands between the paper's protocol and the default engine in the
benchmark (A. Segal, D. Haehnel, S. Thrun, "Generalized-ICP", RSS 2009;
K. Koide, "small_gicp", JOSS 2024).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.align.quality import compare, measure_quality
from slatprep.align.starts import candidates_of, distinct_starts
from slatprep.geometry.frames import VOXEL_SIZE, make_transform, voxel_centres
from slatprep.geometry.voxels import boundary, voxels_of
from slatprep.parameters import AlignParameters
from slatprep.records import (
    RESOLUTION,
    Alignment,
    Engine,
    MaterialField,
    Model,
    Search,
    StructuredLatents,
)

THINNED = 2.0
"""Voxels; the starts run on clouds thinned to one point in a cube of this edge."""


def align(
    field: MaterialField, latents: StructuredLatents, parameters: AlignParameters
) -> Alignment:
    """Align by GICP; see `slatprep.align.align`."""
    import small_gicp

    surface = voxels_of(boundary(field.occupancy))
    points, goal = (voxel_centres(v) * RESOLUTION for v in (surface, latents.coords))
    source, target = _cloud(points, 0.25), _cloud(goal, 0.25)
    thin_source, thin_target = _cloud(points, THINNED), _cloud(goal, THINNED)

    def gicp(target: Any, source: Any, start: NDArray[np.float64]) -> NDArray[np.float64]:
        cloud, tree = target
        result = small_gicp.align(
            cloud,
            source[0],
            tree,
            init_T_target_source=start,
            registration_type="GICP",
            max_correspondence_distance=parameters.icp_radius,
            num_threads=1,
        )
        return np.array(result.T_target_source)

    fits = {}
    for start in distinct_starts():
        pose = gicp(thin_target, thin_source, make_transform(start.rotation))
        quality = compare(surface, latents.coords, _in_unit_cube(pose), parameters.radius)
        fits[start.index] = (quality.fitness, quality.inlier_rmse, pose)
    best = max(fits, key=lambda index: (fits[index][0], -fits[index][1], -index))
    transform = _in_unit_cube(gicp(target, source, fits[best][2]))
    return Alignment(
        transform=transform,
        engine=Engine.SMALL_GICP,
        model=Model.RIGID,
        search=Search.EULER64,
        quality=measure_quality(field, latents, transform, parameters.radius),
        candidates=candidates_of({index: fit[:2] for index, fit in fits.items()}),
    )


def _cloud(points: NDArray[np.float64], thinned: float) -> Any:
    import small_gicp

    return small_gicp.preprocess_points(points, downsampling_resolution=thinned, num_threads=1)


def _in_unit_cube(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    transform = pose.copy()
    transform[:3, 3] *= VOXEL_SIZE
    return transform

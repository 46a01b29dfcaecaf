"""Align by generalised ICP (package small_gicp) from the paper's start orientations.

Unlike point-to-point distances, plane-to-plane distances do not lock to the
lattice. The starts run on thinned clouds, and the best one again on all voxels.
In the benchmark this engine stands between the paper's protocol and the default
engine (A. Segal, D. Haehnel, S. Thrun, "Generalized-ICP", RSS 2009;
K. Koide, "small_gicp", JOSS 2024).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slatprep.align.quality import compare
from slatprep.align.starts import Transform, search_starts
from slatprep.geometry.frames import VOXEL_SIZE, voxel_centres
from slatprep.geometry.voxels import boundary, shown_in_cells, voxels_of
from slatprep.parameters import AlignParameters
from slatprep.records import RESOLUTION, Alignment, MaterialField, StructuredLatents

THINNED = 2.0
"""Edge, in voxels, of the cubes in which the clouds of the starts have one point each."""


def align(
    field: MaterialField, latents: StructuredLatents, parameters: AlignParameters
) -> Alignment:
    """Align by GICP; see `slatprep.align.align`."""
    import small_gicp

    surface = voxels_of(boundary(field.occupancy))
    cells, _ = shown_in_cells(latents.coords, latents.resolution)

    def clouds(edge: float) -> list[tuple[Any, Any]]:
        return [
            small_gicp.preprocess_points(
                voxel_centres(voxels) * RESOLUTION, downsampling_resolution=edge, num_threads=1
            )
            for voxels in (surface, cells)
        ]

    thin, all_voxels = clouds(THINNED), clouds(0.25)

    def gicp(clouds: list[tuple[Any, Any]], start: Transform) -> Transform:
        (source, _), (target, tree) = clouds
        result = small_gicp.align(
            target,
            source,
            tree,
            init_T_target_source=start,
            registration_type="GICP",
            max_correspondence_distance=parameters.icp_radius,
            num_threads=1,
        )
        return np.array(result.T_target_source)

    def first(start: Transform) -> tuple[float, float, Transform]:
        pose = gicp(thin, start)
        quality = compare(surface, cells, _in_unit_cube(pose), parameters.radius)
        return quality.fitness, quality.inlier_rmse, pose

    def last(start: Transform) -> Transform:
        return _in_unit_cube(gicp(all_voxels, start))

    return search_starts(field, latents, parameters, first, last)


def _in_unit_cube(pose: Transform) -> Transform:
    transform = pose.copy()
    transform[:3, 3] *= VOXEL_SIZE
    return transform

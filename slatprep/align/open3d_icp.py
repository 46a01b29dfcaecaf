"""The paper's protocol: point-to-point ICP on Open3D from 64 start orientations.

SLAT-Phys, "Physics-to-SLAT Annotation Alignment": the boundary voxels of the PixieVerse occupancy
are the source, the SLAT voxels the target. The start whose ICP reaches the highest fitness wins,
and a final ICP gives T in SE(3). At the radius with which ICP converges, many starts reach a
fitness of 1. So candidates are compared at a tight radius, and the rmse breaks ties.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.align.starts import Start, Transform, search_starts
from slatprep.errors import SlatprepError
from slatprep.geometry.frames import VOXEL_SIZE, voxel_centres
from slatprep.geometry.voxels import boundary, shown_in_cells, voxels_of
from slatprep.parameters import AlignParameters
from slatprep.records import Alignment, MaterialField, StructuredLatents
from slatprep.workers.local import single_threaded


def align(
    field: MaterialField,
    latents: StructuredLatents,
    parameters: AlignParameters,
    starts: Sequence[Start] | None = None,
) -> Alignment:
    """Align by the paper's protocol; see `slatprep.align.align`.

    `starts` is for the benchmark, which times all 64 as published. By default the
    40 that repeat another rotation are not computed twice.
    """
    o3d = load_open3d()
    registration = o3d.pipelines.registration
    method = registration.TransformationEstimationPointToPoint()
    criteria = registration.ICPConvergenceCriteria(max_iteration=parameters.icp_iterations)
    source = _cloud(o3d, voxel_centres(voxels_of(boundary(field.occupancy))))
    target = _cloud(o3d, voxel_centres(shown_in_cells(latents.coords, latents.resolution)[0]))
    wide = parameters.icp_radius * VOXEL_SIZE
    tight = parameters.radius * VOXEL_SIZE

    def icp(start: Transform) -> Transform:
        fit = registration.registration_icp(source, target, wide, start, method, criteria)
        return np.array(fit.transformation)

    def scored(start: Transform) -> tuple[float, float, Transform]:
        transform = icp(start)
        score = registration.evaluate_registration(source, target, tight, transform)
        return score.fitness, score.inlier_rmse / VOXEL_SIZE, transform

    # Open3D sums over threads in the order in which they finish. With one thread
    # the same input gives the same bits.
    with single_threaded():
        return search_starts(field, latents, parameters, scored, icp, starts)


def load_open3d() -> Any:
    """Import Open3D from wheels alone; raise SlatprepError if it cannot be loaded.

    Since 0.20 Open3D needs the system's libusb, though nothing here uses it. The copy in the wheel
    libusb_package, loaded first, satisfies the dynamic linker.
    """
    if sys.platform == "linux" and sys.version_info >= (3, 13):
        import ctypes

        import libusb_package

        if (library := libusb_package.get_library_path()) is not None:
            ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    try:
        import open3d
    except ImportError as error:
        raise SlatprepError(
            f"Open3D is installed and cannot be loaded ({error}); it needs libraries of the "
            "system, on Debian: apt-get install libx11-6 libgl1 libgomp1. Open3D 0.20 also needs "
            "libusb-1.0-0; newton[importers] puts it over open3d-cpu 0.19"
        ) from None

    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def _cloud(o3d: Any, points: NDArray[np.float64]) -> Any:
    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(points)
    return cloud

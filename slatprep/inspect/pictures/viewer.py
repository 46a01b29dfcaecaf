"""Show an alignment as meshes in Open3D's interactive viewer."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.geometry.frames import apply_transform
from slatprep.geometry.voxels import occupancy_of
from slatprep.inspect.pictures.scene import Placed, Scene, class_colours, distance_colours
from slatprep.records import RESOLUTION

APART = 1.25
"""Distance between two parts, in edges of the unit cube."""


def has_screen(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> bool:
    """Return whether the environment names a display on which a window can be opened."""
    if platform in ("darwin", "win32"):
        return True
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def show_alignment(scene: Scene, title: str) -> bool:
    """Show before, after, result and error in a window until it is closed.

    Returns whether a window could be opened. Raises SlatprepError if Open3D is not installed.
    """
    from slatprep.align import require_engine
    from slatprep.align.open3d_icp import load_open3d
    from slatprep.parameters import PRESETS

    require_engine(PRESETS["paper"].align)  # Its extra installs the viewer too.
    open3d = load_open3d()
    window = open3d.visualization.Visualizer()
    if not window.create_window(window_name=title, width=1600, height=700):
        return False
    for vertices, triangles, colours in meshes(scene):
        mesh = open3d.geometry.TriangleMesh(
            open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(triangles)
        )
        mesh.vertex_colors = open3d.utility.Vector3dVector(colours)
        mesh.compute_triangle_normals()
        window.add_geometry(mesh)
    window.run()
    window.destroy_window()
    return True


Mesh = tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]]
"""Vertices (V, 3), triangles (T, 3) and a colour (V, 3) of each vertex."""


def meshes(scene: Scene) -> tuple[Mesh, ...]:
    """Return before, after, result and error as meshes side by side along x, in the SLAT frame."""
    slat = Placed(scene.slat, scene.slat_material, np.eye(4))
    by_class = (scene.before, scene.placed, slat)
    parts = [cube_mesh(one.voxels, class_colours(one.material), one.transform) for one in by_class]
    parts.append(cube_mesh(scene.surface, distance_colours(scene.error), np.eye(4)))
    return tuple(
        (vertices + APART * number * np.eye(3)[0], triangles, colours)
        for number, (vertices, triangles, colours) in enumerate(parts)
    )


def cube_mesh(
    voxels: NDArray[np.uint8], colours: NDArray[np.float64], transform: ArrayLike
) -> Mesh:
    """Return the exposed faces of voxels (N, 3) as triangles, with four vertices per face.

    `colours` (N, 3) are in 0..1; `transform` (4, 4) maps to the frame that is shown. Triangles are
    counterclockwise seen from outside.
    """
    empty = ~np.pad(occupancy_of(voxels), 1)
    corners, painted = [], []
    unit = np.eye(3, dtype=np.intp)
    for axis, sign in product(range(3), (1, -1)):
        exposed = empty[tuple((voxels + 1 + sign * unit[axis]).T)]
        u, v = (unit[(axis + 1) % 3], unit[(axis + 2) % 3])[::sign]
        origin = voxels[exposed] + (unit[axis] if sign > 0 else 0)
        corners.append(origin[:, None] + np.stack([0 * u, u, u + v, v]))
        painted.append(np.repeat(colours[exposed], 4, axis=0))
    points = np.concatenate(corners).reshape(-1, 3) / RESOLUTION - 0.5
    first = 4 * np.arange(len(points) // 4, dtype=np.int32)[:, None]
    halves = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    triangles = np.concatenate([first + half for half in halves])
    return apply_transform(transform, points), triangles, np.concatenate(painted)

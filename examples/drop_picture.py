"""Draw a simulated object: its surface moves with the particles, rays find light and shadow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from slatprep.geometry.frames import VOXEL_SIZE, apply_transform
from slatprep.inspect.pictures.canvas import DISTANCE_COLOURS, INK, MUTED
from slatprep.store.reader import StoredAsset

MOST = 0.5
"""Strain at the end of the scale."""


@dataclass(frozen=True)
class Part:
    """The particles of one class: its number, and what the curve is called."""

    number: int
    label: str
    shiny: bool = False


SIZE = (800, 800)
"""Height and width of a panel before it is halved against jagged edges."""

SCALE = LinearSegmentedColormap.from_list("strain", DISTANCE_COLOURS)
_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]])


def draw(
    path: Path,
    positions: np.ndarray,
    frames: np.ndarray,
    strains: np.ndarray,
    material: np.ndarray,
    asset: StoredAsset,
    parts: Sequence[Part],
    chosen: tuple[int, ...],
    rate: int = 60,
) -> None:
    """Draw chosen frames and the course of the strain, and write them as a PNG.

    Parameters
    ----------
    path : Path
        The PNG.
    positions : ndarray, shape (N, 3)
        The particles where the store has them, SLAT frame.
    frames : ndarray, shape (F, N, 3)
        Their motion, in edges of the unit cube; the first frame is at rest.
    strains : ndarray, shape (F, N)
        Their strains.
    material : ndarray, shape (N,)
        Class of each.
    asset : StoredAsset
        The object, whose field gives the surfaces.
    parts : sequence of Part
        The classes there are; dashed lines are for all but the first.
    chosen : tuple of int
        The frames to draw.
    rate : int
        Frames a second.
    """
    figure = Figure(figsize=(12, 5.4), dpi=130)
    grid = figure.add_gridspec(2, len(chosen), height_ratios=(2.0, 1.0), hspace=0.12, wspace=0.04,
                               left=0.055, right=0.865, top=0.94, bottom=0.11)  # fmt: skip
    meshes = [surface(asset, part.number) for part in parts]
    lift = frames[0].mean(axis=0) - positions.mean(axis=0)
    for column, frame in enumerate(chosen):
        axis = figure.add_subplot(grid[0, column])
        axis.imshow(_render(parts, meshes, lift, frames, strains, material, frame))
        axis.set_title(f"{frame / rate:.2f} s", fontsize=11, color=INK)
        axis.set_axis_off()
    axis = figure.add_subplot(grid[1, :])
    seconds = np.arange(len(frames)) / rate
    curves = [np.nanmean(strains[:, material == part.number], axis=1) for part in parts]
    top = 105 * max(curve.max() for curve in curves)
    places = spread([100 * curve[-1] for curve in curves], 0.11 * top)
    for k, (part, curve, place) in enumerate(zip(parts, curves, places, strict=True)):
        axis.plot(seconds, 100 * curve, "--" if k else "-", color=INK, lw=1.8)
        axis.annotate(part.label, (seconds[-1], place), (6, 0), textcoords="offset points",
                      va="center", fontsize=9, color=INK, annotation_clip=False)  # fmt: skip
    for frame in chosen:
        axis.axvline(frame / rate, color=MUTED, lw=0.6, zorder=0)
    axis.set(xlim=(0, seconds[-1]), ylim=(0, top), xlabel="time [s]", ylabel="mean strain [%]")
    axis.spines[["top", "right"]].set_visible(False)
    bar = figure.add_axes((0.9, 0.46, 0.011, 0.4))
    bar.imshow(np.linspace(1, 0, 256)[:, None], aspect="auto", cmap=SCALE, extent=(0, 1, 0, 50))
    bar.set(xticks=[], yticks=[0, 25, 50])
    bar.yaxis.tick_right()
    bar.set_title("strain [%]", fontsize=9, loc="left", pad=8)
    figure.savefig(path)


def spread(heights: Sequence[float], gap: float) -> list[float]:
    """Move labels up until none is nearer than `gap` to the one below it."""
    moved, last = [0.0] * len(heights), -np.inf
    for k in np.argsort(heights, kind="stable"):
        moved[k] = last = max(heights[k], last + gap)
    return moved


def surface(asset: StoredAsset, number: int) -> o3d.geometry.TriangleMesh:
    """Return the smoothed surface of a part, in the SLAT frame."""
    solid = np.pad(asset.grid_material == number, 1)
    corners = []
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        for side in (-1, 1):
            faces = np.argwhere(solid & ~np.roll(solid, -side, axis))
            quad = np.zeros((len(faces), 6, 3))
            quad[..., axis] = faces[:, None, axis] + (side + 1) / 2
            for k, other in enumerate(others):
                quad[..., other] = faces[:, None, other] + _CORNERS[None, :, k]
            corners.append(quad if (side > 0) != (axis == 1) else quad[:, ::-1])
    points = (np.concatenate(corners).reshape(-1, 3) - 1) * VOXEL_SIZE - 0.5
    vertices, triangles = np.unique(points, axis=0, return_inverse=True)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(apply_transform(asset.transform, vertices)),
        o3d.utility.Vector3iVector(triangles.reshape(-1, 3)),
    )
    return mesh.filter_smooth_taubin(60)


def _camera(angle: float) -> np.ndarray:
    """Return the rays (height, width, 6) of a camera that looks down on the ground."""
    eye, target = np.array([1.5, -2.1, 1.0]), np.array([0.0, 0.0, 0.37])
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    step = 2 * np.tan(np.radians(angle) / 2) / SIZE[0]
    rows = (SIZE[0] / 2 - 0.5 - np.arange(SIZE[0])) * step
    columns = (np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2) * step
    ways = ahead + rows[:, None, None] * up + columns[None, :, None] * right
    return np.concatenate([np.broadcast_to(eye, ways.shape), ways], axis=-1)


@dataclass(frozen=True)
class Shape:
    """What rays may hit: triangles, with normals and values (T, 3, ...) at their corners."""

    mesh: o3d.geometry.TriangleMesh
    normals: np.ndarray
    values: np.ndarray
    paint: Callable[[np.ndarray], np.ndarray]
    gloss: float


def _render(parts, meshes, lift, frames, strains, material, frame):
    shapes = []
    for part, mesh in zip(parts, meshes, strict=True):
        here = material == part.number
        known = np.flatnonzero(here)[np.isfinite(strains[frame, here])]
        rest = np.asarray(mesh.vertices) + lift
        distance, near = cKDTree(frames[0, known]).query(rest, k=8)
        weight = 1.0 / (distance**2 + 1e-4)
        weight /= weight.sum(axis=1, keepdims=True)
        shift = (frames[frame] - frames[0])[known][near]
        moved = o3d.geometry.TriangleMesh(mesh)
        moved.vertices = o3d.utility.Vector3dVector(rest + (weight[..., None] * shift).sum(axis=1))
        moved.compute_vertex_normals()
        triangles = np.asarray(moved.triangles)
        strained = (weight * strains[frame, known][near]).sum(axis=1)[triangles]
        shapes.append(Shape(
            moved, np.asarray(moved.vertex_normals)[triangles], strained[..., None],
            lambda value: SCALE(value[:, 0] / MOST)[:, :3], 0.5 if part.shiny else 0.18,
        ))  # fmt: skip
    return trace(shapes)


def trace(shapes: Sequence[Shape], angle: float = 25.0) -> np.ndarray:
    """Return what is seen of shapes on a white, sunlit ground: (height / 2, width / 2, 3).

    `angle` is the camera's, in degrees.
    """
    scene = o3d.t.geometry.RaycastingScene()
    for shape in shapes:
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(shape.mesh))
    ground = o3d.geometry.TriangleMesh.create_box(8.0, 8.0, 0.01).translate((-4, -4, -0.01))
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(ground))

    rays = o3d.core.Tensor(_camera(angle), dtype=o3d.core.Dtype.Float32)
    hit = scene.cast_rays(rays)
    geometry, triangle = hit["geometry_ids"].numpy(), hit["primitive_ids"].numpy()
    uv, far = hit["primitive_uvs"].numpy(), hit["t_hit"].numpy()
    ray = rays.numpy()
    seen = np.isfinite(far)
    place = ray[..., :3] + np.where(seen, far, 0)[..., None] * ray[..., 3:]
    normal = hit["primitive_normals"].numpy().copy()
    colour = np.ones((*far.shape, 3))
    share = np.stack([1 - uv.sum(axis=-1), uv[..., 0], uv[..., 1]], axis=-1)
    gloss = np.zeros(far.shape)
    for k, shape in enumerate(shapes):
        on = geometry == k
        gloss[on] = shape.gloss
        normal[on] = np.einsum("nk,nkc->nc", share[on], shape.normals[triangle[on]])
        value = np.einsum("nk,nkc->nc", share[on], shape.values[triangle[on]])
        colour[on] = shape.paint(value)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-12

    sun = np.array([0.35, -0.5, 0.8]) / np.linalg.norm([0.35, -0.5, 0.8])
    facing = np.clip(normal @ sun, 0, 1)
    start = place + 4e-3 * normal
    shadow = scene.test_occlusions(
        o3d.core.Tensor(np.concatenate([start, np.broadcast_to(sun, start.shape)], axis=-1),
                        dtype=o3d.core.Dtype.Float32)
    ).numpy()  # fmt: skip
    light = 0.5 + 0.12 * normal[..., 2] + 0.45 * facing * ~shadow
    half = sun - ray[..., 3:] / np.linalg.norm(ray[..., 3:], axis=-1, keepdims=True)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    shine = np.clip((normal * half).sum(axis=-1), 0, 1) ** 60 * ~shadow
    shine *= gloss
    image = np.clip(colour * light[..., None] + shine[..., None], 0, 1)
    # The ground is white but for the shadow on it.
    on_ground = geometry == len(shapes)
    image[on_ground] = np.where(shadow[on_ground], 0.83, 1.0)[:, None]
    image[~seen] = 1.0
    return image.reshape(SIZE[0] // 2, 2, SIZE[1] // 2, 2, 3).mean(axis=(1, 3))

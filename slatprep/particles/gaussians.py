"""Gaussians in motion: carried by particles, written with all their attributes, and drawn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, InputError
from slatprep.particles.read import SAVED_AXES, Axes
from slatprep.records import COLOURS
from slatprep.storage.arrays import write_ply
from slatprep.storage.atomic import staged

_NEAREST = 8
"""Number of particles that carry a Gaussian; a cell of a cubic lattice has eight corners."""

_SH = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi)): colour is 0.5 + _SH * f_dc."""

_ROTATION = tuple(f"rot_{index}" for index in range(4))
_SCALE = tuple(f"scale_{index}" for index in range(3))
_COLOUR = tuple(f"f_dc_{index}" for index in range(3))
_FIELDS = ("x", "y", "z", "nx", "ny", "nz", *_COLOUR, "opacity", *_SCALE, *_ROTATION)


class Carrier(NamedTuple):
    """The particles (G, K) that carry each Gaussian, their weights, and the offsets at rest."""

    particles: NDArray[np.intp]
    weights: NDArray[np.float64]
    offsets: NDArray[np.float64]


def bind(points: NDArray[np.float64], rest: NDArray[np.float64], spacing: float) -> Carrier:
    """Bind points (G, 3) to the nearest particles at rest (N, 3), `spacing` apart."""
    from scipy.spatial import cKDTree

    count = min(_NEAREST, len(rest))
    distance, particles = cKDTree(rest).query(points, k=count)
    distance, particles = distance.reshape(-1, count), particles.reshape(-1, count)
    # Relative to the nearest particle, so that a Gaussian far from all still has a carrier.
    falloff = np.exp((distance[:, :1] ** 2 - distance**2) / (0.7 * spacing) ** 2)
    weights = falloff / falloff.sum(axis=1, keepdims=True)
    return Carrier(particles, weights, points[:, None] - rest[particles])


def carry(
    carrier: Carrier, positions: NDArray[np.floating], gradients: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places (G, 3) and gradients (G, 3, 3) of Gaussians from those of their particles.

    Each particle moves its surroundings by its position and its deformation gradient; the
    Gaussian takes the weighted mean.
    """
    local = gradients[carrier.particles]
    moved = positions[carrier.particles] + np.einsum("gkij,gkj->gki", local, carrier.offsets)
    places = np.einsum("gk,gki->gi", carrier.weights, moved)
    return places, np.einsum("gk,gkij->gij", carrier.weights, local)


def rotations(gradients: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the rotation nearest to each gradient (G, 3, 3): the polar decomposition."""
    left, _, right = np.linalg.svd(gradients)
    mirrored = np.linalg.det(left @ right) < 0
    left[mirrored, :, 2] *= -1
    return np.asarray(left @ right)


def deform(
    vertices: NDArray[Any],
    places: NDArray[np.floating],
    gradients: NDArray[np.floating],
    axes: Axes,
    *,
    stretch: bool = False,
) -> NDArray[Any]:
    """Return Gaussians (G,) moved to places of the SLAT frame and turned by the gradients.

    Positions and rotations are written in the file's `axes`. With `stretch` the scales change,
    too: the covariance becomes F C F^T. Other fields stay the same.
    """
    from scipy.spatial.transform import Rotation

    turn = SAVED_AXES[axes]
    moved = vertices.copy()
    _set_columns(moved, "xyz", places @ turn.T)
    local = turn @ gradients @ turn.T
    # The file's quaternions begin with the scalar; scipy's end with it.
    before = Rotation.from_quat(np.roll(_columns(vertices, _ROTATION), -1, axis=1)).as_matrix()
    if stretch:
        scales = np.exp(_columns(vertices, _SCALE))
        after, lengths, _ = np.linalg.svd(local @ before * scales[:, None, :])
        after[np.linalg.det(after) < 0, :, 2] *= -1
        _set_columns(moved, _SCALE, np.log(np.maximum(lengths, 1e-12)))
    else:
        after = rotations(local) @ before
    _set_columns(moved, _ROTATION, np.roll(Rotation.from_matrix(after).as_quat(), 1, axis=1))
    return moved


def _columns(vertices: NDArray[Any], names: Iterable[str]) -> NDArray[np.float64]:
    """Return fields of Gaussians (G,), a column for each."""
    return np.stack([vertices[name] for name in names], axis=1).astype(np.float64)


def _set_columns(vertices: NDArray[Any], names: Iterable[str], values: NDArray[Any]) -> None:
    for name, column in zip(names, values.T, strict=True):
        vertices[name] = column


def gaussians_of(
    positions: NDArray[np.floating], material: NDArray[np.uint8], spacing: float
) -> NDArray[Any]:
    """Make a Gaussian at each position (N, 3) of the SLAT frame, in the colour of its class."""
    made = np.zeros(len(positions), dtype=[(name, "<f4") for name in _FIELDS])
    _set_columns(made, "xyz", positions)
    _set_columns(made, _COLOUR, (COLOURS[material] / 255 - 0.5) / _SH)
    made["opacity"], made["rot_0"] = 6.0, 1.0
    for name in _SCALE:
        made[name] = np.log(0.5 * spacing)
    return made


def colours_of(vertices: NDArray[Any]) -> NDArray[np.float64]:
    """Return the red, green and blue (G, 3) of Gaussians, 0 to 1, from their first harmonic."""
    return np.clip(0.5 + _SH * _columns(vertices, _COLOUR), 0.0, 1.0)


def require_gaussians(vertices: NDArray[Any] | None, path: Path) -> NDArray[Any]:
    """Raise InputError for rows without the fields that are moved, turned and drawn."""
    needed = {"x", "y", "z", "opacity", *_COLOUR, *_SCALE, *_ROTATION}
    missing = needed - set(vertices.dtype.names or ()) if vertices is not None else needed
    if vertices is None or missing:
        raise InputError(path, f"has no {', '.join(sorted(missing))}", "a PLY of Gaussians")
    return vertices


def write_gaussians(path: Path, vertices: NDArray[Any], comment: str) -> None:
    """Write Gaussians (G,) with all their fields, binary little-endian."""
    kinds = {name: vertices.dtype[name].kind for name in vertices.dtype.names or ()}
    layout = [(name, "<f4" if kind == "f" else "<i4") for name, kind in kinds.items()]
    write_ply(path, vertices.astype(layout), comment)


_SUFFIXES = (".gif", ".png", ".webp")


def require_picture(path: Path) -> None:
    """Raise ConfigError if a name does not end in the suffix of a picture."""
    if path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(f"{path}: expected a name that ends in {', '.join(_SUFFIXES)}")


def draw(
    vertices: NDArray[Any],
    places: NDArray[np.floating],
    low: NDArray[np.floating],
    high: NDArray[np.floating],
    pixels: int = 360,
) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) of Gaussians at places (G, 3), z up, seen from the front left.

    The view is orthographic and shows the box from `low` to `high`. Each Gaussian is a disc of
    its mean width; near discs cover distant ones, which are darker.
    """
    turn, tilt = np.radians(30.0), np.radians(15.0)
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    away = np.array([-np.sin(turn) * np.cos(tilt), np.cos(turn) * np.cos(tilt), -np.sin(tilt)])
    up = np.cross(right, away)
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    view = np.stack([right, -up], axis=1)
    seen = corners @ view
    scale = pixels / float(np.ptp(seen, axis=0).max())
    height, width = np.ceil(np.ptp(seen, axis=0)[::-1] * scale).astype(int)
    at = (places @ view - seen.min(axis=0)) * scale
    depth = places @ away
    radius = np.clip(np.exp(_columns(vertices, _SCALE)).mean(axis=1) * scale * 1.5, 0.7, 8.0)
    shade = 1.0 - 0.35 * (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9)
    colours = colours_of(vertices) * 255 * shade[:, None]
    shown = 1 / (1 + np.exp(-np.asarray(vertices["opacity"], dtype=float))) > 0.3
    image = np.full((height, width, 3), 255.0)
    front = np.argsort(depth, kind="stable")  # The nearest first.
    rank, least = np.argsort(front), np.full(height * width, len(front))
    reach = int(np.ceil(radius.max()))
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            inside = shown & (dx * dx + dy * dy <= radius**2)
            x, y = (np.rint(at[:, axis]).astype(int) + d for axis, d in ((0, dx), (1, dy)))
            rows = np.flatnonzero(inside & (x >= 0) & (x < width) & (y >= 0) & (y < height))
            np.minimum.at(least, y[rows] * width + x[rows], rank[rows])
    drawn = least < len(front)
    image.reshape(-1, 3)[drawn] = colours[front[least[drawn]]]
    return image.astype(np.uint8)


def write_picture(path: Path, frames: Sequence[NDArray[np.uint8]], rate: int) -> None:
    """Write frames (H, W, 3) as an animation (gif, webp) or, as png, five of them in a strip."""
    from PIL import Image

    form = path.suffix[1:]
    with staged(path) as new:
        if form.lower() == "png":
            some = np.linspace(0, len(frames) - 1, min(5, len(frames))).round().astype(int)
            strip = np.concatenate([frames[number] for number in some], axis=1)
            Image.fromarray(strip).quantize(64).save(new, form, optimize=True)
            return
        # GIF has hundredths of a second, and programs show no frame for less than two.
        tick, least = (10, 2) if form.lower() == "gif" else (1, 1)
        step = -(-least * tick * rate // 1000)
        # The last picture stands for all frames that are left, so that it is not too short.
        numbers = [*range(0, max(len(frames) - step, 0) + 1, step)]
        ends = [round(1000 / tick * at / rate) * tick for at in (*numbers, len(frames))]
        shown = np.diff(ends).tolist()
        pictures = [Image.fromarray(frames[number]).quantize(64) for number in numbers]
        pictures[0].save(
            new, form, save_all=True, append_images=pictures[1:], duration=shown, loop=0
        )

"""Draw Gaussians as discs, and join frames to a strip or an animation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError
from slatprep.particles.gaussians import colours_of

_PAPER = 255.0
_SUFFIXES = (".gif", ".png", ".webp")


def require_picture(path: Path) -> None:
    """Raise ConfigError for a name that does not say a form of picture."""
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

    The view is an orthographic one of the box from `low` to `high`; each Gaussian is a disc of
    its mean width, the nearest in front, darker toward the ground plane's far side.
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
    spread = np.exp(np.stack([vertices[f"scale_{i}"] for i in range(3)], 1).astype(float))
    radius = np.clip(spread.mean(axis=1) * scale * 1.5, 0.7, 8.0)
    colours = colours_of(vertices) * 255
    shade = 1.0 - 0.35 * (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9)
    colours = colours * shade[:, None]
    shown = 1 / (1 + np.exp(-np.asarray(vertices["opacity"], dtype=float))) > 0.3
    image = np.full((height, width, 3), _PAPER)
    nearest = np.full(height * width, np.inf)
    reach = int(np.ceil(radius.max()))
    winner = np.full(height * width, -1)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            inside = shown & (dx * dx + dy * dy <= radius**2)
            x, y = (np.rint(at[:, axis]).astype(int) + d for axis, d in ((0, dx), (1, dy)))
            rows = np.flatnonzero(inside & (x >= 0) & (x < width) & (y >= 0) & (y < height))
            cells = y[rows] * width + x[rows]
            order = np.argsort(-depth[rows], kind="stable")  # The nearest comes last, and stays.
            best = np.full(height * width, -1)
            best[cells[order]] = rows[order]
            there = np.flatnonzero(best >= 0)
            closer = there[depth[best[there]] < nearest[there]]
            nearest[closer], winner[closer] = depth[best[closer]], best[closer]
    drawn = winner >= 0
    image.reshape(-1, 3)[drawn] = colours[winner[drawn]]
    return image.astype(np.uint8)


def write_picture(path: Path, frames: Sequence[NDArray[np.uint8]], rate: int) -> None:
    """Write frames (H, W, 3) as an animation (gif, webp) or, as png, five of them in a strip."""
    from PIL import Image

    if path.suffix.lower() == ".png":
        some = np.linspace(0, len(frames) - 1, min(5, len(frames))).round().astype(int)
        strip = np.concatenate([frames[number] for number in some], axis=1)
        Image.fromarray(strip).quantize(64).save(path, optimize=True)
        return
    pictures = [Image.fromarray(frame).quantize(64) for frame in frames]
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=round(1000 / rate), loop=0
    )

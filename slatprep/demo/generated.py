"""Model the shape that a generator makes from one image of an object.

Its proportions are wrong and it is bent, most on the side that the image does not show. A
`Distortion` maps points of the generated shape to the corresponding points of the object, so the
true place of a SLAT voxel is computed, not fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from slatprep.demo.model import Rng, direction
from slatprep.geometry.frames import VOXEL_SIZE, Array

_LARGEST_SLOPE = 0.7
"""Upper bound on a bend's change per unit of distance; below 1 the map does not fold."""

_REACH = 0.75
"""Half edge of the cube in which bends are bounded, in object sizes; all shapes fit inside."""

_WRONG = 0.10, 0.25
"""Smallest and largest relative error of the proportions, along one axis."""

_EDGE = 4.0
"""Rate at which a bend grows from the seen to the unseen side, per object size."""


@dataclass(frozen=True)
class Waves:
    """A smooth displacement: a sum of plane sine waves.

    ``amplitude`` and ``wave`` are (W, 3), in units of the points and radians
    across one unit; ``phase`` is (W,).
    """

    amplitude: Array
    wave: Array
    phase: Array

    @classmethod
    def draw(cls, rng: Rng, voxels: float, turns: tuple[float, float], waves: int = 3) -> Self:
        """Draw a displacement of about `voxels` root mean square.

        `turns` are the smallest and largest number of periods of a wave across the cube.
        """
        size = voxels * VOXEL_SIZE * np.sqrt(2.0 / waves)
        amplitude = np.stack([size * direction(rng) for _ in range(waves)])
        wave = [2.0 * np.pi * rng.uniform(*turns) * direction(rng) for _ in range(waves)]
        return cls(amplitude, np.stack(wave), rng.uniform(0.0, 2.0 * np.pi, waves))

    def displacement(self, points: Array) -> Array:
        """Return the displacements of points (P, 3)."""
        return np.asarray(np.sin(points @ self.wave.T + self.phase) @ self.amplitude)

    def __call__(self, points: Array) -> Array:
        """Return the displaced points."""
        return points + self.displacement(points)

    @property
    def sizes(self) -> tuple[Array, Array]:
        """Lengths (W,) of the amplitudes, and (W,) of the wave vectors."""
        return np.linalg.norm(self.amplitude, axis=1), np.linalg.norm(self.wave, axis=1)

    @property
    def reach(self) -> float:
        """Upper bound on the displacement of any point."""
        return float(self.sizes[0].sum())

    @property
    def stretch(self) -> float:
        """Upper bound on the factor by which distances grow."""
        amplitude, wave = self.sizes
        return 1.0 + float((amplitude * wave).sum())


@dataclass(frozen=True)
class Distortion:
    """A smooth map from the generated shape to the object, both in object coordinates.

    With ``q = (y - middle) / size``, it maps a point ``y`` of the generated shape to
    ``middle + size * (q + w(q) b(q)) / proportions``. Here ``b`` is a sum of plane sine waves, and
    ``w`` grows from 2/3 on the side that the image shows to 4/3 on the other.

    Attributes
    ----------
    middle : ndarray of float64, shape (3,)
        Centre of the object's bounding box.
    size : float
        Largest edge of this box.
    proportions : ndarray of float64, shape (3,)
        Stretch of the generated shape along each axis of the object.
    waves : Waves
        The sine waves, in object sizes.
    away : ndarray of float64, shape (3,)
        Unit vector that points away from the image's camera.
    slope : float
        Upper bound on the bend's change per unit of distance.
    """

    middle: Array
    size: float
    proportions: Array
    waves: Waves
    away: Array
    slope: float

    def __call__(self, points: Array) -> Array:
        """Map points (P, 3) of the generated shape to the object."""
        q = (points - self.middle) / self.size
        return np.asarray(self.middle + self.size * (q + self.bend(q)) / self.proportions)

    def inverse(self, points: Array) -> Array:
        """Map points (P, 3) of the object to the generated shape by fixed-point iteration.

        The bend is a contraction by construction: each step multiplies the error by at most
        `slope`.
        """
        target = self.proportions * (points - self.middle) / self.size
        q = target
        for _ in range(40):
            q = target - self.bend(q)
        return np.asarray(self.middle + self.size * q)

    @property
    def stretch(self) -> float:
        """Upper bound on the growth of distances from the generated shape to the object."""
        return (1.0 + self.slope) / float(self.proportions.min())

    def bend(self, q: Array) -> Array:
        """Return the bend (P, 3) at points `q` (P, 3), both in object sizes."""
        return _growth(q, self.away)[:, None] * self.waves.displacement(q)


def _growth(q: Array, away: Array) -> Array:
    """Return the factor (P,) of the waves, which grows towards the unseen side."""
    return np.asarray(1.0 + np.tanh(_EDGE * (q @ away)) / 3.0)


def _slope(waves: Waves, away: Array) -> float:
    """Return an upper bound on the spectral norm of a bend's derivative.

    The norm is computed on a lattice in the cube of half edge `_REACH`; the second derivative
    bounds its change between the lattice points.
    """
    steps = 36
    axis = np.linspace(-_REACH, _REACH, steps)
    q = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    growth, moved = _growth(q, away), waves.displacement(q)
    outer = np.einsum("wi,wj->wij", waves.amplitude, waves.wave).reshape(-1, 9)
    ripple = (growth[:, None] * np.cos(q @ waves.wave.T + waves.phase)) @ outer
    rise = (_EDGE / 3.0) * (1.0 - (3.0 * (growth - 1.0)) ** 2)
    slopes = ripple.reshape(-1, 3, 3) + rise[:, None, None] * moved[:, :, None] * away
    size, turn = waves.sizes
    # The growth is at most 4/3, its first and second derivative _EDGE / 3 and 0.77 _EDGE^2 / 3.
    second = 4.0 / 3.0 * size @ turn**2 + 2.0 * _EDGE / 3.0 * size @ turn
    second += 0.26 * _EDGE**2 * size.sum()
    half_diagonal = np.sqrt(3.0) * _REACH / (steps - 1)
    return float(np.linalg.norm(slopes, 2, axis=(1, 2)).max() + second * half_diagonal)


def draw_distortion(rng: Rng, extent: Array, bend: float) -> Distortion:
    """Draw the distortion of a generated shape, without folds.

    `extent` (2, 3) is the object's bounding box. `bend` is the root mean square of the waves, in
    voxels of a grid that the object fills; they are reduced if the map would fold.
    """
    stretch = np.ones(3)
    stretch[rng.integers(3)] += rng.choice([-1.0, 1.0]) * rng.uniform(*_WRONG)
    waves = Waves.draw(rng, bend, (0.6, 1.1))
    # The camera is anywhere around the object, slightly above or below it.
    angle, height = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.3, 0.5)
    away = np.array([-np.cos(angle), -np.sin(angle), -height])
    away /= np.linalg.norm(away)
    slope = _slope(waves, away)
    less = float(min(1.0, _LARGEST_SLOPE / slope))
    return Distortion(
        middle=extent.mean(axis=0),
        size=float((extent[1] - extent[0]).max()),
        proportions=stretch,
        waves=replace(waves, amplitude=less * waves.amplitude),
        away=away,
        slope=less * slope,
    )

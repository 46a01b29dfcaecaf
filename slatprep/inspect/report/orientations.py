"""The quarter turn nearest to an alignment."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.align.starts import distinct_starts
from slatprep.geometry.frames import split_transform


def nearest_quarter_turn(transform: ArrayLike) -> tuple[int, float]:
    """Return the quarter turn nearest to the rotation of a transform (4, 4), and their angle.

    The first is an index of `quarter_turns`, the second is in degrees.
    """
    rotation, _, _ = split_transform(transform)
    turns = np.stack([start.rotation for start in distinct_starts()])
    traces = np.einsum("kij,ij->k", turns, rotation)
    index = int(np.argmax(traces))
    cosine = np.clip((traces[index] - 1.0) / 2.0, -1.0, 1.0)
    return index, float(np.degrees(np.arccos(cosine)))


def quarter_turns() -> tuple[str, ...]:
    """Return in words where each of the 24 quarter turns takes the axes x, y and z.

    >>> quarter_turns()[0]
    'x→+x y→+y z→+z'
    """
    return tuple(_in_words(start.rotation) for start in distinct_starts())


def _in_words(rotation: NDArray[np.float64]) -> str:
    words = []
    for name, column in zip("xyz", rotation.T, strict=True):
        axis = int(np.argmax(np.abs(column)))
        words.append(f"{name}→{'+' if column[axis] > 0 else '−'}{'xyz'[axis]}")  # noqa: RUF001
    return " ".join(words)

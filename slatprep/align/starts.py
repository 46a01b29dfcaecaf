"""Start orientations of the alignment, and the search from the 64 of the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from slatprep.align.quality import measure_quality
from slatprep.geometry.frames import make_transform
from slatprep.parameters import AlignParameters
from slatprep.records import Alignment, Candidate, MaterialField, Model, Search, StructuredLatents

Transform = NDArray[np.float64]


@dataclass(frozen=True)
class Start:
    """One of the 64 Euler triples, its rotation, and the earlier start that it repeats."""

    index: int
    euler_degrees: tuple[float, float, float]
    rotation: NDArray[np.float64]
    same_as: int | None


@lru_cache(maxsize=1)
def euler_starts() -> tuple[Start, ...]:
    """Return the 64 starts: turns by 0, 90, 180 and 270 degrees about x, then y, then z.

    Only 24 of them are different rotations. The `same_as` of the others is the index of the first
    start with the same rotation. SLAT-Phys, "Physics-to-SLAT Annotation Alignment".
    """
    from scipy.spatial.transform import Rotation

    starts: list[Start] = []
    first: dict[bytes, int] = {}
    for index, (x, y, z) in enumerate(product((0.0, 90.0, 180.0, 270.0), repeat=3)):
        turned = Rotation.from_euler("xyz", (x, y, z), degrees=True).as_matrix()
        rotation = np.rint(turned) + 0.0  # integers, hence exact; the sum is never -0.0
        same_as = first.setdefault(rotation.tobytes(), index)
        starts.append(Start(index, (x, y, z), rotation, None if same_as == index else same_as))
    return tuple(starts)


def distinct_starts() -> tuple[Start, ...]:
    """Return the 24 starts that are different rotations."""
    return tuple(start for start in euler_starts() if start.same_as is None)


def candidates_of(fits: Mapping[int, tuple[float, float]]) -> tuple[Candidate, ...]:
    """Return all 64 candidates from the fitness and inlier rmse (voxels) of the distinct ones."""
    return tuple(
        Candidate(
            start.index,
            start.euler_degrees,
            *fits[start.index if start.same_as is None else start.same_as],
            same_as=start.same_as,
        )
        for start in euler_starts()
    )


def search_starts(
    field: MaterialField,
    latents: StructuredLatents,
    parameters: AlignParameters,
    first: Callable[[Transform], tuple[float, float, Transform]],
    last: Callable[[Transform], Transform],
    starts: Sequence[Start] | None = None,
) -> Alignment:
    """Register from every start, and once more from the best result.

    `first` registers from a start (4, 4) and returns fitness, inlier rmse [voxel] and the
    transform; the highest fitness wins, then the lowest rmse. `last` registers from the winner.
    """
    fits = {
        start.index: first(make_transform(start.rotation))
        for start in (distinct_starts() if starts is None else starts)
    }
    best = max(fits, key=lambda index: (fits[index][0], -fits[index][1], -index))
    transform = last(fits[best][2])
    return Alignment(
        transform=transform,
        engine=parameters.engine,
        model=Model.RIGID,
        search=Search.EULER64,
        quality=measure_quality(field, latents, transform, parameters.radius),
        candidates=candidates_of({index: fit[:2] for index, fit in fits.items()}),
    )


@lru_cache(maxsize=4)
def so3_starts(count: int) -> NDArray[np.float64]:
    """Return `count` rotations (count, 3, 3) spread evenly over all orientations.

    Super-Fibonacci spirals on the unit quaternions: M. Alexa, "Super-Fibonacci Spirals: Fast,
    Low-Discrepancy Sampling of SO(3)", CVPR 2022.
    """
    from scipy.spatial.transform import Rotation

    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2.0 * np.pi * s / phi, 2.0 * np.pi * s / psi
    planes = inner * [np.sin(alpha), np.cos(alpha)], outer * [np.sin(beta), np.cos(beta)]
    return np.asarray(Rotation.from_quat(np.concatenate(planes).T).as_matrix())

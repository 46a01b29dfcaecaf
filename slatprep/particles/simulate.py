"""Drop particles on the ground with an existing engine, and measure what each part suffers.

The engine is Newton's implicit material point method (Linux Foundation,
https://github.com/newton-physics/newton), which runs on a CPU. Being
implicit, it takes jelly and steel in one object with the same time step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.errors import SlatprepError
from slatprep.records import MATERIAL_CLASSES

ELASTIC = (0, 1, 6)
"""Classes that are simulated, all as elastic solids: jelly, metal, stationary."""

_NEVER = 1.0e15
"""Pascal; a yield stress that nothing reaches."""


def drop(
    positions: ArrayLike,
    material: ArrayLike,
    properties: ArrayLike,
    spacing: float,
    *,
    height: float = 0.25,
    seconds: float = 0.5,
    rate: int = 60,
    substeps: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.float64]:
    """Let an elastic object fall on the ground from rest.

    Parameters
    ----------
    positions : array_like, shape (N, 3)
        Particles on a cubic lattice that fills the object [m], z up.
    material : array_like of int, shape (N,)
        Class of each, one of `ELASTIC`.
    properties : array_like, shape (N, 3)
        Young's modulus [Pa], density [kg/m^3] and Poisson's ratio of each.
    spacing : float
        Of the lattice [m]; the engine's grid is twice as wide.
    height : float
        Free fall of the lowest particle [m].
    seconds : float
        Length of the motion.
    rate : int
        Frames a second.
    substeps : int
        Time steps a frame.
    progress : callable, optional
        Called with the frames done and the frames in all.

    Returns
    -------
    ndarray of float64, shape (F, N, 3)
        Positions in every frame [m], the first at rest; the ground is at z = 0.

    Raises
    ------
    SlatprepError
        If the engine is not installed, or a particle cannot be simulated.
    """
    rest, stuff = np.array(positions, dtype=np.float64), np.asarray(properties, dtype=np.float64)
    _check(rest, np.asarray(material), stuff)
    newton, warp = _engine()
    rest[:, 2] += height + spacing / 2 - rest[:, 2].min()
    modulus, density, ratio = stuff.T
    builder = newton.ModelBuilder()
    newton.solvers.SolverImplicitMPM.register_custom_attributes(builder)
    builder.add_particles(
        pos=[warp.vec3(*point) for point in rest],
        vel=[warp.vec3(0.0)] * len(rest),
        mass=(density * spacing**3).tolist(),
        radius=[spacing / 2] * len(rest),
    )
    builder.add_ground_plane()
    model = builder.finalize(device="cpu")
    model.mpm.young_modulus.assign(modulus.astype(np.float32))
    model.mpm.poisson_ratio.assign(ratio.astype(np.float32))
    # Elastic, and so without an end to what it bears, in compression, tension and shear.
    for limit in (model.mpm.yield_pressure, model.mpm.yield_stress):
        limit.fill_(_NEVER)
    model.mpm.tensile_yield_ratio.fill_(1.0)
    solver = newton.solvers.SolverImplicitMPM(
        model,
        config=newton.solvers.SolverImplicitMPM.Config(
            voxel_size=2 * spacing,
            tolerance=1e-6,
            max_iterations=100,
            # One strain a cell leaves modes without resistance, in which steel would creep.
            strain_basis="P1d",
        ),
    )
    now, after = model.state(), model.state()
    frames, count = [rest], round(seconds * rate)
    for frame in range(count):
        for _ in range(substeps):
            solver.step(now, after, None, None, 1.0 / (rate * substeps))
            solver.project_outside(after, after, 1.0 / (rate * substeps))
            now, after = after, now
        frames.append(now.particle_q.numpy().astype(np.float64))
        if progress:
            progress(frame + 1, count)
    return np.stack(frames)


def strain(
    rest: ArrayLike, moved: ArrayLike, part: ArrayLike, spacing: float
) -> NDArray[np.float64]:
    """Measure how much each particle's surroundings are deformed; motion and turns do not count.

    Parameters
    ----------
    rest, moved : array_like, shape (N, 3)
        The particles before and after.
    part : array_like of int, shape (N,)
        Which part each belongs to; only neighbours of the same part count.
    spacing : float
        Of the lattice at rest; the 26 particles around one are its neighbours.

    Returns
    -------
    ndarray of float64, shape (N,)
        Largest absolute principal value of the Green-Lagrange strain
        (F^T F - I) / 2, with F the least-squares fit of the neighbours' motion.
        NaN where the neighbours do not span the space.
    """
    from scipy.spatial import cKDTree

    before, after, label = np.asarray(rest), np.asarray(moved), np.asarray(part)
    pairs = cKDTree(before).query_pairs(1.8 * spacing, output_type="ndarray")
    pairs = pairs[label[pairs[:, 0]] == label[pairs[:, 1]]]
    here, there = np.concatenate([pairs, pairs[:, ::-1]]).T
    old, new = before[there] - before[here], after[there] - after[here]
    spread, motion = np.zeros((2, len(before), 3, 3))
    np.add.at(spread, here, old[:, :, None] * old[:, None, :])
    np.add.at(motion, here, new[:, :, None] * old[:, None, :])
    spans = np.linalg.eigvalsh(spread)[:, 0] > 1e-3 * spacing**2
    gradient = motion[spans] @ np.linalg.inv(spread[spans])
    green = (gradient.transpose(0, 2, 1) @ gradient - np.eye(3)) / 2
    result = np.full(len(before), np.nan)
    result[spans] = np.abs(np.linalg.eigvalsh(green)).max(axis=1)
    return result


def rigid_deviation(rest: ArrayLike, moved: ArrayLike) -> float:
    """Return how far (root mean square) points are from the best rigid motion of them.

    Parameters
    ----------
    rest, moved : array_like, shape (N, 3)
        The particles of one part before and after, N >= 3.

    Returns
    -------
    float
        In the unit of the positions; 0 where the part only moved and turned.

    Notes
    -----
    Kabsch, "A solution for the best rotation to relate two sets of vectors",
    Acta Crystallographica A32 (1976).
    """
    from scipy.spatial.transform import Rotation

    old, new = np.asarray(rest, dtype=np.float64), np.asarray(moved, dtype=np.float64)
    before, after = old - old.mean(axis=0), new - new.mean(axis=0)
    turn, _ = Rotation.align_vectors(after, before)
    return float(np.sqrt(((turn.apply(before) - after) ** 2).sum(axis=1).mean()))


def _check(
    positions: NDArray[np.float64], material: NDArray[np.int_], properties: NDArray[np.float64]
) -> None:
    if len(positions) == 0:
        raise SlatprepError("there are no particles to simulate")
    others = sorted(set(material.tolist()) - set(ELASTIC))
    if others:
        name = dict(enumerate(MATERIAL_CLASSES)).get(others[0], "unknown")
        raise SlatprepError(
            f"material {others[0]} ({name}) is not simulated; expected "
            f"{', '.join(f'{index} ({MATERIAL_CLASSES[index]})' for index in ELASTIC)}"
        )
    modulus, density, ratio = properties.T
    wrong = ~((modulus > 0) & (density > 0) & (ratio > -1) & (ratio < 0.5))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise SlatprepError(
            f"particle {row} has E = {modulus[row]:g} Pa, density = {density[row]:g} kg/m^3, "
            f"nu = {ratio[row]:g}; expected E and density above 0, nu above -1 and below 0.5"
        )


def _engine() -> tuple[Any, Any]:
    try:
        import newton
        import warp
    except ImportError as error:
        raise SlatprepError(
            f"simulation needs the package {error.name}; install it with "
            "`pip install 'slatprep[simulate]'`"
        ) from error
    warp.config.quiet = True
    return newton, warp

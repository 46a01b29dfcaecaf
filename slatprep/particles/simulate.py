"""Simulate particles that fall or stand in the wind.

The engine is Newton's implicit material point method (Linux Foundation,
https://github.com/newton-physics/newton), which runs on a CPU. It is implicit, so one time step
suits jelly and steel in the same object.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.errors import SlatprepError, needing
from slatprep.records import MATERIAL_CLASSES
from slatprep.records.yielding import MAX_POISSON, YIELDING
from slatprep.workers import Progress

AIR, DRAG = 1.2, 1.0
"""Density of air [kg/m^3], and the drag coefficient of a face."""

_LIMITS = ("friction", "yield_pressure", "tensile_yield_ratio", "yield_stress", "hardening",
           "dilatancy", "viscosity")  # fmt: skip
"""The engine's arrays for the fields of `Yielding`."""


_BOUNDS = (("E", "Pa", 1e-3, 1e15), ("density", "kg/m^3", 1e-3, 1e6), ("nu", "", -0.999, 0.5))
"""Name, unit, least and largest value of each property; beyond, the engine's float32 fail."""

_LENGTHS = 1e-6, 1e4
"""Smallest spacing and largest distance [m] that the engine takes."""

_MOST_WIND, _MOST_FRAMES = 1e3, 10_000
"""Largest speed of the wind [m/s], and number of frames."""


class Motion(NamedTuple):
    """Positions (F, N, 3) [m] and deformation gradients (F, N, 3, 3) of particles by frame.

    The engine keeps the principal stretches of a gradient between 0.25 and 2.
    """

    positions: NDArray[np.float64]
    gradients: NDArray[np.float32]


def simulate_motion(
    positions: ArrayLike,
    material: ArrayLike,
    properties: ArrayLike,
    spacing: float,
    *,
    height: float = 0.25,
    gravity: float = 9.81,
    wind: ArrayLike = (0.0, 0.0, 0.0),
    fixed: ArrayLike | None = None,
    seconds: float = 0.5,
    rate: int = 60,
    substeps: int = 2,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Motion:
    """Simulate an object that falls to the ground from rest, in still air or in the wind.

    `positions` (N, 3) [m], z up, are on a cubic lattice, `spacing` [m] apart, that fills the
    object; `material` (N,) is one of `YIELDING`; `properties` (N, 3) are Young's modulus [Pa],
    density [kg/m^3] and Poisson's ratio. The lowest particle starts `height` [m] above the
    ground, z = 0. The initial shape is treated as free of stress, so an object whose shape
    already includes the sag under its weight sags further. `wind` [m/s] presses with
    ``AIR * DRAG / 2`` times the square of the velocity relative to the particle on each free
    face that meets it; parts do not shelter each other. Particles of `fixed` (N,) do not move.
    Each of `rate` frames a second has `substeps` time steps; the first frame is the start. The
    cells of the engine's grid are two spacings wide. `progress` is called with the number of
    frames done and of all. SlatprepError if the engine or the device is missing, or something
    cannot be simulated.
    """
    rest, stuff = np.array(positions, dtype=np.float64), np.asarray(properties, dtype=np.float64)
    _check(rest, np.asarray(material), stuff)
    air, count = np.asarray(wind, dtype=np.float64), seconds * rate
    _check_scene(rest, spacing, height, air, count)
    if clipped := int(np.count_nonzero(stuff[:, 2] > MAX_POISSON)):
        warnings.warn(f"nu of {clipped:,} particles is taken as {MAX_POISSON}", stacklevel=3)
        stuff = np.minimum(stuff, [np.inf, np.inf, MAX_POISSON])
    newton, warp = _engine()
    try:
        warp.get_device(device)
    except ValueError:
        there = ", ".join(map(str, warp.get_devices()))
        raise SlatprepError(f"{device!r} is no device here; expected {there}") from None
    rest[:, 2] += height + spacing / 2 - rest[:, 2].min()
    modulus, density, ratio = stuff.T
    held = np.zeros(len(rest), dtype=bool) if fixed is None else np.asarray(fixed, dtype=bool)
    mass = density * spacing**3
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    newton.solvers.SolverImplicitMPM.register_custom_attributes(builder)
    builder.add_particles(
        pos=[warp.vec3(*point) for point in rest],
        vel=[warp.vec3(0.0)] * len(rest),
        mass=np.where(held, 0.0, mass).tolist(),  # The engine treats 0 as infinite.
        radius=[spacing / 2] * len(rest),
    )
    builder.add_ground_plane()
    model = builder.finalize(device=device)
    model.mpm.young_modulus.assign(modulus.astype(np.float32))
    model.mpm.poisson_ratio.assign(ratio.astype(np.float32))
    limits = np.array([YIELDING[number] for number in np.asarray(material).tolist()], np.float32)
    for name, column in zip(_LIMITS, limits.T, strict=True):
        getattr(model.mpm, name).assign(column)
    solver = newton.solvers.SolverImplicitMPM(
        model,
        config=newton.solvers.SolverImplicitMPM.Config(
            voxel_size=2 * spacing,
            tolerance=1e-6,
            max_iterations=100,
            # With one strain per cell some modes have no resistance, and steel creeps.
            strain_basis="P1d",
        ),
    )
    now, after = model.state(), model.state()
    area = windward(rest, air, spacing)
    frames, gradients = [rest], [np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))]
    for done in range(round(count)):
        for _ in range(substeps):
            if area.any():
                past = air - now.particle_qd.numpy()
                speed = np.linalg.norm(past, axis=1)
                now.particle_f.assign((AIR * DRAG / 2 * area * speed)[:, None] * past)
            solver.step(now, after, None, None, 1.0 / (rate * substeps))
            solver.project_outside(after, after, 1.0 / (rate * substeps))
            solver.update_particle_frames(now, after, 1.0 / (rate * substeps))
            now, after = after, now
        frames.append(now.particle_q.numpy().astype(np.float64))
        gradients.append(now.mpm.particle_transform.numpy().copy())
        if progress:
            progress(done + 1, round(count))
    moved = np.stack(frames)
    way = np.linalg.norm(np.diff(moved, axis=0), axis=2).max(initial=0.0)
    if (crossed := way / (2 * spacing)) > substeps:
        warnings.warn(
            f"particles cross {crossed / substeps:.1f} cells in a time step, which tears or "
            f"squashes them; take --substeps {int(np.ceil(crossed))} or more",
            stacklevel=3,
        )
    return Motion(moved, np.stack(gradients))


def windward(positions: ArrayLike, wind: ArrayLike, spacing: float) -> NDArray[np.float64]:
    """Return the area (N,) of particles' free upwind faces, projected along the wind (3,).

    The particles are on a lattice. The area is in the squared unit of `spacing`, and 0 without
    a free upwind face.
    """
    rest, way = np.asarray(positions, dtype=np.float64), np.asarray(wind, dtype=np.float64)
    area = np.zeros(len(rest))
    if not way.any():
        return area
    cells = np.rint((rest - rest.min(axis=0)) / spacing).astype(np.int64) + 1
    taken = np.zeros(cells.max(axis=0) + 2, dtype=bool)
    taken[tuple(cells.T)] = True
    for axis, part in enumerate(way / np.linalg.norm(way)):
        upwind = cells.copy()
        upwind[:, axis] -= int(np.sign(part))
        area += abs(part) * ~taken[tuple(upwind.T)]
    return area * spacing**2


def _check(
    positions: NDArray[np.float64], material: NDArray[np.int_], properties: NDArray[np.float64]
) -> None:
    if len(positions) == 0:
        raise SlatprepError("there are no particles to simulate; raise --particles")
    others = sorted(set(material.tolist()) - set(YIELDING))
    if others:
        name = dict(enumerate(MATERIAL_CLASSES)).get(others[0], "unknown")
        raise SlatprepError(
            f"material {others[0]} ({name}) is not simulated; expected "
            f"{', '.join(f'{index} ({MATERIAL_CLASSES[index]})' for index in sorted(YIELDING))}"
        )
    for values, (name, unit, least, most) in zip(properties.T, _BOUNDS, strict=True):
        wrong = ~((values >= least) & (values <= most))
        if wrong.any():
            row = int(np.argmax(wrong))
            raise SlatprepError(
                f"particle {row} has {name} = {values[row]:g} {unit}".rstrip()
                + f"; expected {least:g} to {most:g}"
            )


def _check_scene(
    positions: NDArray[np.float64],
    spacing: float,
    height: float,
    wind: NDArray[np.float64],
    frames: float,
) -> None:
    least, most = _LENGTHS
    lengths = {
        "spacing": (spacing, least),
        "object": (float(np.ptp(positions, axis=0).max()), 0.0),
        "height": (height, 0.0),
    }
    for name, (length, smallest) in lengths.items():
        if not smallest <= length <= most:
            raise SlatprepError(f"{name}: {length:g} m; expected {smallest:g} to {most:g} m")
    if not (np.abs(wind) <= _MOST_WIND).all():
        raise SlatprepError(f"wind: {wind} m/s; expected at most {_MOST_WIND:g} m/s")
    if not 0.5 < frames < _MOST_FRAMES + 0.5:
        raise SlatprepError(
            f"seconds times rate is {frames:g}; expected 1 to {_MOST_FRAMES:,} frames"
        )


def preferred_device() -> str:
    """Return the engine's name of the GPU if there is one, else ``cpu``."""
    return str(_engine()[1].get_preferred_device())


def _engine() -> tuple[Any, Any]:
    with needing("simulation needs", "simulate"):
        import newton
        import warp
    warp.config.log_level = warp.LOG_WARNING  # Otherwise each kernel prints a line to stdout.
    return newton, warp

"""Limits of elasticity, assumed for each class, since no source states them."""

from __future__ import annotations

from typing import NamedTuple

ELASTIC = (0, 1, 6)
"""Classes that are simulated as elastic solids: jelly, metal, stationary."""

MAX_POISSON = 0.499
"""Largest Poisson's ratio of a simulation; at 0.5 a solid has no bulk compliance."""

_NEVER = 1.0e15
"""A yield stress [Pa] above all stresses."""


class Yielding(NamedTuple):
    """Limits at which a material stops being elastic; PixieVerse has no such properties.

    Attributes
    ----------
    friction : float
        Ratio of shear stress to pressure at yield; 0.68 is an angle of repose of 34 degrees.
    pressure : float
        Yield pressure [Pa].
    tension : float
        Yield stress in tension as a share of `pressure`.
    stress : float
        Shear stress at yield without pressure [Pa].
    hardening : float
        How much compaction strengthens and loosening weakens the material.
    dilatancy : float
        Change of volume by shear, 0 to 1.
    viscosity : float
        Viscosity after yield [Pa s].
    """

    friction: float = 0.0
    pressure: float = _NEVER
    tension: float = 1.0
    stress: float = 0.0
    hardening: float = 0.0
    dilatancy: float = 0.0
    viscosity: float = 0.0


YIELDING = {
    **dict.fromkeys(ELASTIC, Yielding(stress=_NEVER)),
    2: Yielding(friction=0.68, tension=0.0),
    3: Yielding(stress=300.0, viscosity=100.0),
    4: Yielding(viscosity=1e-3),
    5: Yielding(friction=0.5, pressure=3e3, tension=0.2, hardening=10.0, dilatancy=1.0),
}
"""Assumptions for each class: dry sand, mud for visplas, water, fresh snow."""

"""Define a demo object, its materials, and the pieces that several objects share.

z is up and units are arbitrary; proportions and positions come from the random
generator. Materials lie within the ranges that Pixie publishes for PixieVerse
(density 50 to 7,400 kg/m^3, Young's modulus 1e3 to 7.6e10 Pa, Poisson's ratio
0.21 to 0.449); classes are PhysGaussian's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from slatprep.demo.shapes import Part, Shape, Stuff, capsule, carve, cone, polytope
from slatprep.geometry.frames import Array, even_directions

Rng = np.random.Generator
Range = tuple[float, float]

JELLY, METAL, SAND, VISPLAS, FLUID, SNOW, STATIONARY = range(7)

MATERIALS: dict[str, tuple[int, Range, Range, Range]] = {
    # name: class, Young's modulus [Pa], density [kg/m^3], Poisson's ratio
    "wood": (JELLY, (2e6, 2e7), (400, 800), (0.30, 0.40)),
    "leaf": (JELLY, (2e4, 2e5), (80, 250), (0.35, 0.43)),
    "petal": (JELLY, (1e4, 6e4), (60, 150), (0.37, 0.44)),
    "stem": (JELLY, (1e5, 1e6), (150, 350), (0.33, 0.40)),
    "grass": (JELLY, (5e4, 4e5), (80, 200), (0.35, 0.42)),
    "flesh": (JELLY, (5e5, 3e6), (800, 1000), (0.33, 0.42)),
    "rubber": (JELLY, (1e6, 5e6), (900, 1200), (0.44, 0.449)),
    "foam": (JELLY, (5e4, 5e5), (80, 200), (0.30, 0.40)),
    "jello": (JELLY, (1.5e3, 1.5e4), (1000, 1100), (0.42, 0.449)),
    "steel": (METAL, (4e10, 7.5e10), (7000, 7400), (0.27, 0.31)),
    "aluminium": (METAL, (6e10, 7e10), (2600, 2800), (0.31, 0.34)),
    "sand": (SAND, (5e6, 5e7), (1500, 2000), (0.25, 0.35)),
    "soil": (SAND, (1e6, 1e7), (1200, 1600), (0.28, 0.36)),
    "mud": (VISPLAS, (1e5, 1e6), (1500, 1900), (0.38, 0.44)),
    "water": (FLUID, (1e5, 2e6), (990, 1030), (0.44, 0.449)),
    "snow": (SNOW, (1e5, 1e6), (100, 400), (0.22, 0.30)),
    "ceramic": (STATIONARY, (5e9, 5e10), (2000, 2500), (0.22, 0.28)),
    "glass": (STATIONARY, (5e10, 7e10), (2300, 2600), (0.22, 0.25)),
    "stone": (STATIONARY, (1e10, 6e10), (2400, 2900), (0.22, 0.30)),
    "plastic": (STATIONARY, (1e9, 3e9), (950, 1300), (0.35, 0.41)),
}


def draw(rng: Rng, name: str) -> Stuff:
    """Draw a stuff of a named material: Young's modulus log-uniform, other values uniform.

    Values are rounded to three digits, like the labels of PixieVerse.
    """
    material, modulus, density, poisson = MATERIALS[name]
    return Stuff(
        material,
        float(f"{10 ** rng.uniform(*np.log10(modulus)):.3g}"),
        float(f"{rng.uniform(*density):.3g}"),
        float(f"{rng.uniform(*poisson):.3g}"),
    )


@dataclass(frozen=True)
class DemoObject:
    """An object of the demo.

    ``symmetric`` is true if several placements have the same geometry, ignoring materials.
    """

    name: str
    parts: Sequence[Part]
    symmetric: bool = False


def made_of(stuff: Stuff, *shapes: Shape) -> list[Part]:
    """Return a part of the same stuff for each shape."""
    return [Part(shape, stuff) for shape in shapes]


def vec(*values: float) -> Array:
    """Return a vector of float64."""
    return np.array(values, dtype=np.float64)


def around(angle: float, radius: float, z: float) -> Array:
    """Return a point in cylindrical coordinates (angle in radians)."""
    return vec(radius * np.cos(angle), radius * np.sin(angle), z)


def orient(angle: float, tilt: float = 0.0) -> Array:
    """Return the rotation (3, 3) by `tilt` about y, then by `angle` about z, in radians."""
    c, s, ct, st = np.cos(angle), np.sin(angle), np.cos(tilt), np.sin(tilt)
    heading = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return np.asarray(heading @ np.array([[ct, 0, st], [0, 1, 0], [-st, 0, ct]]))


def direction(rng: Rng) -> Array:
    """Draw a unit vector uniformly."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def curve(points: Sequence[Array] | Array, radii: Sequence[float] | Array) -> list[Shape]:
    """Return capsules along a polyline of points (K, 3), one radius per segment."""
    return [capsule(a, b, k) for a, b, k in zip(points[:-1], points[1:], radii, strict=True)]


def rock(rng: Rng, centre: ArrayLike, radii: ArrayLike) -> Shape:
    """Return a convex stone with irregular faces."""
    faces = 13
    normals = even_directions(faces) + rng.normal(0.0, 0.18, (faces, 3))
    # A plane of the unit ball, scaled by r and moved to the centre, has the normal n / r.
    normals = normals / np.asarray(radii)
    length = np.linalg.norm(normals, axis=1)
    normals /= length[:, None]
    offsets = rng.uniform(0.8, 1.0, faces) / length + normals @ np.asarray(centre)
    return polytope(normals, offsets)


def vessel(
    bottom: float, top: float, radius: float, top_radius: float, wall: float, floor: float = 0.0
) -> Shape:
    """Return an upright hollow frustum, with a floor if `floor` is not 0.

    The hollow extends beyond open ends; otherwise the distance bound would be near zero on the
    planes of these ends, away from the surface.
    """
    slope = (top_radius - radius) / (top - bottom)
    low, high = bottom + (floor or -0.2), top + 0.2
    hollow = cone(
        vec(0, 0, low),
        vec(0, 0, high),
        radius + slope * (low - bottom) - wall,
        top_radius + slope * 0.2 - wall,
    )
    return carve(cone(vec(0, 0, bottom), vec(0, 0, top), radius, top_radius), hollow)


def pot(rng: Rng, radius: float, height: float, outside: Stuff, filling: Stuff) -> list[Part]:
    """Return a pot that stands on z = 0 and is four fifths full."""
    foot = radius * rng.uniform(0.65, 0.8)
    wall = 0.13 * radius
    level = 0.8 * height
    inner = foot + (radius - foot) * level / height - 0.5 * wall
    content = cone(vec(0, 0, wall), vec(0, 0, level), foot - 0.5 * wall, inner)
    shell = vessel(0.0, height, foot, radius, wall, floor=1.5 * wall)
    return [Part(shell, outside), Part(content, filling)]

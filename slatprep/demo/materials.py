"""The materials of the demo's parts, in plausible ranges.

Ranges are SI and lie within the span that Pixie publishes for PixieVerse
(density 50 to 7,400 kg/m^3, Young's modulus 1e3 to 7.6e10 Pa, Poisson's ratio
0.21 to 0.449); classes are PhysGaussian's.
"""

from __future__ import annotations

import numpy as np

from slatprep.demo.shapes import Stuff

JELLY, METAL, SAND, VISPLAS, FLUID, SNOW, STATIONARY = range(7)

Range = tuple[float, float]

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


def draw(rng: np.random.Generator, name: str) -> Stuff:
    """Draw a stuff of a named material: Young's modulus log-uniform, the rest uniform.

    Values are rounded to three digits, as the labels of PixieVerse are.
    """
    material, modulus, density, poisson = MATERIALS[name]
    return Stuff(
        material,
        float(f"{10 ** rng.uniform(*np.log10(modulus)):.3g}"),
        float(f"{rng.uniform(*density):.3g}"),
        float(f"{rng.uniform(*poisson):.3g}"),
    )

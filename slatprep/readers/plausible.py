"""Values that materials can have, with references, and common mistakes in a dataset's values.

Mistakes concern units, columns, class ids and layouts. If undoing a mistake makes implausible
values plausible, it was likely made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import permutations, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.records import LOG10, PROPERTIES, Units, oddity, to_si

EXTENTS = (
    # The softest gels have some Pa; diamond has 1.05 to 1.22 TPa (CRC Handbook of Chemistry and
    # Physics).
    (1.0, 2e12),
    # Silica aerogels have 3 kg/m^3 and more (Soleimani Dorcheh and Abbasi, Journal of Materials
    # Processing Technology 199, 2008); osmium has 22,590 (CRC Handbook).
    (1.0, 25_000.0),
    # Isotropic and not auxetic (Greaves et al., Nature Materials 10, 2011).
    (0.0, 0.5),
)
"""Smallest and largest value of any material, for each of `PROPERTIES`."""

ENOUGH = 64
"""Number of voxels below which coordinates and moments allow no conclusion."""


def coarse_places(voxels: NDArray[Any], side: int, way: str = "") -> list[str]:
    """Warn if voxels (N, 3) fill an eighth of a grid: its lowest one, or every second cell."""
    every_second = (np.ptp(voxels % 2, axis=0) == 0).all()
    if len(voxels) < ENOUGH or (voxels.max() >= side // 2 and not every_second):
        return []
    where = f"no coordinate is above {voxels.max()}"
    if every_second:
        where = "along each axis all coordinates are even, or all are odd"
    text = f"{where}, as on a grid of {side // 2}^3, and {side}^3 is read"
    return [oddity("places", f"{text}; {way or f'make the voxels of a grid of {side}^3'}")]


# Bounds on E over density [Pa m^3/kg]. Carbon has the most: diamond 3.5e8, fibres 4.4e8, nanotubes
# 8e8. With E in GPa, any material has less than 0.1; Pixie asks its labeller for 13 and more.
_STIFFEST, _SOFTEST = 1e9, 0.1

# Only aerogels have a density [kg/m^3] below _LIGHT. A foam of relative density r has r^2 times the
# modulus of its solid (Gibson and Ashby, Cellular Solids, 1997). A solid of 1e10 Pa and 1,000
# kg/m^3 has E = 1e4 density^2, and 100 times that is beyond all woods and foams.
_LIGHT, _FOAM = 10.0, 1e6

# Only metals have a density above _HEAVY. Pixie gives the metals of its crates 1e8 Pa, as its
# solver is explicit; rubber has 1e6 to 1e7. The lightest metal in use is magnesium, with 1,740.
_HEAVY, _LIGHT_METAL, _RUBBER, _SOFT_METAL = 5_000.0, 1_500.0, 1e7, 1e6

# Stone, glass and ceramics are denser than _STONE, and much stiffer than _SOFT_STONE. Labels may
# still be so soft for a simulation's sake, so they are unusual and not refused.
_STONE, _SOFT_STONE, _SOFT_BASE = 2_200.0, 2e5, 3e3

# The lightest liquid at room temperature, isopentane, has 620 kg/m^3 (CRC Handbook); no paste or
# mud is as light as a foam.
LIGHTEST = {"fluid": 600.0, "visplas": 300.0}

# Range of Young's modulus of PixieVerse's classes, as Pixie asks its labeller for it.
_USUAL = {
    "jelly": (3e2, 3e8),
    "metal": (1e7, 3e11),
    "sand": (1e4, 1e9),
    "visplas": (1e3, 1e8),
    "fluid": (1e2, 1e10),
    "snow": (1e3, 1e8),
}
_USUAL_MODULUS, _USUAL_DENSITY = (3e2, 3e11), (15.0, 9_000.0)

_SI = {one.name: one.unit for one in PROPERTIES}
UNSTATED = Units()
"""Units of a source for which none are stated."""


class Part(NamedTuple):
    """Medians of a class, NaN for a property it lacks, and its share of the voxels."""

    name: str
    share: float
    modulus: float
    density: float
    ratio: float

    @property
    def values(self) -> tuple[float, float, float]:
        """The medians alone."""
        return self.modulus, self.density, self.ratio


def units_now(stated: Units, bare: Units) -> dict[str, str]:
    """Return the unit by which each of `PROPERTIES` is read: stated, or else the adapter's."""
    return {one.name: stated.of(one.name) or bare.of(one.name) or one.unit for one in PROPERTIES}


def in_si(units: Mapping[str, str], part: Part) -> Part:
    """Convert a part from these units, by property, to SI units, rounded as fields hold them."""
    values = (to_si(one, units[k.name]) for k, one in zip(PROPERTIES, part.values, strict=True))
    with np.errstate(over="ignore"):  # A unit that is only tried may give more than a float32.
        return Part(part.name, part.share, *(float(np.float32(one)) for one in values))


def beyond_all(part: Part) -> str:
    """Say which value of a part is outside the range of all materials; empty if none is."""
    for one, (least, most), value in zip(PROPERTIES, EXTENTS, part.values, strict=True):
        if value < least or value > most:
            unit = "" if one.unit == "1" else f" {one.unit}"
            known = f"{least:g} to {most:g}{unit}"
            return f"{one.title} {value:.3g}, and all materials have {known}"
    return ""


def fault_of(part: Part, units: Units = UNSTATED) -> str:
    """Say which values of a part in SI units no material has; empty if all are plausible."""
    modulus, density = part.modulus, part.density
    if fault := beyond_all(part):
        return fault
    asked = not units.density, not units.youngs_modulus
    if asked[0] and density < _LIGHT:
        return f"density {density:.3g} kg/m^3, as aerogels alone have"
    if asked[0] and density < LIGHTEST.get(part.name, 0):
        return (
            f"density {density:.3g} kg/m^3, and no {part.name} is lighter than "
            f"{LIGHTEST[part.name]:g}"
        )
    both = f"Young's modulus {modulus:.3g} Pa with density {density:.3g} kg/m^3"
    if modulus > min(_STIFFEST, _FOAM * density) * density:
        return f"{both}: no material is so stiff and so light"
    if not all(asked):
        return ""
    if modulus < _SOFTEST * density:
        return f"{both}: no material is so soft and so heavy"
    if density > _HEAVY and modulus < _RUBBER:
        return f"{both}: a metal's density, and not its stiffness"
    # A lighter part is likely of another class: then the label is wrong, and not the unit.
    if part.name == "metal" and modulus < _SOFT_METAL and density > _LIGHT_METAL:
        return f"Young's modulus {modulus:.3g} Pa, and no metal is so soft"
    return ""


def oddity_of(part: Part, units: Units) -> str:
    """Say which values of a part are unusual, though possible; empty if none is."""
    if units.youngs_modulus or part.name not in ("stationary", ""):
        return ""
    if part.density > _STONE and part.modulus < _SOFT_STONE:
        return (
            f"Young's modulus {part.modulus:.3g} Pa with density {part.density:.3g} kg/m^3: "
            "is it in MPa?"
        )
    if part.name and part.modulus < _SOFT_BASE:
        return f"Young's modulus {part.modulus:.3g} Pa, softer than rubber: is it in MPa?"
    return ""


def is_usual(part: Part) -> bool:
    """Return whether a part's values are in PixieVerse's ranges for its class."""
    least, most = _USUAL.get(part.name, _USUAL_MODULUS)
    lo, hi = _USUAL_DENSITY
    # Comparisons with NaN are false, so that a property that is missing passes.
    return not (
        part.modulus < least or part.modulus > most or part.density < lo or part.density > hi
    )


def is_physical(part: Part) -> bool:
    """Return whether all values are physical; see `slatprep.records.Property.physical`."""
    above = all(math.isnan(one) or 0 < one < math.inf for one in (part.modulus, part.density))
    return above and not (part.ratio < 0 or part.ratio > 0.5)


class Mistake(NamedTuple):
    """A common mistake: a description, what corrects it, and the part in SI units without it."""

    words: str
    setting: str
    undo: Callable[[Part], Part]


def mistakes_of(
    parts: Sequence[Part], stated: Units = UNSTATED, bare: Units = UNSTATED
) -> list[Mistake]:
    """Return the mistakes that explain implausible values, the likeliest first.

    Values are as in the files: in the units `stated`, and where none is, in the adapter's `bare`.
    """
    if _look_normalised([in_si(units_now(stated, bare), part) for part in parts]):
        setting = "channels first where the values are a prediction, normalised to [-1, 1]"
        return [Mistake("normalised ones", setting, lambda part: part)]
    whole = sum(part.share for part in parts)
    found = []
    for mistake in _known_mistakes(parts, stated, bare):
        undone = [mistake.undo(part) for part in parts]
        good = sum(part.share for part in undone if not fault_of(part))
        if good >= 0.9 * whole:
            usual = sum(part.share for part in undone if is_usual(part))
            found.append((-round(usual / whole, 1), mistake))
    found.sort(key=lambda one: one[0])  # Of equal ones, the likelier stays first.
    best = found[0][0] if found else 0.0
    return [mistake for usual, mistake in found if usual <= best + 0.25]


def _known_mistakes(parts: Sequence[Part], stated: Units, bare: Units) -> Iterator[Mistake]:
    """Yield common mistakes: units of one or both columns, ids of classes, and swapped columns."""
    known = {"youngs_modulus": ("GPa", "MPa", "kPa", f"{LOG10}Pa"),
             "density": ("g/cm^3", f"{LOG10}kg/m^3")}  # fmt: skip
    now, choices = units_now(stated, bare), list[list[str]]()
    for k, (name, others) in enumerate(known.items()):
        fixed = all(math.isnan(part.values[k]) for part in parts) or bare.of(name) == _SI[name]
        tried = () if fixed else (_SI[name], *others)
        choices.append(list(dict.fromkeys([now[name], *tried])))
    # Among pairs of units, two logarithms are the likeliest.
    pairs = sorted(
        product(*choices),
        key=lambda pair: (
            sum(unit != now[name] for name, unit in zip(known, pair, strict=True)),
            not all(one.startswith(LOG10) for one in pair),
        ),
    )
    for pair in pairs[1:]:
        yield _other_units(now | dict(zip(known, pair, strict=True)), stated, bare)
    if {part.name for part in parts} & LIGHTEST.keys():
        yield Mistake(
            "classes of PhysGaussian's table, where 3 is foam, 4 is snow and 5 is plasticine",
            "class ids 0 jelly, 1 metal, 2 sand, 3 visplas, 4 fluid, 5 snow, 6 stationary",
            lambda part: in_si(now, part)._replace(name=""),
        )
    # What has units of its own has names as well, and no order.
    if any(vars(bare).values()) or any(math.isnan(one) for part in parts for one in part.values):
        return
    names = [one.title for one in PROPERTIES]
    for order in list(permutations(range(3)))[1:]:
        moved = [f"{names[k]} where {names[at]} belongs" for at, k in enumerate(order) if at != k]
        words, undo = f"swapped columns, {' and '.join(moved)}", partial(_moved, order, now)
        yield Mistake(words, "look at the order", undo)


def in_toml(units: Mapping[str, str]) -> str:
    """Return units by property as a dataset definition writes them; empty if none is stated."""
    given = ", ".join(f'{name} = "{unit}"' for name, unit in units.items() if unit)
    return given and f"units = {{ {given} }}"


def _other_units(truly: Mapping[str, str], stated: Units, bare: Units) -> Mistake:
    """Return the mistake that values are `truly` in these units, by property."""
    now, usual = units_now(stated, bare), units_now(UNSTATED, bare)
    wrong = [name for name, unit in truly.items() if unit != now[name]]
    words = " and ".join(truly[name] for name in wrong)
    if doubted := [now[name] for name in wrong if stated.of(name) or bare.of(name)]:
        words += f", not {' and '.join(doubted)}"
    # Whole, as the key is replaced in the file: a unit that is right must not get lost.
    kept = {name: stated.of(name) for name in truly}
    kept |= {name: truly[name] if truly[name] != usual[name] else "" for name in wrong}
    leave = f"or leave {in_toml(vars(stated))} out if they are in {words.partition(',')[0]}"
    setting = f"or say {whole}" if (whole := in_toml(kept)) else leave
    return Mistake(words, setting, partial(in_si, truly))


def _moved(order: Sequence[int], now: Mapping[str, str], part: Part) -> Part:
    """Undo a swap that put column `order[at]` at the place of column `at`, in units `now`."""
    moved = Part(part.name, part.share, *(part.values[order.index(k)] for k in range(3)))
    return in_si(now, moved)


def _look_normalised(parts: Sequence[Part]) -> bool:
    """Return whether all values lie in [-1, 1], and one of them is impossible in any unit."""
    values = [value for part in parts for value in part.values if not math.isnan(value)]
    below = any(part.modulus < 0 or part.density < 0 for part in parts)
    strange = any(part.ratio < 0 or part.ratio > 0.5 for part in parts)
    return max(map(abs, values)) <= 1.05 and (below or strange)

"""What people mistake: units, columns, class ids and layouts, undone one by one.

The mistake whose undoing makes implausible values plausible is likely the one that was made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import permutations, product
from typing import NamedTuple

from slatprep.readers.plausible import LIGHTEST, Part, fault_of, is_usual
from slatprep.records import FACTORS, LOG10, Units


class Mistake(NamedTuple):
    """Something that people mistake: in words, the setting that mends it, and how it is undone."""

    words: str
    setting: str
    undo: Callable[[Part], Part]


def mistakes_of(parts: Sequence[Part], units: Units) -> list[Mistake]:
    """Return the mistakes that explain implausible values, the likeliest first."""
    if _look_normalised(parts):
        setting = "channels first where the values are a prediction, normalised to [-1, 1]"
        return [Mistake("normalised ones", setting, lambda part: part)]
    whole = sum(part.share for part in parts)
    found = []
    for order, mistake in enumerate(_known_mistakes(parts, units)):
        undone = [mistake.undo(part) for part in parts]
        good = sum(part.share for part in undone if not fault_of(part))
        if good >= 0.9 * whole:
            usual = sum(part.share for part in undone if is_usual(part))
            found.append((-round(usual / whole, 1), order, mistake))
    found.sort(key=lambda one: one[:2])
    best = found[0][0] if found else 0.0
    return [mistake for usual, _, mistake in found if usual <= best + 0.25]


def _known_mistakes(parts: Sequence[Part], units: Units) -> Iterator[Mistake]:
    """Yield what people mistake: units of one or both columns, ids of classes, and columns."""
    named = {"youngs_modulus": ("GPa", "MPa", "kPa", f"{LOG10}Pa"),
             "density": ("g/cm^3", f"{LOG10}kg/m^3")}  # fmt: skip
    lacking = [name for name, k in (("youngs_modulus", 0), ("density", 1))
               if all(math.isnan(part.values[k]) for part in parts)]  # fmt: skip
    modulus, density = (
        [""] if units.of(name) or name in lacking else ["", *known] for name, known in named.items()
    )
    # Both as logarithms is likelier than a unit for each.
    pairs = sorted(
        product(modulus, density),
        key=lambda pair: (sum(map(bool, pair)), not all(one.startswith(LOG10) for one in pair)),
    )
    for pair in pairs[1:]:
        chosen = dict(zip(named, pair, strict=True))
        given = ", ".join(f'{name} = "{unit}"' for name, unit in chosen.items() if unit)
        words = " and ".join(unit for unit in pair if unit)
        setting = f"or say units = {{ {given} }} in [pixieverse] of the dataset definition"
        yield Mistake(words, setting, partial(_scaled, pair))
    if {part.name for part in parts} & LIGHTEST.keys():
        yield Mistake(
            "classes of PhysGaussian's table, where 3 is foam, 4 is snow and 5 is plasticine",
            "class ids 0 jelly, 1 metal, 2 sand, 3 visplas, 4 fluid, 5 snow, 6 stationary",
            lambda part: part._replace(name=""),
        )
    names = "Young's modulus", "density", "Poisson's ratio"
    for order in list(permutations(range(3)))[1:]:
        if any(math.isnan(part.values[k]) for part in parts for k in range(3)):
            break
        moved = [f"{names[k]} where {names[at]} belongs" for at, k in enumerate(order) if at != k]
        yield Mistake(
            f"swapped columns, {' and '.join(moved)}", "look at the order", partial(_moved, order)
        )


def _scaled(units: tuple[str, str], part: Part) -> Part:
    """Bring modulus and density from these units to SI units."""
    modulus, density = units
    return part._replace(modulus=_si(part.modulus, modulus), density=_si(part.density, density))


def _si(value: float, unit: str) -> float:
    if not unit:
        return value
    if unit.startswith(LOG10):
        return float(10.0**value) if -10 < value < 20 else math.inf
    return value * FACTORS[unit]


def _moved(order: Sequence[int], part: Part) -> Part:
    """Undo that column `order[at]` lies where column `at` belongs."""
    values = [0.0, 0.0, 0.0]
    for at, k in enumerate(order):
        values[k] = part.values[at]
    return Part(part.name, part.share, *values)


def _look_normalised(parts: Sequence[Part]) -> bool:
    """Whether all columns lie in [-1, 1] and one where no unit would bring it there."""
    values = [value for part in parts for value in part.values if not math.isnan(value)]
    below = any(part.modulus < 0 or part.density < 0 for part in parts)
    strange = any(part.ratio < 0 or part.ratio > 0.5 for part in parts)
    return max(map(abs, values)) <= 1.05 and (below or strange)

"""Compare a source's values with the values of known materials before they are used.

The medians of each class are compared, so that stray voxels do not matter. If no material has
such medians, a message names the likeliest mistake.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep import records
from slatprep.errors import InputError
from slatprep.readers.plausible import (
    EXTENTS,
    UNSTATED,
    Part,
    beyond_all,
    fault_of,
    in_si,
    in_toml,
    is_physical,
    mistakes_of,
    oddity_of,
    units_now,
)
from slatprep.records import PROPERTIES, Place, Property, SourceRoots, Units, oddity, to_si

_GUESS = re.compile(r"the values look like (.+?)(?: \(or |: )")

_PREDICTED = 1.5
"""Largest median magnitude of a prediction's values; log10 of most densities is above it."""

FOR_ALL = (
    "Such keys stand in {} of the dataset definition (a TOML file given with --config) and hold "
    "for all objects: where this one alone is so, mend its file"
)
"""End of a message that names a key of a table of the dataset definition."""

_SAMPLE = 1024
"""Least size of a sample of many voxels: enough for medians, which take a tenth of a ms."""

_GOLDEN = (5**0.5 - 1) / 2
"""The golden ratio, whose multiples lie evenly in 0..1 and fit no period."""

_SHARE = 0.5
"""Share of implausible voxels at which an asset is implausible."""

_FEW = 0.05
"""Smallest share of the voxels at which a class counts."""


def require_plausible(
    where: str | Place,
    values: NDArray[np.floating],
    material: NDArray[Any] | None,
    table: Sequence[Property],
    roots: SourceRoots,
    bare: Units = UNSTATED,
) -> list[str]:
    """Convert values (K, P) to SI units in place; compare them, by class (K,), with materials.

    `roots` name the classes and state the units of the values; `bare` are the units of what they do
    not state, SI by default. An SI unit in `bare` is one that the file itself states, and no
    setting is advised for it. Returns warnings; raises `InputError` if most voxels are implausible
    and `roots.plausibility` is ``refuse``. Checking for NaN and other invalid values is left to the
    reader.
    """
    now = units_now(roots.units, bare)
    checked = roots.plausibility != "off" and len(values) > 0
    read = _parts(values, material, table, roots.contents.classes) if checked else []
    for column, one in enumerate(table):
        if (unit := now.get(one.name, one.unit)) != one.unit:
            with np.errstate(over="ignore"):
                values[:, column] = to_si(values[:, column], unit)
    parts = [in_si(now, part) for part in read]
    faults = [(part, fault) for part in parts if (fault := fault_of(part, roots.units))]
    if not faults:
        odd = [(part, told) for part in parts if (told := oddity_of(part, roots.units))]
        unusual = [oddity("values", f"{_named(part)} has {told}") for part, told in odd]
        return unusual + (_strays(values, table) if checked else [])
    share = sum(part.share for part, _ in faults)
    (part, fault), *_ = sorted(faults, key=lambda one: -one[0].share)
    stated = in_toml(vars(roots.units))
    name = f"with {stated} {_named(part)}" if stated else _named(part)
    if share < _SHARE:
        return [oddity("values", f"{name} ({share:.0%} of the voxels) has {fault}")]
    likely = mistakes_of(read, roots.units, bare)
    if not likely and not is_physical(part):
        return []  # The reader refuses it, and names the voxel.
    what = f"{name} has {fault}"
    own = [now[one.name] if bare.of(one.name) != one.unit else "the file's own unit"
           for one in table if one.unit != "1" and one.name in now]  # fmt: skip
    in_units = " and ".join(dict.fromkeys(own)) if {*own} - {"Pa", "kg/m^3"} else "SI units"
    advice = f"values that a material has, in {in_units}"
    if likely:
        others = [one.words for one in likely[1:4]]
        guess = likely[0].words + (f" (or {', or '.join(others)})" if others else "")
        what = f"the values look like {guess}: {what}"
        check = "check which guess is right; " if others else ""
        advice = f"{in_units}, in the documented order; {check}{likely[0].setting}"
    if roots.plausibility == "warn":
        return [oddity("values", f'{what}; taken as they are (plausibility = "warn")')]
    keys = FOR_ALL.format(records.table_of(roots.number))
    raise InputError(where, what, f'{advice}; or set plausibility = "warn". {keys}')


def guess_in(reason: str) -> str:
    """Return the mistake that `require_plausible` guesses in its message; empty if it has none."""
    found = _GUESS.search(reason)
    return found[1] if found else ""


def require_prediction(
    where: str | Place, values: NDArray[Any], material: NDArray[Any], plausibility: str = ""
) -> list[str]:
    """Check that normalised values (K, 3) with classes (K,) look like a network's prediction.

    Values may leave [-1, 1], but not in most voxels; otherwise like `require_plausible`.
    If `plausibility` is empty, other values are refused.
    """
    if plausibility == "off" or len(values) == 0:
        return []
    sample = values[_sampled(len(values))].astype(np.float64)
    medians = np.median(np.abs(sample), axis=0)
    if not (medians > _PREDICTED).any():
        return []
    parts = _parts(values, material, PROPERTIES, records.MATERIAL_CLASSES)
    guesses: list[str] = []
    if all(part.modulus > 0 and part.density > 0 for part in parts):
        guesses = [one.words for one in mistakes_of(parts)]
        if not any(map(fault_of, parts)):
            guesses.insert(0, "a raw grid in SI units, channels first")
    worst = int(np.argmax(medians))
    low, high = np.percentile(sample[:, worst], (5, 95)).tolist()
    what = (
        f"has {PROPERTIES[worst].title} from {low:.4g} to {high:.4g}, and a prediction, channels "
        "first, is normalised to [-1, 1]"
    )
    if guesses:
        what = f"{what}; the values look like {guesses[0]}"
    if plausibility == "warn":
        return [oddity("values", f'{what}; clipped (plausibility = "warn")')]
    advice = "a grid in SI units, channels last (numpy.moveaxis(grid, 0, -1)), or a prediction"
    setting = '. plausibility = "warn" clips the values of all objects' if plausibility else ""
    raise InputError(where, what, advice + setting)


def require_possible(where: str | Place, values: NDArray[Any], material: NDArray[Any]) -> None:
    """Refuse predicted values (K, 3) in SI units if most are outside the range of all materials.

    Other implausible values are measured: they are errors of the method.
    """
    parts = [part for part in _parts(values, material, PROPERTIES, records.MATERIAL_CLASSES)
             if part.name != records.MATERIAL_CLASSES[records.BACKGROUND]]  # fmt: skip
    faults = [(part, fault) for part in parts if (fault := beyond_all(part))]
    if not faults or sum(part.share for part, _ in faults) < _SHARE:
        return
    part, fault = faults[0]
    guess = next((f"the values look like {one.words}: " for one in mistakes_of(parts)), "")
    raise InputError(where, f"{guess}{_named(part)} has {fault}", "values in SI units")


def _sampled(count: int) -> NDArray[np.intp]:
    """Return rows that stand for so many: all of few, else `_SAMPLE` that lie evenly.

    Voxels are in the order of the grid, so that a whole step could take all from one layer.
    """
    if count < 2 * _SAMPLE:
        return np.arange(count)
    return (np.arange(_SAMPLE) * _GOLDEN % 1.0 * count).astype(np.intp)


def _parts(
    values: NDArray[np.floating],
    material: NDArray[Any] | None,
    table: Sequence[Property],
    classes: Sequence[str],
) -> list[Part]:
    """Return the medians of each class in a sample of voxels, without classes below `_FEW`."""
    chosen = _sampled(len(values))
    own = _known(values[chosen], table)
    ids = np.full(len(own), -1) if material is None else material[chosen].astype(int)
    if np.unique(ids, return_counts=True)[1].max() < _FEW * len(ids):
        ids[:] = -1  # No class counts alone among so many: compare the object as a whole.
    parts = []
    for k in np.unique(ids):
        rows = own[ids == k]
        share = len(rows) / len(own)
        if share < _FEW:
            continue
        middle = len(rows) // 2
        medians = np.partition(rows, middle, axis=0)[middle].tolist()
        name = classes[k] if 0 <= k < len(classes) else ""
        parts.append(Part(name, share, *medians))
    return parts


def _known(values: NDArray[np.floating], table: Sequence[Property]) -> NDArray[np.float64]:
    """Return the columns `PROPERTIES` (K, 3) of values (K, P), NaN where the table lacks one."""
    columns = {one.name: k for k, one in enumerate(table)}
    own = np.full((len(values), len(PROPERTIES)), np.nan)
    for k, known in enumerate(PROPERTIES):
        if known.name in columns:
            own[:, k] = values[:, columns[known.name]]
    return own


def _strays(values: NDArray[np.float32], table: Sequence[Property]) -> list[str]:
    """Warn of moduli and densities that no material has, as of parts in another unit."""
    own = _known(values[_sampled(len(values))], table)
    told = []
    for one, (least, most), column in zip(PROPERTIES[:2], EXTENTS, own.T, strict=False):
        # Others are unphysical, which the reader tells.
        stray = column[(column > 0) & np.isfinite(column) & ((column < least) | (column > most))]
        if len(stray) >= _FEW * len(column):
            known = f"{least:g} to {most:g} {one.unit}"
            share = f"{len(stray) / len(column):.0%} of the voxels have a {one.title}"
            told.append(oddity("values", f"{share} such as {stray[0]:.3g}; materials have {known}"))
    return told


def _named(part: Part) -> str:
    return f"class {part.name}" if part.name else "the object"

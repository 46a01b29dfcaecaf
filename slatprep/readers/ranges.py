"""Ranges of the properties from a file."""

from __future__ import annotations

import json
import math
import tomllib
from typing import TypeGuard

from slatprep.errors import ConfigError
from slatprep.normalize import LOG10
from slatprep.records import PROPERTY_COLUMNS, Normalization, Place, PropertyRange
from slatprep.storage.documents import read_bounded

_MAX_BYTES = 2**20


def read_ranges(path: Place) -> Normalization:
    """Read ranges from a TOML or JSON file.

    The file has one table a property with ``lo`` and ``hi`` in mapped units
    (log10 of Pa and of kg/m^3, plain Poisson's ratio)::

        [youngs_modulus]
        lo = 3.0
        hi = 11.0

    Raises
    ------
    ConfigError
        If the file cannot be read, lacks a property or has an empty range.
    """
    try:
        text = read_bounded(path, _MAX_BYTES).decode()
        table = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot read ranges ({error})") from error
    ranges = []
    for name, log10 in zip(PROPERTY_COLUMNS, LOG10, strict=True):
        entry = table.get(name) if isinstance(table, dict) else None
        lo, hi = (entry.get(k) if isinstance(entry, dict) else None for k in ("lo", "hi"))
        if not _is_number(lo) or not _is_number(hi) or lo >= hi:
            raise ConfigError(
                f"{path}: {name} has lo = {lo!r} and hi = {hi!r}; expected a table [{name}] with "
                f"finite lo < hi{' in log10 of the SI value' if log10 else ''}"
            )
        ranges.append(PropertyRange(name, log10, float(lo), float(hi)))
    return Normalization((ranges[0], ranges[1], ranges[2]), source=path.name)


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and math.isfinite(value)

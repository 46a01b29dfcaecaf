"""Ranges of the properties from a file."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from typing import Any, TypeGuard

import numpy as np

from slatprep.errors import ConfigError
from slatprep.normalize import PIXIE_RANGES, normalization_of
from slatprep.records import (
    PROPERTIES,
    PROPERTY_COLUMNS,
    Normalization,
    Place,
    Property,
    PropertyRange,
)
from slatprep.storage.documents import read_bounded, unique

_MAX_BYTES = 2**20

# Larger than any bound in log10, and small enough that normalising does not overflow.
_MAX_BOUND = 1e6

# Float32, which sources and stores hold, has values of 1e-45 to 3e38.
_MAX_LOG10 = 50.0

# Names of PROPERTY_COLUMNS in Pixie's file.
_PIXIE_WORDS = ("E", "density", "nu")


def read_ranges(path: Place, properties: Sequence[Property] = PROPERTIES) -> Normalization:
    """Read ranges from a TOML or JSON file, or from Pixie's ``normalization_ranges.yaml``.

    The file has a table per property with ``lo`` and ``hi`` in mapped units
    (log10 of Pa and of kg/m^3, plain Poisson's ratio)::

        [youngs_modulus]
        lo = 3.0
        hi = 11.0

    Pixie's file has ``density_p1``, ``density_p99``, ``E_p1``, ``nu_p1`` and so on in the same
    units, as JSON or in lines. Where both percentiles of a property are missing, ``density_min``
    and ``density_max`` and so on are read. ConfigError if the file cannot be read, lacks a property
    or one of two percentiles, or has an empty range or log10 that no float32 has.
    """
    try:
        text = read_bounded(path, _MAX_BYTES).decode()
        if path.suffix in (".yaml", ".yml"):
            table = _of_pixie(text)
        else:
            table = _of_json(text) if path.suffix == ".json" else tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot read ranges ({error})") from error
    ranges = []
    for one in properties:
        name, most = one.name, largest_bound(one)
        entry = table.get(name) if isinstance(table, dict) else None
        lo, hi = (entry.get(k) if isinstance(entry, dict) else None for k in ("lo", "hi"))
        if not _is_number(lo, most) or not _is_number(hi, most) or lo >= hi:
            mapped = ", in log10 of the SI value" if one.log10 else ""
            raise ConfigError(
                f"{path}: {name} has lo = {lo!r} and hi = {hi!r}; expected a table [{name}] with "
                f"lo < hi between {-most:,.0f} and {most:,.0f}{mapped}"
            )
        ranges.append((float(lo), float(hi)))
    return normalization_of(np.array(ranges), path.name, properties)


def largest_bound(one: Property | PropertyRange) -> float:
    """Return the largest magnitude that the bounds of a property may have, in mapped units."""
    return _MAX_LOG10 if one.log10 else _MAX_BOUND


def pixie_ranges(table: Sequence[Property]) -> Normalization:
    """Return Pixie's published ranges of the properties; ConfigError if one has none."""
    published = {one.name: one for one in PIXIE_RANGES.ranges}
    if unknown := [one.name for one in table if one.name not in published]:
        raise ConfigError(
            f"normalize.ranges: Pixie publishes no range of {unknown[0]}; expected 'dataset', or a "
            "file with a range of each property"
        )
    return Normalization(tuple(published[one.name] for one in table), PIXIE_RANGES.source)


def _of_json(text: str) -> Any:
    return json.loads(text, object_pairs_hook=unique)


def _of_pixie(text: str) -> dict[str, dict[str, object]]:
    """Return the tables of Pixie's file, in JSON or simple YAML; ValueError if it is neither.

    A full YAML parser could create objects, and twelve numbers do not need it.
    """
    if text.lstrip().startswith("{"):
        numbers = _of_json(text)
    else:
        lines = (line.partition("#")[0].strip() for line in text.splitlines())
        pairs = (line.partition(":") for line in lines if line not in ("", "---"))
        numbers = unique([(name.strip(), float(value)) for name, _, value in pairs])
    tables = {}
    for name, word in zip(PROPERTY_COLUMNS, _PIXIE_WORDS, strict=True):
        percentiles, limits = (f"{word}_p1", f"{word}_p99"), (f"{word}_min", f"{word}_max")
        given = [key for key in percentiles if key in numbers]
        if len(given) == 1:
            raise ValueError(f"of {' and '.join(percentiles)} only {given[0]} is there")
        lo, hi = map(numbers.get, percentiles if given else limits)
        tables[name] = {"lo": lo, "hi": hi}
    return tables


def _is_number(value: object, most: float) -> TypeGuard[float]:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= most  # NaN is not

"""Ranges of the properties from a file."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from typing import Any, TypeGuard

import numpy as np

from slatprep.errors import ConfigError
from slatprep.normalize import PIXIE_RANGES, normalization_of
from slatprep.records import PROPERTIES, PROPERTY_COLUMNS, Normalization, Place, Property
from slatprep.storage.documents import read_bounded, unique

_MAX_BYTES = 2**20

# Larger than any bound in log10, and small enough that normalising does not overflow.
_MAX_BOUND = 1e6

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
    units, as JSON or in lines. If these are missing, ``density_min``, ``density_max`` and so on
    are read. ConfigError if the file cannot be read, lacks a property or has an empty range.
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
    for name, log10 in ((one.name, one.log10) for one in properties):
        entry = table.get(name) if isinstance(table, dict) else None
        lo, hi = (entry.get(k) if isinstance(entry, dict) else None for k in ("lo", "hi"))
        if not _is_number(lo) or not _is_number(hi) or lo >= hi:
            raise ConfigError(
                f"{path}: {name} has lo = {lo!r} and hi = {hi!r}; expected a table [{name}] with "
                f"finite lo < hi{' in log10 of the SI value' if log10 else ''}"
            )
        ranges.append((float(lo), float(hi)))
    return normalization_of(np.array(ranges), path.name, properties)


def pixie_ranges(table: Sequence[Property]) -> Normalization:
    """Return Pixie's published ranges of the properties; ConfigError if one has none."""
    published = {one.name: one for one in PIXIE_RANGES.ranges}
    unknown = [one.name for one in table if one.name not in published]
    if unknown:
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
    return {
        name: {
            end: numbers.get(f"{word}_{percentile}", numbers.get(f"{word}_{limit}"))
            for end, percentile, limit in (("lo", "p1", "min"), ("hi", "p99", "max"))
        }
        for name, word in zip(PROPERTY_COLUMNS, _PIXIE_WORDS, strict=True)
    }


def _is_number(value: object) -> TypeGuard[float]:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= _MAX_BOUND  # NaN is not

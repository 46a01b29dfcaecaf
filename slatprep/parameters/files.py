"""Dataset definitions: a TOML file and options become `BuildParameters`.

The file has a table for each group of `slatprep.parameters`. Its relative paths start from its own
folder. Options win over the file, and a preset replaces whole groups of the file: ``align`` and
``sample``, and the preset ``paper`` also ``normalize``.
"""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, get_args, get_type_hints

import numpy as np

from slatprep.errors import ConfigError, in_unicode
from slatprep.parameters import (
    CATEGORY,
    NAMED_SPLITS,
    PRESETS,
    AlignParameters,
    BuildParameters,
    SampleParameters,
    is_split_file,
    percentiles_of,
)
from slatprep.storage.documents import read_as
from slatprep.storage.place import place_of, storage_of

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

Overrides = Mapping[str, "Mapping[str, object] | str"]
"""Values that win over the file, nested as the file is: ``{"slat": {"root": ...}}``."""

NAMED_RANGES = ("dataset", "pixie", "percentiles such as p1-p99")
"""Values of `normalize.ranges` besides the path of a file."""

_MOST, _MOST_KEYS = 2**53, 5
"""The largest whole number that every reader of JSON keeps, and the deepest nesting."""

_UNKNOWN_KEY = "unexpected_keyword_argument"

_Group = TypeVar("_Group", AlignParameters, SampleParameters, BuildParameters)

OPTIONS = {
    "pixieverse.root": "--pixieverse",
    "slat.root": "--slat",
    "pixieverse.samples": "--samples",
    "slat.encoder": "--encoder",
    "pairing.map": "--map",
    "normalize.ranges": "--ranges",
    "normalize.objects": "--ranges-of",
    "normalize.split_by": "--split-by",
    "normalize.shares": "--shares",
}
"""Option of the command line for a key of the file."""

_PATHS = (
    "pixieverse.root", "also.root", "slat.root", "slat.encoder", "pairing.map",
    "pairing.categories", "normalize.ranges", "normalize.split_by",
)  # fmt: skip


def load_parameters(
    config: Path | str | None, overrides: Overrides | None = None, preset: str | None = None
) -> BuildParameters:
    """Return the parameters of a build from a dataset definition and options.

    Parameters
    ----------
    config : Path, str or None
        The TOML file; None if options give everything.
    overrides : mapping, optional
        Values that win over the file, nested as the file is. Their paths are
        relative to the working directory.
    preset : str, optional
        One of `slatprep.parameters.PRESETS`. It replaces the align
        and sample groups of the file (``paper`` also normalize), and `overrides` win over it.

    Returns
    -------
    BuildParameters
        Complete and checked; every path in it exists.

    Raises
    ------
    ConfigError
        If the file cannot be read, or a key or value makes no sense. The message names the
        file or option, the key and the value, and what is allowed.
    """
    config = None if config is None else Path(config)
    data = {} if config is None else _read(config)
    if preset is not None:
        if preset not in PRESETS:
            raise ConfigError(f"preset: there is no {preset!r}; allowed: {', '.join(PRESETS)}")
        groups = asdict(PRESETS[preset])
        data |= {group: values for group, values in groups.items() if values is not None}
    origin = _Origin(config, overrides or {})
    for group, values in origin.overrides.items():
        table = data.get(group, {})
        if isinstance(values, Mapping) and not isinstance(table, dict):
            raise ConfigError(f"{origin.of(group)}: {group}: expected a table [{group}]")
        data[group] = table | values if isinstance(values, Mapping) else values
    parameters = _validated(BuildParameters, data, origin)
    _check_paths(parameters, origin)
    return parameters


def checked(kind: type[_Group], given: _Group) -> _Group:
    """Check parameters that were made in Python as those of a file; ConfigError if they fail."""
    if not isinstance(given, kind):
        raise ConfigError(f"parameters are {given!r:.80}; expected those of load_parameters")
    return _validated(kind, asdict(given), _Origin(kind.__name__, {}))


def _validated(kind: type[_Group], data: Mapping[str, Any], origin: _Origin) -> _Group:
    """Make parameters from tables of values; ConfigError if a value makes no sense."""
    # Imported late: pydantic takes a third of a second, too much for `slatprep --help`.
    from pydantic import ValidationError

    for name, table, key in _paths_of(data):
        path = str(table[key])
        if path != in_unicode(path):
            raise ConfigError(
                f"{origin.of(name)}: {name}: {path} is no UTF-8, so that no record can hold it; "
                "rename the folder"
            )
    # Through JSON: strict JSON takes a list for a tuple and a string for a path, as TOML has them,
    # and still refuses "3" and true for 3.0.
    document = json.dumps(data, default=_plain)
    try:
        return read_as(kind, document)
    except ValidationError as error:
        # Only one fault is told: a misspelt key first, because it makes another key missing.
        faults = sorted(error.errors(), key=lambda fault: fault["type"] != _UNKNOWN_KEY)
        raise ConfigError(_explain(faults[0], origin)) from None


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else str(value)


class _Origin(NamedTuple):
    """The origin of values, for error messages."""

    config: Path | str | None
    overrides: Overrides

    def of(self, name: str) -> str:
        """Return the option or the file that gave the value of a key such as ``slat.root``."""
        group, _, key = name.partition(".")
        values = self.overrides.get(group)
        if isinstance(values, Mapping) and key in values:
            return f"option {OPTIONS.get(name, key)}"
        return "options" if self.config is None else str(self.config)


def _read(path: Path) -> dict[str, Any]:
    """Return the content of a file, its paths resolved against its folder."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        fault = next(_faults_in(data), None)
    except tomllib.TOMLDecodeError as error:
        # tomllib's own message ends with the line and column.
        hint = "; texts need quotes" if str(error).startswith("Invalid value") else ""
        raise ConfigError(f"{path}: not valid TOML: {error}{hint}") from error
    except RecursionError:
        raise ConfigError(f"{path}: not valid TOML: nested too deeply") from None
    except (OSError, ValueError) as error:
        reason = str(error).partition(";")[0]
        raise ConfigError(f"{path}: cannot be read as a dataset definition: {reason}") from error
    if fault:
        raise ConfigError(f"{path}: {fault}")
    folder = path.resolve().parent
    for name, table, key in _paths_of(data):
        value = table[key]
        if value == "" and key != "transform":
            raise ConfigError(f"{path}: {name} is empty; expected a path, or no such line")
        if isinstance(value, str) and value and _is_path(key, value):
            try:
                table[key] = str(place_of(value, folder))
            except RuntimeError as error:  # The user of ~user does not exist.
                raise ConfigError(f"{path}: {name}: {value}: {error}") from None
    return data


def _faults_in(value: object, keys: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the faults of values that TOML allows, but file names, JSON or int64 do not."""
    name = ".".join(keys)
    if len(keys) > _MOST_KEYS:
        yield f"{name} ...: nested too deeply; expected a table and its keys"
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _faults_in(inner, (*keys, key))
    elif isinstance(value, list):
        for inner in value:
            yield from _faults_in(inner, (*keys, "[]"))
    elif isinstance(value, str) and "\0" in value:
        yield f"{name}: got {value[:80]!r}; expected a text without NUL"
    elif isinstance(value, int) and abs(value) > _MOST:
        yield f"{name}: got a number of {len(str(value))} digits; expected at most {_MOST}"


def _paths_of(data: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield each given path of `_PATHS`: its name, the table that has it, and its key."""
    for name in _PATHS:
        group, _, key = name.partition(".")
        tables = data.get(group)
        for table in tables if isinstance(tables, list | tuple) else (tables,):
            if isinstance(table, dict) and key in table:
                yield name, table, key


def _is_path(key: str, value: object) -> bool:
    """Return whether the value of an entry of `_PATHS` is a path and not a word."""
    if key == "ranges":
        return value not in NAMED_RANGES and percentiles_of(str(value)) is None
    if key == "encoder":
        return str(value).endswith(".json")
    return key != "split_by" or is_split_file(str(value))


def _explain(error: ErrorDetails, origin: _Origin) -> str:
    """Explain a fault from pydantic in the words of the file."""
    keys = tuple(str(part) for part in error["loc"])
    name = ".".join(keys)
    where = origin.of(name)
    if error["type"] == _UNKNOWN_KEY:
        allowed = _keys_of(keys[:-1])
        close = difflib.get_close_matches(keys[-1], allowed, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        return f"{where}: {name}: unknown key; {hint}allowed: {', '.join(allowed)}"
    if error["type"] in ("missing", "missing_argument"):
        if len(keys) == 1:
            name = f"{name}.root"
        option = OPTIONS.get(name)
        how = f"give {option} or " if option else ""
        group, _, key = name.rpartition(".")
        return f"{where}: {name}: not given; {how}set `{key}` in the table [{group}]"
    expected = error["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    got = f" {name}: got {error['input']!r};" if name else ""  # Else it is of several tables.
    return f"{where}:{got} expected {expected}"


def _keys_of(groups: tuple[str, ...]) -> list[str]:
    """Return the keys that a table of the file may have."""
    owner: Any = BuildParameters
    for group in groups:
        if group.isdecimal():
            continue  # the index in an array of tables
        hint = get_type_hints(owner)[group]
        owner = next((t for t in (hint, *get_args(hint)) if is_dataclass(t)), owner)
    return [field.name for field in fields(owner)]


def _check_paths(parameters: BuildParameters, origin: _Origin) -> None:
    for name, table, key in _paths_of(asdict(parameters)):
        value = table[key]
        if value is None or not _is_path(key, value):
            continue
        try:
            if place_of(value).exists():
                continue
            fault = f"{storage_of(place_of(value)).absent(folders=key == 'root')}; expected a path"
        except OSError as error:
            fault = f"cannot be looked at ({error.strerror}); expected a path"
        words = {"ranges": NAMED_RANGES, "split_by": (*NAMED_SPLITS, f"{CATEGORY}NAME")}.get(key)
        named = f", or one of {', '.join(words)}" if words else ""
        raise ConfigError(f"{origin.of(name)}: {name}: {value} {fault}{named}")

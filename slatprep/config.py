"""Dataset definitions: a TOML file and options become `BuildParameters`.

The file has one table for each group of `slatprep.parameters`. Relative paths
in it are resolved against its own folder. Options win over the file, and a
preset replaces the whole ``align`` and ``sample`` groups of the file.
"""

from __future__ import annotations

import difflib
import json
import tomllib
import types
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, is_dataclass
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from slatprep.errors import ConfigError
from slatprep.parameters import PRESETS, BuildParameters
from slatprep.storage.remote import RemotePath, as_path

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

Overrides = Mapping[str, "Mapping[str, object] | str"]
"""Values that win over the file, nested as the file is: ``{"slat": {"root": ...}}``."""

NAMED_RANGES = ("dataset", "pixie")
"""What `normalize.ranges` may be besides the path of a file."""

_UNKNOWN_KEY = "unexpected_keyword_argument"

_OPTIONS = {
    "pixieverse.root": "--pixieverse",
    "slat.root": "--slat",
    "pairing.map": "--map",
    "normalize.ranges": "--ranges",
}


def load_parameters(
    config: Path | None, overrides: Overrides | None = None, preset: str | None = None
) -> BuildParameters:
    """Return the parameters of a build from a dataset definition and options.

    Parameters
    ----------
    config : Path or None
        The TOML file; None where options say everything.
    overrides : mapping, optional
        Values that win over the file, nested as the file is. Paths in it are
        relative to the working directory.
    preset : str, optional
        Name of one of `slatprep.parameters.PRESETS`; it replaces the align
        and sample groups of the file, and `overrides` win over it.

    Returns
    -------
    BuildParameters
        Complete and checked; every path in it exists.

    Raises
    ------
    ConfigError
        If the file cannot be read, or a key or value makes no sense; the
        message names the file, the line and the key, and what is allowed.
    """
    overrides = overrides or {}
    source = _Source(config, overrides)
    data = source.read()
    if preset is not None:
        if preset not in PRESETS:
            raise ConfigError(f"preset: there is no {preset!r}; allowed: {', '.join(PRESETS)}")
        data |= asdict(PRESETS[preset])
    for group, values in overrides.items():
        if isinstance(values, Mapping):
            table = data.setdefault(group, {})
            if not isinstance(table, dict):
                raise ConfigError(f"{source.where((group,))}: {group}: expected a table [{group}]")
            table.update(values)
        else:
            data[group] = values
    parameters = _validate(data, source)
    _check_limits(parameters, source)
    _check_paths(parameters, source)
    return parameters


class _Source:
    """Where the values come from, for error messages that lead back to them."""

    def __init__(self, path: Path | None, overrides: Overrides) -> None:
        self.path = path
        self.overrides = overrides
        self.text = ""

    def read(self) -> dict[str, Any]:
        if self.path is None:
            return {}
        try:
            self.text = self.path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(
                f"{self.path}: cannot be read as a dataset definition: {error}"
            ) from error
        try:
            data = tomllib.loads(self.text)
        except tomllib.TOMLDecodeError as error:
            # tomllib's own message ends with the line and column.
            raise ConfigError(f"{self.path}: not valid TOML: {error}") from error
        return _resolve_paths(data, self.path.resolve().parent)

    def where(self, keys: tuple[str, ...]) -> str:
        """Name the option, or the file and line, that gave the value of a key."""
        values = self.overrides.get(keys[0]) if keys else None
        if len(keys) > 1 and isinstance(values, Mapping) and keys[1] in values:
            return f"option {_OPTIONS.get('.'.join(keys[:2]), keys[1])}"
        if self.path is None:
            return "options"
        line = line_of(self.text, keys)
        return f"{self.path}:{line}" if line else str(self.path)


def line_of(text: str, keys: tuple[str, ...]) -> int | None:
    r"""Return the line (from 1) of a TOML text that sets a key, or opens its table.

    Examples
    --------
    >>> line_of("name = 'a'\n[align]\nengine = 'x'\n", ("align", "engine"))
    3
    >>> line_of("name = 'a'\n", ("align",)) is None
    True
    """
    table: tuple[str, ...] = ()
    best_length, best_line = 0, None
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith("["):
            table = _split_key(stripped.strip("[").partition("]")[0])
            here = table
        elif "=" in stripped and not stripped.startswith("#"):
            here = table + _split_key(stripped.partition("=")[0])
        else:
            continue
        common = min(len(here), len(keys))
        if common > best_length and here[:common] == keys[:common]:
            best_length, best_line = common, number
    return best_line


def _split_key(key: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in key.split("."))


def _resolve_paths(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the data with every path resolved against the folder of the file."""
    for group, key in (name.split(".") for name in _PATHS):
        table = data.get(group)
        value = table.get(key) if isinstance(table, dict) else None
        if isinstance(value, str) and value and (key != "ranges" or value not in NAMED_RANGES):
            path = as_path(value).expanduser()
            path = path if isinstance(path, RemotePath) else (folder / path).resolve()
            data[group][key] = str(path)
    return data


def _validate(data: dict[str, Any], source: _Source) -> BuildParameters:
    # Late: pydantic takes a third of a second that `slatprep --help` does not have.
    from pydantic import TypeAdapter, ValidationError

    # Through JSON, because strict JSON takes a list for a tuple and a string
    # for a path as TOML has them, and still refuses "3" and true for 3.0.
    adapter = TypeAdapter(BuildParameters)
    try:
        return adapter.validate_json(json.dumps(data, default=str), strict=True)
    except ValidationError as error:
        # One line, one repair: a misspelt key first, for it makes another one missing.
        faults = sorted(error.errors(), key=lambda fault: fault["type"] != _UNKNOWN_KEY)
        raise ConfigError(_explain(faults[0], source)) from None


def _explain(error: ErrorDetails, source: _Source) -> str:
    """Say one fault that pydantic found in the words of the file."""
    keys = tuple(str(part) for part in error["loc"])
    name = ".".join(keys)
    where = source.where(keys)
    if error["type"] == _UNKNOWN_KEY:
        allowed = _keys_of(keys[:-1])
        close = difflib.get_close_matches(keys[-1], allowed, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        return f"{where}: {name}: unknown key; {hint}allowed: {', '.join(allowed)}"
    if error["type"] in ("missing", "missing_argument"):
        if len(keys) == 1:
            name = f"{name}.root"
        option = _OPTIONS.get(name)
        how = f"give {option} or " if option else ""
        group, _, key = name.rpartition(".")
        return f"{where}: {name}: not given; {how}set `{key}` in the table [{group}]"
    expected = error["msg"].removeprefix("Input should be ")
    return f"{where}: {name}: got {error['input']!r}; expected {expected}"


def _keys_of(groups: tuple[str, ...]) -> list[str]:
    """Return the keys that a table of the file may have."""
    owner: Any = BuildParameters
    for group in groups:
        hint = get_type_hints(owner)[group]
        owner = next((t for t in (hint, *get_args(hint)) if is_dataclass(t)), owner)
    return [field.name for field in fields(owner)]


def _above(low: float) -> Callable[[Any], bool]:
    return lambda value: low < value < inf


def _scale_bounds(value: tuple[float, float]) -> bool:
    return 0 < value[0] <= 1 <= value[1] < inf


_PATHS = ("pixieverse.root", "slat.root", "pairing.map", "pairing.categories", "normalize.ranges")

_LIMITS: Mapping[str, tuple[Callable[[Any], bool], str]] = types.MappingProxyType(
    {
        "align.scale_bounds": (_scale_bounds, "two numbers, 0 < low <= 1 <= high"),
        "align.radius": (_above(0), "a number of voxels above 0"),
        "align.icp_radius": (_above(0), "a number of voxels above 0"),
        "align.icp_iterations": (_above(0), "a whole number above 0"),
        "sample.max_distance": (_above(0), "a number of voxels above 0"),
        "sample.vote_width": (_above(0), "a number of voxels above 0"),
        "store.voxel_chunk": (_above(0), "a whole number of rows above 0"),
        "store.voxel_chunks_per_shard": (_above(0), "a whole number above 0"),
        "store.grid_assets_per_shard": (_above(0), "a whole number above 0"),
        "store.compression_level": (lambda value: 0 <= value <= 22, "a whole number from 0 to 22"),
    }
)


def _value(parameters: BuildParameters, name: str) -> Any:
    group, _, key = name.partition(".")
    return getattr(getattr(parameters, group), key)


def _check_limits(parameters: BuildParameters, source: _Source) -> None:
    for name, (allowed, words) in _LIMITS.items():
        value = _value(parameters, name)
        if not allowed(value):
            where = source.where(tuple(name.split(".")))
            raise ConfigError(f"{where}: {name}: got {value}; expected {words}")


def _check_paths(parameters: BuildParameters, source: _Source) -> None:
    for name in _PATHS:
        value = _value(parameters, name)
        if value is None or value in NAMED_RANGES:
            continue
        try:
            there = as_path(value).exists()
        except OSError as error:
            place = source.where(tuple(name.split(".")))
            raise ConfigError(
                f"{place}: {name}: {value} cannot be looked at ({error.strerror})"
            ) from None
        if not there:
            where = source.where(tuple(name.split(".")))
            named = f", or one of {', '.join(NAMED_RANGES)}" if name == "normalize.ranges" else ""
            raise ConfigError(f"{where}: {name}: {value} does not exist; expected a path{named}")

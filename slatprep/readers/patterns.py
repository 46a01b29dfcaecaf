"""Patterns of file and group names: ``{id}``, ``{sample}``, ``{view}`` and ``*``.

A pattern is a relative path; its fields and ``*`` match within one component.
Component by component only the folders that can match are listed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache

from slatprep.errors import ConfigError
from slatprep.records import Place
from slatprep.storage.listing import Listing
from slatprep.storage.place import storage_of

FIELDS = ("id", "sample", "view")

NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]*")
"""What an id or a view may be: one plain path component that is not hidden."""


def list_below(root: Place) -> Listing:
    """Return the names below a root: those of an object store are all asked for here.

    Raises
    ------
    ConfigError
        If it cannot be listed.
    """
    try:
        return storage_of(root).listing()
    except OSError as error:
        raise ConfigError(f"{root}: cannot be listed ({error.strerror})") from None


def find_files(
    names: Listing, pattern: str, known: Mapping[str, str]
) -> Iterator[tuple[dict[str, str], str]]:
    """Find the files below a folder that match a pattern.

    Parameters
    ----------
    names : Listing
        What lies below the folder; `list_below` makes one.
    pattern : str
        Relative path with fields, such as ``{id}/sample_{sample}/material_grid.npy``.
    known : mapping of str to str
        Fields that are settled already; they match their value alone.

    Yields
    ------
    tuple of dict and str
        The fields of a match (names are not checked against `NAME`), and its
        path relative to the folder. In no particular order.

    Raises
    ------
    ConfigError
        If the pattern makes no sense or a folder cannot be listed.
    """
    components = pattern.split("/")
    if pattern.startswith("/") or any(part in ("", ".", "..") for part in components):
        raise ConfigError(
            f"pattern {pattern!r} is not a path below its root; write it relative, without '..'"
        )
    try:
        yield from _walk(names, "", components, dict(known))
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be listed ({error.strerror})") from None


def fill(pattern: str, known: Mapping[str, str]) -> str:
    """Return a pattern with its known fields filled in and a ``*`` for the others."""
    for field in FIELDS:
        pattern = pattern.replace(f"{{{field}}}", known.get(field, "*"))
    return pattern


def component_regex(component: str, known: Mapping[str, str]) -> re.Pattern[str]:
    """Compile one component of a pattern; a field already known matches its value."""
    return _compile(component, tuple(sorted(known.items())) if "{" in component else ())


@lru_cache(maxsize=256)
def _compile(component: str, known: tuple[tuple[str, str], ...]) -> re.Pattern[str]:
    values = dict(known)
    regex = ""
    for part in re.split(r"(\{[^{}]*\}|\*)", component):
        field = part[1:-1]
        if part == "*":
            regex += ".*"
        elif not part.startswith("{"):
            regex += re.escape(part)
        elif field in values:
            regex += re.escape(values[field])
        elif f"(?P<{field}>" in regex:
            regex += f"(?P={field})"
        elif field in FIELDS:
            regex += f"(?P<{field}>.+)"
        else:
            raise ConfigError(
                f"pattern component {component!r} names {part}; "
                f"fields are {', '.join(f'{{{name}}}' for name in FIELDS)}"
            )
    return re.compile(regex, re.DOTALL)


def _walk(
    names: Listing, prefix: str, components: list[str], known: dict[str, str]
) -> Iterator[tuple[dict[str, str], str]]:
    component, rest = components[0], components[1:]
    regex = component_regex(component, known)
    literal = fill(component, known)
    for name in [literal] if "*" not in literal else names.of_folder(prefix):
        match = regex.fullmatch(name)
        if match is None:
            continue
        path = prefix + name
        if rest:
            yield from _walk(names, path + "/", rest, known | match.groupdict())
        elif names.is_file(path):
            yield known | match.groupdict(), path

"""Patterns of file and group names: ``{id}``, ``{sample}``, ``{view}`` and ``*``.

A pattern is a relative path; its fields and ``*`` match within a component.
The search goes component by component and lists only folders that can match.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import lru_cache
from typing import NamedTuple

from slatprep.errors import ConfigError
from slatprep.records import Place
from slatprep.storage.files import Listing
from slatprep.storage.place import storage_of

FIELDS = ("id", "sample", "view")

NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,254}")
"""Form of an id or a view: one plain path component that is not hidden, no longer than file
systems allow."""

ASSET_ID = re.compile(rf"{NAME.pattern}(\.[A-Za-z0-9._-]{{1,255}})?")
"""Form of the id of a row: an id, or an id, a dot, and a view or sample."""

LOOKED_AT = 20
"""Number of folders that are searched for a hint."""

_VARIABLE = re.compile(r"(\{[^{}]*\}|\*)")
_MOST_VARIABLES = 4
"""Most fields and ``*`` in a component: the time of a match grows with this power of a name."""


class Found(NamedTuple):
    """A file that matches a pattern, or a folder on the way that cannot be listed."""

    fields: dict[str, str]
    """Values of the pattern's fields, as far as the path has them."""
    path: str
    """Relative to the root."""
    problem: str = ""
    """Why the folder cannot be listed."""


def list_below(root: Place) -> Listing:
    """Return the names below a root; an object store lists all of them at once.

    Raises ConfigError if the root cannot be listed.
    """
    try:
        return storage_of(root).listing()
    except OSError as error:
        raise ConfigError(f"{root}: cannot be listed ({error.strerror or error})") from None


def find_files(
    names: Listing, pattern: str, known: Mapping[str, str], skip: Collection[str] = ()
) -> Iterator[Found]:
    """Yield the files that match a relative pattern such as ``{id}/{view}.npz``.

    `known` holds fields that are fixed already, `skip` the ids to leave out. The order is
    arbitrary. Broken links are included, so that their reader reports them. `NAME` is not checked.
    ConfigError if the pattern makes no sense or the root cannot be listed.
    """
    components = components_of(pattern)
    # A pattern whose fields are all known needs no search, as for files beside a grid.
    if "*" not in (literal := fill(pattern, known)):
        if names.is_file(literal):
            yield Found(dict(known), literal)
        return
    try:
        yield from _walk(names, "", components, dict(known), skip)
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be listed ({error.strerror})") from None


@lru_cache(maxsize=64)
def components_of(pattern: str) -> tuple[str, ...]:
    """Split a pattern at its slashes; raise ConfigError if it makes no sense."""
    components = tuple(pattern.split("/"))
    if pattern.startswith("/") or any(part in ("", ".", "..") for part in components):
        raise ConfigError(
            f"pattern {pattern!r} is not a path below its root; write it relative, without '..'"
        )
    for component in components:
        variables = _VARIABLE.findall(component)
        if len(variables) > _MOST_VARIABLES:
            raise ConfigError(
                f"pattern component {component!r} has {len(variables)} fields and '*'; "
                f"use at most {_MOST_VARIABLES}"
            )
        names = [part for part in variables if part != "*"]
        for name in names:
            where = f"pattern component {component!r} names {name}"
            if name[1:-1] not in FIELDS:
                known = ", ".join(f"{{{field}}}" for field in FIELDS)
                raise ConfigError(f"{where}; fields are {known}")
            if names.count(name) > 1:
                raise ConfigError(f"{where} twice; name it once")
    return components


def fill(pattern: str, known: Mapping[str, str]) -> str:
    """Return a pattern with known fields filled in, and ``*`` for unknown and empty fields."""
    for field in FIELDS:
        pattern = pattern.replace(f"{{{field}}}", known.get(field) or "*")
    return pattern


def expression_of(component: str, known: Mapping[str, str]) -> re.Pattern[str]:
    """Return the regular expression of a component, with a group for each unknown field.

    A field takes at least one character, ``*`` may take none. If several matches are possible, the
    leftmost takes most: ``{id}_{view}`` splits ``a_b_c`` into ``a_b`` and ``c``.
    """
    forms = {f"{{{field}}}": f"(?P<{field}>.+)" for field in FIELDS} | {"*": ".*"}
    forms |= {f"{{{field}}}": re.escape(value) for field, value in known.items()}
    parts = (forms.get(part, re.escape(part)) for part in _VARIABLE.split(component))
    return re.compile("".join(parts), re.DOTALL)


def _walk(
    names: Listing,
    prefix: str,
    components: tuple[str, ...],
    known: dict[str, str],
    skip: Collection[str],
) -> Iterator[Found]:
    component, rest = components[0], components[1:]
    literal = fill(component, known)
    if "*" not in literal:
        if rest:
            yield from _walk(names, f"{prefix}{literal}/", rest, known, skip)
        elif names.is_file(prefix + literal):
            yield Found(known, prefix + literal)
        return
    try:
        listed = names.of_folder(prefix, folders=bool(rest))
    except OSError as error:
        if not prefix:
            raise
        problem = f"{error.filename}: cannot be listed ({error.strerror})"
        yield Found(known, prefix, problem)
        return
    expression = expression_of(component, known)
    for name in listed:
        if name.startswith("._"):
            continue  # macOS writes these beside files on other systems' disks.
        match = expression.fullmatch(name)
        if match is None or (fields := match.groupdict()).get("id") in skip:
            continue
        if rest:
            yield from _walk(names, f"{prefix}{name}/", rest, known | fields, skip)
        else:
            yield Found(known | fields, prefix + name)


def held_names(files: Collection[str], folders: Collection[str]) -> str:
    """Say what lies directly in a folder, in a few names."""
    names = sorted([*files, *folders])
    more = " and more" if len(names) > 3 else ""
    return f"it holds {', '.join(names[:3]) or 'nothing'}{more}"


def tried_names(patterns: Iterable[str], known: Mapping[str, str]) -> str:
    """Return the names that patterns stand for, made by `fill`, as a text to print."""
    return ", ".join(fill(pattern, known) for pattern in patterns)

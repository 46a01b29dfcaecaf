"""Patterns of file and group names: ``{id}``, ``{sample}``, ``{view}`` and ``*``.

A pattern is a relative path; its fields and ``*`` match within a component.
The search goes component by component and lists only folders that can match.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import lru_cache
from typing import NamedTuple

from slatprep.errors import ConfigError, first_of
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
        names = [part for part in _VARIABLE.findall(component) if part != "*"]
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


def match(component: str, known: Mapping[str, str], name: str) -> dict[str, str] | None:
    """Match a name with a component of a pattern; return its unknown fields, or None if it fails.

    A field takes at least one character, ``*`` may take none. If several matches are possible, the
    leftmost field takes most: ``{id}_{view}`` splits ``a_b_c`` into ``a_b`` and ``c``. Time is
    linear in the name.
    """
    return _fields(*_split(component, known), name)


def _split(component: str, known: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """Return a component's literal texts, known fields filled in, and the fields between them."""
    first, *others = _VARIABLE.split(component)
    texts, variables = [first], list[str]()
    for variable, text in zip(others[::2], others[1::2], strict=True):
        name = variable.strip("{}")
        if name in known:
            texts[-1] += known[name] + text
        else:
            variables.append(name)
            texts.append(text)
    return texts, variables


def _fields(texts: list[str], variables: list[str], name: str) -> dict[str, str] | None:
    """Match a name as `match` does, with a component that is split already."""
    begin, stop = len(texts[0]), len(name) - len(texts[-1])
    if not variables:
        return {} if name == texts[0] else None
    if not (begin <= stop and name.startswith(texts[0]) and name.endswith(texts[-1])):
        return None
    # From last to first, each field takes as little as possible, so that the first takes most.
    fields = {}
    for variable, text in zip(variables[:0:-1], texts[-2:0:-1], strict=True):
        at = name.rfind(text, begin, stop - (variable != "*"))
        if at < 0:
            return None
        fields[variable] = name[at + len(text) : stop]
        stop = at
    fields[variables[0]] = name[begin:stop]
    fields.pop("*", None)
    return fields if all(fields.values()) else None


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
        yield Found(known, prefix, f"{error.filename}: cannot be listed ({error.strerror})")
        return
    texts, variables = _split(component, known)
    for name in listed:
        if name.startswith("._"):
            continue  # macOS writes these beside files on other systems' disks.
        fields = _fields(texts, variables, name)
        if fields is None or fields.get("id") in skip:
            continue
        if rest:
            yield from _walk(names, f"{prefix}{name}/", rest, known | fields, skip)
        else:
            yield Found(known | fields, prefix + name)


def held_names(files: Collection[str], folders: Collection[str]) -> str:
    """Say what lies directly in a folder, in a few names."""
    return f"it holds {first_of(sorted([*files, *folders])) or 'nothing'}"


def tried_names(patterns: Iterable[str], known: Mapping[str, str]) -> str:
    """Return the names that patterns stand for, made by `fill`, as a text to print."""
    return ", ".join(fill(pattern, known) for pattern in patterns)

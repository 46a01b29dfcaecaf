"""Read JSON documents from strangers, with limits on their size and depth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import chain
from typing import TYPE_CHECKING, Any, TypeVar

import orjson

from slatprep.records import Place
from slatprep.storage.place import storage_of

if TYPE_CHECKING:
    from pydantic import TypeAdapter, ValidationError

_Value = TypeVar("_Value")

_FAULTS = 64

MAX_DEPTH = 64
"""Largest number of levels of nested objects and lists; a store's metadata have a dozen."""


def read_bounded(place: Place, limit: int) -> bytes:
    """Read a whole file.

    Raises OSError if it is unreadable or not a regular file, ValueError above `limit` bytes.
    """
    return bounded(storage_of(place).read(limit), limit)


def bounded(data: bytes, limit: int) -> bytes:
    """Return the data of a file, read up to a limit; ValueError if it has more bytes."""
    if len(data) > limit:
        raise ValueError(f"larger than {limit / 2**20:g} MiB")
    return data


def parse_document(data: bytes | str) -> dict[str, Any]:
    """Return a JSON object, as `parse_json` parses it; ValueError if it is something else."""
    document = parse_json(data)
    if not isinstance(document, dict):
        raise ValueError("no JSON object")
    return document


def parse_json(data: bytes | str) -> Any:
    """Return a JSON value in which all text is Unicode.

    Raises ValueError if it is invalid, or nested more deeply than `MAX_DEPTH`.
    """
    document = orjson.loads(data)
    level = [document] if isinstance(document, dict | list) else []
    for _ in range(MAX_DEPTH):
        inner = (value.values() if isinstance(value, dict) else value for value in level)
        level = [value for value in chain.from_iterable(inner) if isinstance(value, dict | list)]
        if not level:
            return document
    raise ValueError(f"nested more deeply than {MAX_DEPTH} levels")


def unique(pairs: Sequence[tuple[str, _Value]]) -> dict[str, _Value]:
    """Return the entries of an object; ValueError if a key occurs twice.

    This is a hook for `json.loads`, which otherwise takes the last value, in files by people.
    """
    entries = dict(pairs)
    if len(entries) < len(pairs):
        name, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"the key {name[:80]!r} occurs twice")
    return entries


def read_document(place: Place, limit: int) -> dict[str, Any]:
    """Read a file that holds one JSON object; see `read_bounded` and `parse_document`."""
    return parse_document(read_bounded(place, limit))


@lru_cache(maxsize=16)
def adapter_of(kind: Any) -> TypeAdapter[Any]:
    """Return the adapter that reads a kind of record and knows its JSON Schema."""
    # Imported late: a command without records saves the third of a second that pydantic takes.
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def read_as(kind: type[_Value], text: bytes | str) -> _Value:
    """Read a record from its JSON; pydantic's ValidationError, a ValueError, if it is invalid."""
    read: _Value = adapter_of(kind).validate_json(text, strict=True)  # type: ignore[arg-type]
    return read


def faults_in(error: ValidationError) -> Iterator[tuple[str, str, str]]:
    """Yield place, message and value of each fault; the value is empty if it is missing."""
    # A stranger's document may have any number of faults.
    found = error.errors(include_url=False)[:_FAULTS]
    for fault in found:
        at = fault["loc"]
        if any(other["loc"][: len(at)] == at != other["loc"] for other in found):
            continue  # A list that is too short only for its faulty item is no second fault.
        value = "" if fault["type"] == "missing" else repr(fault["input"])[:100]
        yield "/".join(map(str, at)), fault["msg"], value


def faults_told(error: ValidationError) -> tuple[str, ...]:
    """Return each fault in words, with its place and value."""
    return tuple(
        f"{place or 'it'}: {message}{value and f', found {value}'}"
        for place, message, value in faults_in(error)
    )

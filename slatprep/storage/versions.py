"""A store on an object store: complete versions of it, and a pointer to the current one.

Below the store's URL lie

- ``current.json``, the pointer, which is replaced in one step;
- ``versions/NAME/``, a store as on a disk, which never changes;
- ``manifests/NAME/``, the records of the build that made this version;
- ``spool/``, the finished assets of the next version while a cluster builds it.

Plain zarr opens a version's own URL.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from slatprep.errors import StoreError
from slatprep.storage.remote import RemotePlace

if TYPE_CHECKING:
    from slatprep.records import Place

POINTER, VERSIONS, MANIFESTS, SPOOL = "current.json", "versions", "manifests", "spool"

BUILDER = "builder"
"""Prefix of the spool's objects that name the process that builds."""

FORMAT = "slatprep-store-pointer"

# Names are checked, because they lead to objects and a stranger may have written the pointer.
_NAME = re.compile(r"[0-9a-f]{16}")
_SPOOLED = re.compile(rf"{BUILDER}-[0-9a-f]{{16}}|[0-9a-f]{{2}}/[0-9a-f]{{64}}\.arrays")
_MAX_POINTER_BYTES = 2**16


@dataclass(frozen=True)
class Pointer:
    """The content of a store's pointer.

    `version` is the name of the version to read. `previous` is the name of the version before,
    which is kept for its readers, or empty. `content` is the SHA-256 in hex over names and content
    of the version's files, `published` the time in UTC.
    """

    version: str
    previous: str
    content: str
    published: str
    format: str = FORMAT
    format_version: int = 1

    def encode(self) -> bytes:
        """Return the content of the pointer's file."""
        return json.dumps(asdict(self), indent=2).encode() + b"\n"

    @classmethod
    def decode(cls, data: bytes) -> Pointer:
        """Read a pointer from bytes; ValueError if they are no pointer or have wrong names."""
        document = json.loads(data)
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise ValueError(f"no {FORMAT}")
        if document.get("format_version") != 1:
            raise ValueError(f"format_version {document.get('format_version')!r}, expected 1")
        version, previous, content, published = (
            str(document.get(name, "")) for name in ("version", "previous", "content", "published")
        )
        pointer = cls(version, previous, content, published)
        for name in (pointer.version, pointer.previous or pointer.version):
            if not is_version_name(name):
                raise ValueError(f"version {name!r}, expected 16 digits 0-9, a-f")
        return pointer


def read_pointer(store: RemotePlace) -> Pointer | None:
    """Read the pointer of a store; return None if it has none.

    Raises OSError if it cannot be reached, StoreError if it is not a pointer.
    """
    try:
        with (store / POINTER).open("rb") as file:
            data = file.read(_MAX_POINTER_BYTES)
    except FileNotFoundError:
        return None
    except PermissionError:
        if not store.protocol.startswith("http"):
            raise
        return None  # Public buckets deny what is not there.
    try:
        return Pointer.decode(data)
    except (ValueError, RecursionError) as error:
        raise StoreError(
            f"{store / POINTER}: names no version of a store ({error}); remove it and build the "
            "store again, or open a version below it by its own URL"
        ) from None


def content_of(digests: Mapping[str, str]) -> str:
    """Return a pointer's `content` for a version, from the SHA-256 of its files by name."""
    lines = "".join(f"{name} {digests[name]}\n" for name in sorted(digests))
    return hashlib.sha256(lines.encode()).hexdigest()


def current_version(store: RemotePlace) -> RemotePlace:
    """Return the place of a store's files: its current version, or the place itself.

    The place may be a store, one of its versions, or a plain copy of a store. StoreError if the
    pointer cannot be reached or read.
    """
    if is_version(store):
        return store
    try:
        pointer = read_pointer(store)
    except OSError as error:
        raise StoreError(f"{store}: cannot be reached ({error.strerror})") from None
    return store / VERSIONS / pointer.version if pointer else store


def is_version(place: Place) -> bool:
    """Return whether a place is a version of a store."""
    return place.parent.name == VERSIONS and is_version_name(place.name)


def new_version(store: RemotePlace) -> RemotePlace:
    """Return the place of a version whose content is not known yet; its name is random."""
    return store / VERSIONS / secrets.token_hex(8)


def is_spooled(name: str) -> bool:
    """Return whether a name is that of a spooled object."""
    return _SPOOLED.fullmatch(name) is not None


def store_name(place: Place) -> str:
    """Return the name of a store, also from one of its versions."""
    return (place.parent.parent if is_version(place) else place.absolute()).name


def is_version_name(name: str) -> bool:
    """Return whether a version may have this name."""
    return _NAME.fullmatch(name) is not None

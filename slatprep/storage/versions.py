"""A store on an object store: whole versions of it, and a pointer to the one to read.

Below the store's URL lie

- ``current.json``, the pointer, which is replaced in one step;
- ``versions/NAME/``, a store as it would lie on a disk, never changed;
- ``manifests/NAME/``, the records of the build that made it;
- ``spool/``, while a cluster builds the next one, the assets that are finished.

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
"""How the names of objects in the spool begin that say who builds."""

FORMAT = "slatprep-store-pointer"

# Names come from whoever wrote the pointer, and lead to objects.
_NAME = re.compile(r"[0-9a-f]{16}")
_SPOOLED = re.compile(rf"{BUILDER}-[0-9a-f]{{16}}|[0-9a-z]{{2}}/(none-)?[0-9a-f]{{32,64}}\.arrays")
_MAX_POINTER_BYTES = 2**16


@dataclass(frozen=True)
class Pointer:
    """What the pointer of a store says.

    Attributes
    ----------
    version : str
        Name of the version to read.
    previous : str
        The one before it, which is kept for those who are reading it; may be empty.
    content : str
        SHA-256 in hex over names and content of the version's files.
    published : str
        When, in UTC.
    """

    version: str
    previous: str
    content: str
    published: str
    format: str = FORMAT
    format_version: int = 1

    def encode(self) -> bytes:
        """Return it as it is written."""
        return json.dumps(asdict(self), indent=2).encode() + b"\n"

    @classmethod
    def decode(cls, data: bytes) -> Pointer:
        """Read it.

        Raises
        ------
        ValueError
            If it is none, or its names are not what they should be.
        """
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
    """Read which version of a store is current; None where there is no pointer.

    Raises
    ------
    OSError
        If it cannot be reached.
    StoreError
        If what is there is no pointer.
    """
    try:
        with (store / POINTER).open("rb") as file:
            data = file.read(_MAX_POINTER_BYTES)
    except FileNotFoundError:
        return None
    try:
        return Pointer.decode(data)
    except (ValueError, RecursionError) as error:
        raise StoreError(
            f"{store / POINTER}: names no version of a store ({error}); remove it and build the "
            "store again, or open a version below it by its own URL"
        ) from None


def content_of(digests: Mapping[str, str]) -> str:
    """Return what a pointer says of the content of a version with files of these SHA-256."""
    lines = "".join(f"{name} {digests[name]}\n" for name in sorted(digests))
    return hashlib.sha256(lines.encode()).hexdigest()


def current_version(store: RemotePlace) -> RemotePlace:
    """Return where the files of a store lie.

    Parameters
    ----------
    store : RemotePlace
        A store, one of its versions, or a store that was copied there as it was.

    Raises
    ------
    StoreError
        If the pointer cannot be reached or is none.
    """
    if is_version(store):
        return store
    try:
        pointer = read_pointer(store)
    except OSError as error:
        raise StoreError(f"{store}: cannot be reached ({error.strerror})") from None
    return store / VERSIONS / pointer.version if pointer else store


def is_version(place: Place) -> bool:
    """Whether a place is that of a version of a store."""
    return place.parent.name == VERSIONS and is_version_name(place.name)


def new_version(store: RemotePlace) -> RemotePlace:
    """Return where a version may be made whose content is not known yet: a name nobody has."""
    return store / VERSIONS / secrets.token_hex(8)


def is_spooled(name: str) -> bool:
    """Whether a build calls an object of the spool so."""
    return _SPOOLED.fullmatch(name) is not None


def store_name(place: Place) -> str:
    """Return the name of a store, or of the one that a place is a version of."""
    return (place.parent.parent if is_version(place) else place.absolute()).name


def is_version_name(name: str) -> bool:
    """Whether a version may be called so."""
    return _NAME.fullmatch(name) is not None

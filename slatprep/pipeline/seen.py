"""What a build has seen of its sources, for the next one: their states, and the keys they gave.

`slatprep.storage.states` says when a state of a source proves that its content is the same. It is
taken as the source is read, and beside it stands the key that the content gave. The file
`NAME` lies beside the records of a build, with a digest of its own; it holds for this machine,
this store and the same code and parameters. Where anything of that is otherwise, the sources are
hashed.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import orjson

from slatprep.errors import InputError
from slatprep.readers.slat import texture_of
from slatprep.records import AssetPair, Place
from slatprep.storage.files import open_regular, private_file
from slatprep.storage.place import storage_of
from slatprep.storage.states import Noted, States, boot_id

NAME = "sources.seen"
"""Of the file, in the folder of the records, or on this machine's disk where those are not."""

_DIGEST, _STATE = 32, 16
"""Bytes of a digest, of which three come before the rows, and of a state."""

_FORMAT = "slatprep-seen-4"
_UNKNOWN = bytes(_STATE)


def read_seen(folder: Path, bound: bytes) -> tuple[dict[bytes, str], bytes]:
    """Read what the last build saw; nothing where no whole file is bound to the same.

    Returns the key of each of the store's assets by the state of its sources, and the state of the
    store's files and records when it was finished; 32 zeros if that state was not known.
    """
    try:
        with open_regular(folder / NAME) as file:
            data = file.read()
    except OSError:
        return {}, b""
    digest, held, store = (data[at : at + _DIGEST] for at in range(0, 3 * _DIGEST, _DIGEST))
    if not store or _digest(data[_DIGEST:]) != digest or held != bound:
        return {}, b""
    keys = {}
    for at in range(3 * _DIGEST, len(data), _STATE + _DIGEST):
        end = at + _STATE
        keys[data[at:end]] = data[end : end + _DIGEST].hex()
    keys.pop(_UNKNOWN, None)
    return keys, store


def write_seen(
    folder: Path, bound: bytes, store: bytes, states: Iterable[bytes], keys: Iterable[bytes]
) -> None:
    """Note the state of the sources of each asset of a store, empty where unknown, and its key.

    The file is written in place: half of one is noticed by its digest, and costs
    the next build some hashing. So does a disk that does not take it.
    """
    rows = b"".join((own or _UNKNOWN) + key for own, key in zip(states, keys, strict=True))
    body = bound + (store or bytes(_DIGEST)) + rows
    try:
        with private_file(folder / NAME) as file:
            file.write(_digest(body) + body)
    except OSError:
        return


def _digest(body: bytes) -> bytes:
    """Return the digest of a file, which one of another form does not have."""
    return hashlib.sha256(_FORMAT.encode() + body).digest()


def bound_to(build_id: str, recipe: str) -> bytes:
    """Return what states hold for: this machine, a build's store, and the recipe of its assets."""
    machine = Path("/etc/machine-id")
    try:
        name = machine.read_text()
    except (OSError, UnicodeDecodeError):
        name = ""
    parts = [_FORMAT, platform.node(), name, build_id, recipe]
    return hashlib.sha256(orjson.dumps(parts)).digest()


def look(pairs: Sequence[AssetPair]) -> dict[str, bytes]:
    """Return the state of each asset's sources as they are, 16 bytes; zeros where none counts."""
    states = States()
    return {
        pair.asset_id: _state_of(pair, lambda file: storage_of(file).state(states))
        for pair in pairs
    }


def as_read(pair: AssetPair, noted: Mapping[str, Noted]) -> bytes:
    """Return the state of an asset's sources as it was noted when they were read; see `look`."""
    state = _state_of(pair, lambda file: noted.get(str(file)))
    # Its reader may have read what `look` does not know of.
    return _UNKNOWN if noted.keys() - {str(file) for file in _files(pair)} else state


def _state_of(pair: AssetPair, state_of: Callable[[Place], Noted]) -> bytes:
    names = (pair.asset_id, pair.object_id, pair.view, pair.category, pair.slat_group,
             str(pair.roots.pixieverse), str(pair.roots.slat),
             *(one.problem for one in pair.annotations))  # fmt: skip
    states: list[object] = [boot_id(), names]
    files = _files(pair)
    for file in files:
        state = state_of(file)
        if state is None:
            return _UNKNOWN
        states.append((str(file), state))
    return hashlib.blake2b(repr(states).encode(), digest_size=16).digest() if files else _UNKNOWN


def _files(pair: AssetPair) -> list[Place]:
    """Return the files of an asset, in an order; none where they cannot be told."""
    try:
        texture = pair.slat and texture_of(pair.slat, pair.roots.contents.latents)
    except InputError:
        return []
    annotated = (place for one in pair.annotations for _, place in one.files)
    return [file for file in (pair.slat, texture, *annotated) if file is not None]

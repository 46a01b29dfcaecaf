"""What the last build saw of its sources and of the store that it left, by the state of files.

`slatprep.storage.states` says when a state of a source proves that its content is the same. It is
taken as the source is read, and beside it stands the key that the content gave. The file
`NAME` lies beside the records of a build, with a digest of its own; it holds for this machine,
this store and the same code and parameters. Where anything of that is otherwise, the sources are
hashed.
"""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import orjson

from slatprep.errors import InputError
from slatprep.readers.slat import texture_of
from slatprep.records import AssetPair, Place
from slatprep.storage.files import open_regular, private_file
from slatprep.storage.place import storage_of
from slatprep.storage.states import Noted, States, boot_id, is_settled, settle

NAME = "sources.seen"
"""Of the file, in the folder of the records, or on this machine's disk where those are not."""

_ROW = np.dtype([("state", "V16"), ("key", "V32")])
_HEAD = 3 * 32
"""Bytes before the rows: three digests."""

_FORMAT = "slatprep-seen-4"
_UNKNOWN = bytes(16)


@dataclass(frozen=True)
class Seen:
    """What the last build saw.

    Attributes
    ----------
    keys : dict of bytes to str
        Keys of the assets of the store by the state of their sources.
    store : bytes
        State of the store's files and records when it was finished; empty if unknown.
    """

    keys: Mapping[bytes, str] = field(default_factory=dict)
    store: bytes = b""


def read_seen(folder: Path, bound: bytes) -> Seen:
    """Read what the last build saw; nothing where no whole file is bound to the same."""
    try:
        with open_regular(folder / NAME) as file:
            data = file.read()
    except OSError:
        return Seen()
    if len(data) < _HEAD or _digest(data[32:]) != data[:32] or data[32:64] != bound:
        return Seen()
    rows = np.frombuffer(data, _ROW, offset=_HEAD)
    keys = zip(rows["state"].tolist(), rows["key"].tolist(), strict=True)
    return Seen({state: key.hex() for state, key in keys if state != _UNKNOWN}, data[64:96])


def write_seen(
    folder: Path, bound: bytes, store: bytes, states: Mapping[str, bytes], keys: Mapping[str, str]
) -> None:
    """Note the state of the sources of each asset of a store, where known, and its key, by id.

    The file is written in place: half of one is noticed by its digest, and costs
    the next build some hashing. So does a disk that does not take it.
    """
    rows = np.zeros(len(keys), _ROW)
    for row, (asset_id, key) in zip(rows, keys.items(), strict=True):
        row["state"], row["key"] = states.get(asset_id, _UNKNOWN), bytes.fromhex(key)
    body = bound + (store or bytes(32)) + rows.tobytes()
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
        state = None if file is None else state_of(file)
        if file is not None and state is None:
            return _UNKNOWN
        states.append((str(file), state))
    return hashlib.blake2b(repr(states).encode(), digest_size=16).digest() if files else _UNKNOWN


def _files(pair: AssetPair) -> list[Place | None]:
    """Return the files of an asset, in an order; none where they cannot be told."""
    try:
        texture = pair.slat and texture_of(pair.slat, pair.roots.contents.latents)
    except InputError:
        return []
    files = [pair.slat, texture]
    for one in pair.annotations:
        files += [one.grid, one.mask, one.bounds, *one.beside, one.transform]
    return files


def store_state(store: Path, records: Iterable[Path], *, wait: bool = False) -> bytes:
    """Return the state of all files of a store and of the records beside it; empty if not trusted.

    With `wait`, for a tenth of a second first, as they have just been written.
    """
    if wait:
        settle()
    digest = hashlib.sha256()
    files = [Path(folder, name) for folder, _, names in os.walk(store) for name in names]
    for file in (*sorted(files), *records):
        try:
            state = file.stat()
        except OSError:
            return b""
        times = state.st_mtime_ns, state.st_ctime_ns
        if not is_settled(*times):
            return b""
        digest.update(repr((str(file), state.st_size, *times, state.st_ino)).encode())
    return digest.digest()

"""What a build has seen of its sources, for the next one: their states, and the keys they gave.

`slatprep.storage.states` says when a state of a source proves that its content is the same. It is
taken as the source is read, and beside it stands the key that the content gave. The file
`NAME` lies beside the records of a build; it holds for this machine, this store and the same code
and parameters. Where anything of that is otherwise, the sources are hashed.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from io import BufferedReader
from pathlib import Path

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.errors import InputError, StoreError
from slatprep.readers.slat import texture_of
from slatprep.records import AssetPair, Place
from slatprep.storage.arrays import ArrayFile, write_arrays
from slatprep.storage.files import open_regular, private_file
from slatprep.storage.place import storage_of
from slatprep.storage.states import Noted, States, boot_id

NAME = "sources.seen"
"""Of the file, in the folder of the records, or on this machine's disk where those are not."""

_FORMAT = "slatprep-seen-5"
_STATE = 16
_UNKNOWN = bytes(_STATE)


def read_seen(folder: Path, bound: bytes) -> tuple[dict[bytes, str], bytes]:
    """Read what the last build saw; nothing where no whole file is bound to the same.

    Returns the key of each of the store's assets by the state of its sources, and the state of the
    store's files and records when it was finished; zeros if that state was not known.
    """
    try:
        with BufferedReader(open_regular(folder / NAME)) as file:
            seen = dict(ArrayFile(file))
        if seen["bound"].tobytes() != bound:
            return {}, b""
        pairs = zip(seen["states"], seen["keys"], strict=True)
        keys = {state.tobytes(): key.tobytes().hex() for state, key in pairs}
        keys.pop(_UNKNOWN, None)
        return keys, seen["store"].tobytes()
    except (OSError, StoreError, LookupError, ValueError):
        return {}, b""


def write_seen(
    folder: Path, bound: bytes, store: bytes, states: Iterable[bytes], keys: NDArray[np.uint8]
) -> None:
    """Note the state of the sources of each asset of a store, empty where unknown, and its key.

    The file is written in place: half of one is noticed by its checksums, and costs
    the next build some hashing. So does a disk that does not take it.
    """
    held = b"".join(own or _UNKNOWN for own in states)
    texts = {"bound": bound, "store": store or bytes(32), "states": held}
    arrays = {name: np.frombuffer(text, np.uint8) for name, text in texts.items()}
    arrays |= {"states": arrays["states"].reshape(-1, _STATE), "keys": keys}
    with suppress(OSError), private_file(folder / NAME) as file:
        write_arrays(file, arrays)


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

"""Keep the states of a build's sources for the next build.

`slatprep.storage.states` says when a state of a source proves that its content is the same. The
state is taken as the source is read; the store has the key that the content gave. The file `NAME`
lies beside the records of a build. It is valid for this machine, this store and the same code and
parameters; otherwise the sources are hashed.
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

from slatprep.errors import InputError, StoreError
from slatprep.readers.slat import texture_of
from slatprep.records import AssetPair, Place
from slatprep.storage.arrays import ArrayFile, write_arrays
from slatprep.storage.files import open_regular, private_file
from slatprep.storage.place import storage_of
from slatprep.storage.states import Noted, States, boot_id, system_text

NAME = "sources.seen"
"""Name of the file, in the records' folder, or on this disk if the records are elsewhere."""

_FORMAT = "slatprep-seen-5"
_STATE = 16
_UNKNOWN = bytes(_STATE)


def read_seen(folder: Path, bound: bytes) -> tuple[set[bytes], bytes]:
    """Read what the last build saw; nothing unless there is a whole file with the same `bound`.

    Return the states of the sources of the store's assets, each of which has its asset's id, and
    the state of the store's files and records when it was finished; zeros if that was not known.
    """
    try:
        with BufferedReader(open_regular(folder / NAME)) as file:
            seen = dict(ArrayFile(file))
        if seen["bound"].tobytes() != bound:
            return set(), b""
        return {state.tobytes() for state in seen["states"]} - {_UNKNOWN}, seen["store"].tobytes()
    except (OSError, StoreError, LookupError, ValueError):
        return set(), b""


def write_seen(folder: Path, bound: bytes, store: bytes, states: Iterable[bytes]) -> None:
    """Write the state of the sources of each asset of a store, empty if unknown.

    The file is written in place. Checksums reveal a partial file, which costs the
    next build some hashing. So does a file that cannot be written.
    """
    held = b"".join(own or _UNKNOWN for own in states)
    texts = {"bound": bound, "store": store or bytes(32), "states": held}
    arrays = {name: np.frombuffer(text, np.uint8) for name, text in texts.items()}
    arrays["states"] = arrays["states"].reshape(-1, _STATE)
    with suppress(OSError), private_file(folder / NAME) as file:
        write_arrays(file, arrays)


def bound_to(build_id: str, recipe: str) -> bytes:
    """Return a digest of this machine, a build's store and its recipe, for which states hold."""
    parts = [_FORMAT, platform.node(), system_text("/etc/machine-id"), build_id, recipe]
    return hashlib.sha256(orjson.dumps(parts)).digest()


def look(pairs: Sequence[AssetPair]) -> dict[str, bytes]:
    """Return the current state of each asset's sources, 16 bytes; zeros if it does not count."""
    states = States()
    return {
        pair.asset_id: _state_of(pair, lambda file: storage_of(file).state(states))
        for pair in pairs
    }


def as_read(pair: AssetPair, noted: Mapping[str, Noted]) -> bytes:
    """Return the state of an asset's sources as noted when they were read; see `look`."""
    state = _state_of(pair, lambda file: noted.get(str(file)))
    # The reader may have read files that `look` does not know.
    return _UNKNOWN if noted.keys() - {str(file) for file in _files(pair)} else state


def _state_of(pair: AssetPair, state_of: Callable[[Place], Noted]) -> bytes:
    names = (pair.asset_id, pair.object_id, pair.view, pair.category, pair.slat_group,
             str(pair.roots.pixieverse), str(pair.roots.slat),
             *(one.problem for one in pair.annotations))  # fmt: skip
    states: list[object] = [boot_id(), names]
    files = _files(pair)
    for file in files:
        if (state := state_of(file)) is None:
            return _UNKNOWN
        states.append((str(file), state))
    return hashlib.blake2b(repr(states).encode(), digest_size=16).digest() if files else _UNKNOWN


def _files(pair: AssetPair) -> list[Place]:
    """Return the files of an asset in a fixed order; none if they are unknown."""
    try:
        texture = pair.slat and texture_of(pair.slat, pair.roots.contents.latents)
    except InputError:
        return []
    annotated = (place for one in pair.annotations for _, place in one.files)
    return [file for file in (pair.slat, texture, *annotated) if file is not None]

"""What a build saw of its sources: whether a file must be hashed again is told by its state.

The state of a file is its size, its times of change, of content and of inode, and its
inode. A file that was written so shortly before it was looked at that a later
change could leave the same times is not trusted, as in git. What was seen lies beside the
records of a build, with a digest of its own; it holds for this machine, this store
and the same code and parameters. Where anything of that is otherwise, the sources are hashed.
"""

from __future__ import annotations

import hashlib
import os
import platform
import stat
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.records import AssetPair, LatentMoments, Place
from slatprep.storage.files import open_regular, private_file
from slatprep.storage.place import storage_of

NAME = "sources.seen"
"""Of the file, in the folder of the records, or on this machine's disk where those are not."""


def _row(properties: int, channels: int) -> np.dtype[Any]:
    """Return the type of a row, for so many properties, and channels of latents."""
    fields = [("state", "V16"), ("key", "V32"), ("extent", "<f8", (properties, 2)),
              ("clipped", "<i8", (properties,)), ("moments", "<f8", (2, channels)),
              ("record", "V32")]  # fmt: skip
    return np.dtype(fields)


_HEAD = 3 * 32 + 4
"""Bytes before the rows: three digests, and numbers of properties and channels."""

_FORMAT = "slatprep-seen-2"
_UNKNOWN = bytes(16)

_FINE_NS, _COARSE_NS = 100_000_000, 2_000_000_000
"""How long before a look a file must have been written. File systems with times in nanoseconds
stamp by the clock's tick, 10 ms at most; where times are rounder, the roughest, FAT, has 2 s."""


class Found(NamedTuple):
    """What a build found of an asset.

    ``extent`` (P, 2) of its properties is NaN where its sources have not been read; ``clipped``
    (P,) are values of its voxels outside the ranges; ``record`` is the SHA-256 of what counts
    of its record in the build's id.
    """

    key: str
    extent: NDArray[np.float64]
    clipped: NDArray[np.int64]
    latents: LatentMoments | None
    record: bytes


@dataclass(frozen=True, eq=False)
class Seen:
    """What the last build saw, and what it found, by the state and by the key of an asset.

    Attributes
    ----------
    rows : ndarray, shape (A,)
        An entry for each asset of the store: ``state`` of its sources, and what `Found` has.
    store : bytes
        State of the store's files and records when it was finished; empty if unknown.
    trusted : bool
        Whether states are of this machine, store, code and parameters.
    """

    rows: NDArray[Any] = field(default_factory=lambda: np.empty(0, _row(1, 1)))
    store: bytes = b""
    trusted: bool = False

    @cached_property
    def _by_state(self) -> dict[bytes, int]:
        return {state: row for row, state in enumerate(self.rows["state"].tolist())}

    @cached_property
    def _by_key(self) -> dict[bytes, int]:
        return {key: row for row, key in enumerate(self.rows["key"].tolist())}

    @cached_property
    def _finite(self) -> dict[str, list[bool]]:
        """Whether all of what the columns say of a row is known."""
        return {
            name: np.isfinite(self.rows[name]).all(axis=(1, 2)).tolist()
            for name in ("extent", "moments")
        }

    def key(self, state: bytes) -> str | None:
        """Return the key of the asset whose sources had this state; None where none had."""
        row = self._by_state.get(state) if self.trusted and state != _UNKNOWN else None
        return None if row is None else self.rows["key"][row].tobytes().hex()

    def found(self, key: str) -> Found | None:
        """Return what was found of an asset from its sources, by its key."""
        number = self._by_key.get(bytes.fromhex(key))
        if number is None:
            return None
        row = self.rows[number]
        if not self._finite["extent"][number]:
            return None
        mean, std = row["moments"].tolist()
        known = self._finite["moments"][number]
        moments = LatentMoments(tuple(mean), tuple(std)) if known else None
        return Found(key, row["extent"], row["clipped"], moments, row["record"].tobytes())


def read_seen(folder: Path, bound: bytes) -> Seen:
    """Read what the last build saw; nothing where there is no such file or it is not whole.

    Parameters
    ----------
    folder : Path
        Where it was kept.
    bound : bytes
        What `bound_to` gives for the existing store.
    """
    try:
        with open_regular(folder / NAME) as file:
            data = file.read()
    except OSError:
        return Seen()
    if len(data) < _HEAD or _digest(data[32:]) != data[:32]:
        return Seen()
    counts = np.frombuffer(data, "<u2", 2, offset=96).tolist()
    rows = np.frombuffer(data, _row(*counts), offset=_HEAD)
    trusted = data[32:64] == bound
    return Seen(rows, data[64:96] if trusted else b"", trusted)


def write_seen(
    folder: Path,
    bound: bytes,
    store: bytes,
    states: Mapping[str, bytes],
    found: Mapping[str, Found],
) -> None:
    """Note what a build saw and found of each asset in its store, by id.

    The file is written in place: half of one is noticed by its digest, and costs
    the next build some hashing. So does a disk that does not take it.
    """
    first = next(iter(found.values()))
    channels = max((len(one.latents.mean) for one in found.values() if one.latents), default=1)
    counts = np.array([len(first.clipped), channels], "<u2")
    rows = np.zeros(len(found), _row(*counts.tolist()))
    rows["moments"] = np.nan
    for row, (asset_id, one) in zip(rows, found.items(), strict=True):
        row["state"], row["key"] = states[asset_id], bytes.fromhex(one.key)
        row["extent"], row["clipped"], row["record"] = one.extent, one.clipped, one.record
        if one.latents is not None:
            row["moments"] = one.latents.mean, one.latents.std
    body = bound + (store or bytes(32)) + counts.tobytes() + rows.tobytes()
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
    """Return the state of each asset's sources, 16 bytes; zeros where it cannot be trusted.

    To be called before the sources are read: what changes them later changes the state.
    """
    return {pair.asset_id: _state_of(pair) for pair in pairs}


def _state_of(pair: AssetPair) -> bytes:
    names = (pair.asset_id, pair.object_id, pair.view, pair.category, pair.slat_group,
             str(pair.roots.pixieverse), str(pair.roots.slat),
             *(one.problem for one in pair.annotations))  # fmt: skip
    states: list[object] = [names]
    files = [pair.slat]
    for one in pair.annotations:
        files += [one.grid, one.mask, one.bounds, one.beside, one.transform]
    for file in files:
        state = None if file is None else _file_state(file)
        if state == ():
            return _UNKNOWN
        states.append(state)
    return hashlib.blake2b(repr(states).encode(), digest_size=16).digest()


def _file_state(file: Place) -> tuple[object, ...]:
    """Return what tells whether a file was changed since; nothing where that cannot be told."""
    if not isinstance(file, Path):
        return storage_of(file).state()
    try:
        state = os.stat(file)  # noqa: PTH116 - half a million times
    except (OSError, ValueError):
        return ()
    newest = max(state.st_mtime_ns, state.st_ctime_ns)
    fine = newest % 1_000_000
    if not stat.S_ISREG(state.st_mode) or (
        newest + (_FINE_NS if fine else _COARSE_NS) > time.time_ns()
    ):
        return ()
    return (str(file), state.st_size, state.st_mtime_ns, state.st_ctime_ns, state.st_ino)


def store_state(store: Path, records: Iterable[Path], *, wait: bool = False) -> bytes:
    """Return the state of all files of a store and of the records beside it; empty if not trusted.

    Parameters
    ----------
    store : Path
        The store.
    records : iterable of Path
        The files beside it.
    wait : bool
        Wait for a tenth of a second, as they have just been written.
    """
    if wait:
        time.sleep(_FINE_NS / 1e9)
    digest = hashlib.sha256()
    files = [Path(folder, name) for folder, _, names in os.walk(store) for name in names]
    for file in (*sorted(files), *records):
        state = _file_state(file)
        if state == ():
            return b""
        digest.update(repr(state).encode())
    return digest.digest()


def known_keys(seen: Seen, states: Mapping[str, bytes]) -> dict[str, str]:
    """Return the keys of the assets whose sources are as they were, by id."""
    keys = ((asset_id, seen.key(state)) for asset_id, state in states.items())
    return {asset_id: key for asset_id, key in keys if key is not None}

"""What is there before a build, by the state of files: a store, and sources that are as they were.

A first build finds nothing, and then nothing here matters. For the next ones,
the state of a file is its size, its times of change, of content and of inode, and its
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
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import orjson

from slatprep.errors import InputError, StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.previous import SourceStore, checked_store, store_there
from slatprep.pipeline.publish import Destination
from slatprep.pipeline.recipe import Recipe
from slatprep.pipeline.rows import NextStore
from slatprep.readers.slat import texture_of
from slatprep.records import AssetPair, Contents, Place
from slatprep.storage.files import open_regular, private_file
from slatprep.storage.place import storage_of
from slatprep.store import Store
from slatprep.store.manifests import BUILD, file_names
from slatprep.workers.local import Jobs

NAME = "sources.seen"
"""Of the file, in the folder of the records, or on this machine's disk where those are not."""

_ROW = np.dtype([("state", "V16"), ("key", "V32")])
_HEAD = 3 * 32
"""Bytes before the rows: three digests."""

_FORMAT = "slatprep-seen-3"
_UNKNOWN = bytes(16)

FINE_NS, COARSE_NS = 100_000_000, 2_000_000_000
"""How long before a look a file must have been written. File systems with times in nanoseconds
stamp by the clock's tick, 10 ms at most; where times are rounder, the roughest, FAT, has 2 s."""


@dataclass(frozen=True, eq=False)
class Before:
    """What is there before a build.

    Attributes
    ----------
    place : Destination
        Where the store lies, and its records.
    recipe : str
        What tells parameters and code.
    pairs : sequence of AssetPair
        The dataset.
    states : mapping of str to bytes
        State of each asset's sources, by id.
    previous : SourceStore or None
        The store that is there. Its files have been read once it is `checked`.
    known : mapping of str to str
        Keys of the assets whose sources are as the last build saw them.
    as_left : bool
        Whether the files of store and records are as the last build left them.
    damaged : tuple of str
        What of the store is not as it was written.
    """

    place: Destination
    recipe: str
    pairs: Sequence[AssetPair]
    states: Mapping[str, bytes]
    previous: SourceStore | None = None
    known: Mapping[str, str] = field(default_factory=dict)
    as_left: bool = False
    damaged: tuple[str, ...] = ()

    @property
    def untouched(self) -> bool:
        """Whether sources, store and records are as the last build left them, and of one set."""
        if self.previous is None or not self.as_left:
            return False
        return len(self.known) == len(self.states) == len(self.previous.store)

    def holds(self, following: NextStore) -> bool:
        """Whether the store that is there is sound, and the one that would be written."""
        return self.previous is not None and not self.damaged and following.same_as(self.previous)

    def standing_files(self, assets: int, taken: Collection[int] | None) -> set[str]:
        """Return the files of lines that need not be looked at, of a store of so many assets.

        They are as the last build left them, and `taken` are the numbers of those whose shard of
        records is the same; None where all are.
        """
        if not self.as_left or self.damaged or self.previous is None:
            return set()
        names, old = file_names(assets), file_names(len(self.previous.store))
        return {
            name
            for number, name in enumerate(names)
            if old[number : number + 1] == [name] and (taken is None or number in taken)
        }

    def checked(self, jobs: Jobs) -> Before:
        """Return it with a store whose records and columns have been compared with their digests.

        So have all other files, unless their states are as they were left, or they lie on an
        object store, which keeps sums of its own.
        """
        if self.previous is None:
            return self
        trusted = self.as_left or storage_of(self.place.store).local is None
        previous, damaged = checked_store(self.place.store, jobs, "asset/" if trusted else "")
        known = {} if damaged else self.known
        return replace(self, previous=previous, damaged=damaged, known=known)

    def note(self, store: Store, manifests: Place) -> None:
        """Write down what was seen of the assets of a store that is in place."""
        bound, state = bound_to(store.about.manifest, self.recipe), b""
        folder, path = storage_of(manifests).local, storage_of(self.place.store).local
        if folder is not None and path is not None:
            state = store_state(path, _files_beside(folder, len(store)), wait=True)
        keys = zip(store.ids, (bytes(key).hex() for key in store.column("key")), strict=True)
        write_seen(_seen_folder(self.place), bound, state, self.states, dict(keys))


def look_back(
    place: Destination,
    pairs: Sequence[AssetPair],
    parameters: BuildParameters,
    recipe: Recipe,
    declared: Contents,
    fresh: bool = False,
    rehash: bool = False,
) -> Before:
    """Look at the sources, the store and what the last build saw; with `rehash` trust none of it.

    With `fresh` it is as if there were no store.
    """
    own = parameters.pixieverse
    asked = (declared, parameters.slat, parameters.also, own.units, own.plausibility)
    key = recipe.key("", {"": str(asked)})
    before = Before(place, key, pairs, look(pairs))
    previous = None if fresh else store_there(place.store)
    if previous is None:
        # One that cannot be opened is told of when it is checked.
        damaged = () if fresh else checked_store(place.store, 1)[1]
        return replace(before, damaged=damaged)
    seen = read_seen(_seen_folder(place), bound_to(previous.build_id, key))
    keys = ((asset_id, seen.keys.get(state)) for asset_id, state in before.states.items())
    known = {} if rehash else {asset_id: key for asset_id, key in keys if key is not None}
    return replace(
        before, previous=previous, known=known, as_left=_is_as_left(previous, place, seen.store)
    )


def _is_as_left(previous: SourceStore, place: Destination, state: bytes) -> bool:
    folder, path = storage_of(place.manifests()).local, storage_of(place.store).local
    if folder is None or path is None or state in (b"", bytes(32)):
        return False
    try:
        return store_state(path, _files_beside(folder, len(previous.store))) == state
    except StoreError:  # Damaged: how many rows there are is not known.
        return False


def _files_beside(folder: Path, assets: int) -> list[Path]:
    return [folder / name for name in (*file_names(assets), BUILD)]


def _seen_folder(place: Destination) -> Path:
    """Return where it is kept what a build saw: with the records, if those are on the disk."""
    folder = storage_of(place.manifests()).local
    return folder or storage_of(place.store).work_folder().parent


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
    """Note the state of the sources of each asset of a store, and its key, by id.

    The file is written in place: half of one is noticed by its digest, and costs
    the next build some hashing. So does a disk that does not take it.
    """
    rows = np.zeros(len(keys), _ROW)
    for row, (asset_id, key) in zip(rows, keys.items(), strict=True):
        row["state"], row["key"] = states[asset_id], bytes.fromhex(key)
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
    """Return the state of each asset's sources, 16 bytes; zeros where it cannot be trusted.

    To be called before the sources are read: what changes them later changes the state.
    """
    return {pair.asset_id: _state_of(pair) for pair in pairs}


def _state_of(pair: AssetPair) -> bytes:
    names = (pair.asset_id, pair.object_id, pair.view, pair.category, pair.slat_group,
             str(pair.roots.pixieverse), str(pair.roots.slat),
             *(one.problem for one in pair.annotations))  # fmt: skip
    states: list[object] = [names]
    try:
        files = [pair.slat, pair.slat and texture_of(pair.slat, pair.roots.contents.latents)]
    except InputError:
        return _UNKNOWN
    for one in pair.annotations:
        files += [one.grid, one.mask, one.bounds, *one.beside, one.transform]
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
        newest + (FINE_NS if fine else COARSE_NS) > time.time_ns()
    ):
        return ()
    return (str(file), state.st_size, state.st_mtime_ns, state.st_ctime_ns, state.st_ino)


def store_state(store: Path, records: Iterable[Path], *, wait: bool = False) -> bytes:
    """Return the state of all files of a store and of the records beside it; empty if not trusted.

    With `wait`, for a tenth of a second first, as they have just been written.
    """
    if wait:
        time.sleep(FINE_NS / 1e9)
    digest = hashlib.sha256()
    files = [Path(folder, name) for folder, _, names in os.walk(store) for name in names]
    for file in (*sorted(files), *records):
        state = _file_state(file)
        if state == ():
            return b""
        digest.update(repr(state).encode())
    return digest.digest()

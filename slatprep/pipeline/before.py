"""What is there before a build: a store, and sources that are as they were.

Sources are as they were by the state of their files. Of those, each build hashes a share all the
same, drawn anew. Where one of them is another one, no state is trusted.

`slatprep.storage.states` says when a state of a source proves that its content is the same. It is
taken as the source is read, and beside it stands the key that the content gave. The file
`NAME` lies beside the records of a build, with a digest of its own; it holds for this machine,
this store and the same code and parameters. Where anything of that is otherwise, the sources are
hashed.
"""

from __future__ import annotations

import hashlib
import math
import os
import platform
import random
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import orjson

from slatprep.errors import InputError, SlatprepError, StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.publish import Destination
from slatprep.pipeline.recipe import Recipe
from slatprep.pipeline.rows import NextStore, SourceStore, checked_store, store_there
from slatprep.readers import hash_sources
from slatprep.readers.slat import texture_of
from slatprep.records import AssetPair, Contents, Place
from slatprep.storage.files import open_regular, private_file
from slatprep.storage.place import storage_of
from slatprep.storage.states import Noted, States, boot_id, is_settled, settle
from slatprep.store import Store
from slatprep.store.records import BUILD, file_names
from slatprep.workers.local import Jobs, run_unordered

SHARE = 0.01
"""Share of the sources whose state is as it was that a build hashes all the same."""

NAME = "sources.seen"
"""Of the file, in the folder of the records, or on this machine's disk where those are not."""

_ROW = np.dtype([("state", "V16"), ("key", "V32")])
_HEAD = 3 * 32
"""Bytes before the rows: three digests."""

_FORMAT = "slatprep-seen-4"
_UNKNOWN = bytes(16)


@dataclass(frozen=True, eq=False)
class Before:
    """What is there before a build.

    Attributes
    ----------
    place : Destination
        Where the store lies, and its records.
    recipe : Recipe
        Parameters and code.
    asked : str
        What tells them, and how sources are read.
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
    unnoticed : tuple of str
        Ids of assets whose sources are other ones, though their states are as they were.
    seed : int or None
        What the assets were drawn with whose sources were hashed all the same; None if none was.
    """

    place: Destination
    recipe: Recipe
    asked: str
    pairs: Sequence[AssetPair]
    states: Mapping[str, bytes] = field(default_factory=dict)
    previous: SourceStore | None = None
    known: Mapping[str, str] = field(default_factory=dict)
    as_left: bool = False
    damaged: tuple[str, ...] = ()
    unnoticed: tuple[str, ...] = ()
    seed: int | None = None

    @property
    def untouched(self) -> bool:
        """Whether sources, store and records are as the last build left them, and of one set."""
        if self.previous is None or not self.as_left:
            return False
        return len(self.known) == len(self.pairs) == len(self.previous.store)

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

    def sampled(self, share: float, seed: int | None, jobs: Callable[[int], Jobs]) -> Before:
        """Return it after a share of the known sources has been hashed, by the clock if not a seed.

        If one is not as it was, no sources are known. `jobs` says who hashes so many.
        """
        seed = time.time_ns() if seed is None else seed
        ids = sorted(self.known)
        drawn = set(random.Random(seed).sample(ids, math.ceil(share * len(ids))))
        tasks = [(pair, self.recipe) for pair in self.pairs if pair.asset_id in drawn]
        keys = run_unordered(key_of, tasks, jobs(len(tasks)))
        others = tuple(sorted(one for one, key in keys if key != self.known[one]))
        return replace(
            self, known={} if others else self.known, unnoticed=others, seed=seed if drawn else None
        )

    def note(self, store: Store, manifests: Place, read: Mapping[str, bytes]) -> None:
        """Write down what was seen of the assets of a store that is in place.

        `read` has the states of the sources that were read, as they were then.
        """
        bound = bound_to(store.about.manifest, self.asked)
        state = _store_state(self.place, manifests, len(store), wait=True)
        keys = zip(store.ids, (bytes(key).hex() for key in store.column("key")), strict=True)
        states = {asset_id: self.states[asset_id] for asset_id in self.known} | dict(read)
        write_seen(_seen_folder(self.place), bound, state, states, dict(keys))


def look_back(
    place: Destination,
    pairs: Sequence[AssetPair],
    parameters: BuildParameters,
    recipe: Recipe,
    declared: Contents,
    fresh: bool = False,
    rehash: bool = False,
) -> Before:
    """Look at the sources, the store and what the last build saw; with `rehash` not at the sources.

    With `fresh` it is as if there were no store.
    """
    own = parameters.pixieverse
    asked = (declared, parameters.slat, parameters.also, own.units, own.plausibility)
    before = Before(place, recipe, recipe.key("", {"": str(asked)}), pairs)
    previous = None if fresh else store_there(place.store)
    if previous is None:
        # One that cannot be opened is told of when it is checked.
        damaged = () if fresh else checked_store(place.store, 1)[1]
        return replace(before, damaged=damaged)
    seen = read_seen(_seen_folder(place), bound_to(previous.store.about.manifest, before.asked))
    states = {} if rehash or not seen.keys else look(pairs)
    keys = ((asset_id, seen.keys.get(state)) for asset_id, state in states.items())
    return replace(
        before,
        states=states,
        previous=previous,
        known={asset_id: key for asset_id, key in keys if key is not None},
        as_left=_is_as_left(previous, place, seen.store),
    )


def _is_as_left(previous: SourceStore, place: Destination, state: bytes) -> bool:
    if state in (b"", bytes(32)):
        return False
    try:
        return _store_state(place, place.manifests(), len(previous.store)) == state
    except StoreError:  # Damaged: how many rows there are is not known.
        return False


def _store_state(place: Destination, manifests: Place, assets: int, wait: bool = False) -> bytes:
    """Return the state of all files of a store of so many assets and of its records.

    It is empty if not trusted. With `wait`, for a tenth of a second first, as they have just been
    written.
    """
    folder, store = storage_of(manifests).local, storage_of(place.store).local
    if folder is None or store is None:
        return b""
    if wait:
        settle()
    digest = hashlib.sha256()
    files = [Path(found, name) for found, _, names in os.walk(store) for name in names]
    records = (folder / name for name in (*file_names(assets), BUILD))
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


def _seen_folder(place: Destination) -> Path:
    """Return where it is kept what a build saw: with the records, if those are on the disk."""
    folder = storage_of(place.manifests()).local
    return folder or storage_of(place.store).work_folder().parent


def key_of(pair: AssetPair, recipe: Recipe) -> tuple[str, str]:
    """Return an asset's id and the key that its sources give; empty if they cannot be read."""
    try:
        return pair.asset_id, recipe.key(pair.asset_id, hash_sources(pair)[1])
    except SlatprepError:
        return pair.asset_id, ""


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

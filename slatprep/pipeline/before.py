"""The state before a build: an existing store and unchanged sources.

A first build starts without them, and can be understood without this module.

A source counts as unchanged by the state of its files. Each build still hashes a share of the
unchanged sources, drawn anew. If one of them has changed, no state is trusted.
"""

from __future__ import annotations

import hashlib
import math
import os
import random
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from slatprep.errors import ConfigError, SlatprepError, StoreError
from slatprep.pipeline.destination import Destination
from slatprep.pipeline.plan import Crew
from slatprep.pipeline.recipe import Recipe, Wanted
from slatprep.pipeline.rows import NextStore, Row, SourceStore, checked_store
from slatprep.pipeline.seen import bound_to, look, read_seen, write_seen
from slatprep.readers import hash_sources, reading_of
from slatprep.records import AssetPair, Place, SourceRoots
from slatprep.storage.place import storage_of
from slatprep.storage.states import is_old, wait_until_old
from slatprep.store import Store, open_store
from slatprep.store.reader import is_store
from slatprep.store.records import BUILD, file_names
from slatprep.store.shard_reader import UnreachableError
from slatprep.workers.local import Jobs, run_unordered

SHARE = 0.01
"""Share of the sources with an unchanged state that a build hashes nevertheless."""


@dataclass(frozen=True, eq=False)
class Before:
    """The state before a build: as `look_back` finds it, then with a store that was `checked`.

    Attributes
    ----------
    place : Destination
        Place of the store and its records.
    pairs : sequence of AssetPair
        The dataset.
    wanted : Wanted
        What is asked of the build.
    previous : SourceStore or None
        The existing store; once `checked`, None if no build can go on from it.
    known : mapping of str to (bytes, str)
        State and key of the assets whose sources are as the last build saw them.
    built : bool
        Whether a build is known to have made the store, not a subset or join of other stores.
    as_left : bool
        Whether the files of store and records are as the last build left them.
    damaged : tuple of str
        Damaged parts of the store, in words.
    unnoticed : tuple of str
        Ids of assets whose sources changed although their states did not.
    seed : int or None
        Seed of the draw of unchanged sources to hash; None if none was hashed.
    """

    place: Destination
    pairs: Sequence[AssetPair]
    wanted: Wanted
    previous: SourceStore | None = None
    known: Mapping[str, tuple[bytes, str]] = field(default_factory=dict)
    built: bool = False
    as_left: bool = False
    damaged: tuple[str, ...] = ()
    unnoticed: tuple[str, ...] = ()
    seed: int | None = None

    @property
    def suffices(self) -> bool:
        """Whether sources, store and records are as the last build left them, and as asked for."""
        if self.previous is None or not self.as_left:
            return False
        same = len(self.known) == len(self.pairs) == len(self.previous)
        return same and self.wanted.allows(self.previous)

    def holds(self, new: NextStore) -> bool:
        """Return whether the existing store is sound, and equals the one to be written."""
        return self.previous is not None and not self.damaged and new.same_as(self.previous)

    def standing_files(self, assets: int, taken: Collection[int] | None) -> set[str]:
        """Return the files of lines that need not be checked, in a store of `assets` assets.

        They are as the last build left them. `taken` has the numbers of files whose shard of
        records is the same; None means all files.
        """
        if not self.as_left or self.damaged or self.previous is None:
            return set()
        names, old = file_names(assets), file_names(len(self.previous))
        both = enumerate(zip(names, old, strict=False))
        return {name for k, (name, was) in both if name == was and (taken is None or k in taken)}

    def checked(self, jobs: Jobs) -> Before:
        """Compare the records and columns of the store with their digests; add what is damaged.

        All other files are compared too, unless they are as the last build left them, or they lie
        on an object store, which keeps checksums of its own.
        """
        if self.previous is None:
            return self
        trusted = self.as_left or storage_of(self.place.store).local is None
        below = "asset/" if trusted else ""
        previous, damaged = checked_store(self.previous, jobs, below)
        known = {} if damaged else self.known
        return replace(self, previous=previous, damaged=damaged, known=known)

    def note(self, store: Store, rows: Iterable[Row]) -> None:
        """Write the states of the sources of these rows, for a store that is in place."""
        state = _store_state(self.place, self.place.manifests(store.path), len(store), wait=True)
        seen = {row.asset_id: row.seen for row in rows}
        states = [seen.get(asset_id, b"") for asset_id in store.ids]
        write_seen(_seen_folder(self.place), self._bound_to(store), state, states)

    def _bound_to(self, store: Store) -> bytes:
        """Return a digest of this machine, the store and how sources are read, to bind states."""
        wanted, parameters = self.wanted, self.wanted.parameters
        held, slat = wanted.declared, parameters.slat.root
        roots = (
            SourceRoots(
                one.root, slat, held, one.adapter, units=one.units, plausibility=one.plausibility
            )
            for one in (parameters.pixieverse, *parameters.also)
        )
        read = held, parameters.slat, parameters.also, [reading_of(one) for one in roots]
        return bound_to(store.about.manifest, wanted.recipe.key("", {"": str(read)}))

    def _is_as_left(self, previous: SourceStore, state: bytes) -> bool:
        try:
            assets, folder = len(previous), self.place.manifests()
            return any(state) and _store_state(self.place, folder, assets) == state
        except StoreError:  # The store is damaged: its number of rows is not known.
            return False

    def _sampled(self, share: float, seed: int | None, crew: Crew) -> Before:
        """Hash a share of the known sources; if one of them changed, forget all."""
        seed = time.time_ns() if seed is None else seed
        ids = sorted(self.known)
        drawn = set(random.Random(seed).sample(ids, math.ceil(share * len(ids))))
        tasks = [(pair, self.wanted.recipe) for pair in self.pairs if pair.asset_id in drawn]
        keys = run_unordered(key_of, tasks, crew.of(len(tasks)))
        unnoticed = tuple(sorted(one for one, key in keys if key != self.known[one][1]))
        known = {} if unnoticed else self.known
        return replace(self, known=known, unnoticed=unnoticed, seed=seed if drawn else None)


def look_back(
    place: Destination,
    pairs: Sequence[AssetPair],
    wanted: Wanted,
    crew: Crew,
    fresh: bool = False,
    rehash: float = SHARE,
    seed: int | None = None,
) -> Before:
    """Look at the sources, the store and what the last build saw; hash a share of the sources.

    The share is drawn with `seed`, or by the clock. With `fresh`, an existing store is ignored.
    """
    if not 0.0 <= rehash <= 1.0:
        raise ConfigError(f"rehash is {rehash}; expected a share from 0 to 1")
    before = Before(place, pairs, wanted)
    if fresh:
        return before
    try:
        previous = SourceStore(open_store(place.store))
    except UnreachableError:
        raise  # Nothing is aligned anew only because an object store does not answer.
    except StoreError as error:
        return replace(before, damaged=(str(error),) if is_store(place.store) else ())
    seen, state = read_seen(_seen_folder(place), before._bound_to(previous))
    as_left = before._is_as_left(previous, state)
    states = look(pairs) if seen and rehash < 1 else {}
    known: dict[str, tuple[bytes, str]] = {}
    with suppress(StoreError):  # A column is damaged, and `checked` finds it.
        keys = dict(zip(previous.ids, previous.column("key"), strict=True)) if states else {}
        same = [name for name, own in states.items() if own in seen and name in keys]
        known = {name: (states[name], keys[name].tobytes().hex()) for name in same}
    before = replace(before, previous=previous, known=known, built=bool(state), as_left=as_left)
    return before._sampled(rehash, seed, crew)


def _store_state(place: Destination, manifests: Place, assets: int, wait: bool = False) -> bytes:
    """Return the state of all files of a store of `assets` assets and of its records.

    It is empty if it cannot be trusted. With `wait`, wait a tenth of a second first, because the
    files have just been written.
    """
    folder, store = storage_of(manifests).local, storage_of(place.store).local
    if folder is None or store is None:
        return b""
    if wait:
        wait_until_old()
    digest = hashlib.sha256()
    files = [Path(found, name) for found, _, names in os.walk(store) for name in names]
    beside = (folder / name for name in (*file_names(assets), BUILD))
    for file in (*sorted(files), *beside):
        try:
            state = file.stat()
        except OSError:
            return b""
        times = state.st_mtime_ns, state.st_ctime_ns
        if not is_old(*times):
            return b""
        digest.update(repr((str(file), state.st_size, *times, state.st_ino)).encode())
    return digest.digest()


def _seen_folder(place: Destination) -> Path:
    """Return the folder for what a build saw: that of the records, if it is on a local disk."""
    return storage_of(place.manifests()).local or storage_of(place.store).work_folder().parent


def key_of(pair: AssetPair, recipe: Recipe) -> tuple[str, str]:
    """Return an asset's id and the key that its sources give, empty if they cannot be read."""
    try:
        return pair.asset_id, recipe.key(pair.asset_id, hash_sources(pair)[1])
    except SlatprepError:
        return pair.asset_id, ""

"""What is there before a build: a store, and sources that are as they were.

Sources are as they were by the state of their files, see `slatprep.pipeline.seen`. Of those, each
build hashes a share all the same, drawn anew. Where one of them is another one, no state is
trusted.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.plan import key_of
from slatprep.pipeline.previous import SourceStore, checked_store, store_there
from slatprep.pipeline.publish import Destination
from slatprep.pipeline.recipe import Recipe
from slatprep.pipeline.rows import NextStore
from slatprep.pipeline.seen import bound_to, look, read_seen, store_state, write_seen
from slatprep.records import AssetPair, Contents, Place
from slatprep.storage.place import storage_of
from slatprep.store import Store
from slatprep.store.records import BUILD, file_names
from slatprep.workers.local import Jobs, run_unordered

SHARE = 0.01
"""Share of the sources whose state is as it was that a build hashes all the same."""


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
        state = _state_of(self.place, manifests, len(store), wait=True)
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
        return _state_of(place, place.manifests(), len(previous.store)) == state
    except StoreError:  # Damaged: how many rows there are is not known.
        return False


def _state_of(place: Destination, manifests: Place, assets: int, wait: bool = False) -> bytes:
    """Return the state of a store of so many assets and of its records; empty if not trusted."""
    folder, path = storage_of(manifests).local, storage_of(place.store).local
    if folder is None or path is None:
        return b""
    names = (*file_names(assets), BUILD)
    return store_state(path, [folder / name for name in names], wait=wait)


def _seen_folder(place: Destination) -> Path:
    """Return where it is kept what a build saw: with the records, if those are on the disk."""
    folder = storage_of(place.manifests()).local
    return folder or storage_of(place.store).work_folder().parent

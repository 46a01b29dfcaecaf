"""What decoys have told of a store's alignments: the file beside the store, and words for it."""

from __future__ import annotations

import math
import warnings
from contextlib import suppress
from dataclasses import dataclass

import orjson

from slatprep.errors import StoreError, amount
from slatprep.judge.verdict import LEAST_DECOYS, LEAST_TARGETS
from slatprep.pipeline.destination import require_free
from slatprep.records import Engine, Number, Place, Share, Verdict
from slatprep.storage.documents import read_as, read_bounded
from slatprep.storage.place import storage_of
from slatprep.store import Store
from slatprep.store.reader import require_beside
from slatprep.store.records import ERRORS, StoredRecords, manifests_of

ALIKE = 0.2
"""Least share of decoys called good at which objects are too much alike for decoys to tell."""

_MOST_TOLD = 0.5
"""Greatest share of wrong assets that is told where too few decoys are there to measure it."""

LEAST_TOLD = 0.001
"""Least probability of an error that is kept for an asset."""

_MAX_BYTES = 64 * 2**20


@dataclass(frozen=True)
class Decoy:
    """An asset's grid and another asset's SLAT, both by their ids.

    `keys` are the keys of the two assets, without passes. `verdict` is the verdict on the decoy's
    alignment, as for an asset. `evidence` has the alignment's `slatprep.judge.evidence.FIGURES`; it
    is empty before the decoy is aligned.
    """

    grid: str
    slat: str
    keys: tuple[str, str]
    verdict: str = ""
    evidence: tuple[Number, ...] = ()


@dataclass(frozen=True)
class Kept:
    """Number of assets that may be kept at a share of wrong assets, and their least score."""

    rate: float
    assets: int
    score: Number


@dataclass(frozen=True)
class MeasuredErrors:
    """The errors of a store's alignments, as the file `ERRORS` keeps them.

    Attributes
    ----------
    build : str
        Id of the build that was measured.
    seed : int
        Seed of the draw of decoys.
    assets : int
        Number of assets that the store had.
    refitted : bool
        Whether the score was learned on the dataset; else the shipped model gives it.
    wrong_share : float
        Share of all assets that show another object.
    good : int
        Number of assets called good.
    good_wrong : float
        Number of assets called good that show another object.
    wrong_share_range, good_wrong_range : tuple of float
        Intervals that contain these two with a probability of 0.95.
    kept : tuple of Kept
        Assets that may be kept, for each of `RATES`.
    errors : dict of str to float
        Posterior probability that an asset shows another object, by id, if it is at least
        `LEAST_TOLD`.
    edges, targets, counts : tuple
        Histogram of the scores (logarithms of odds): edges, and assets and decoys in between.
    decoys : tuple of Decoy
        The decoys on which the errors were measured.
    """

    build: str
    seed: int
    assets: int
    refitted: bool
    wrong_share: Share
    wrong_share_range: tuple[float, float]
    good: int
    good_wrong: float
    good_wrong_range: tuple[float, float]
    kept: tuple[Kept, ...]
    errors: dict[str, float]
    edges: tuple[float, ...]
    targets: tuple[int, ...]
    counts: tuple[int, ...]
    decoys: tuple[Decoy, ...]

    @property
    def passed(self) -> list[Decoy]:
        """The decoys that are called good."""
        return [one for one in self.decoys if one.verdict == Verdict.GOOD]

    @property
    def alike(self) -> bool:
        """Whether objects are too much alike for decoys to tell."""
        return len(self.passed) >= ALIKE * len(self.decoys)

    @property
    def tells(self) -> bool:
        """Whether decoys tell how many assets, and which, show another object."""
        return self.refitted and not self.alike

    def sentences(self) -> list[str]:
        """Say in words what was measured."""
        low, high = self.good_wrong_range
        shares, count = self.wrong_share_range, amount(len(self.decoys), "decoy")
        if self.alike:
            return [
                f"decoys cannot tell how many of the {self.good:,} called good show another "
                f"object: {len(self.passed):,} of {count} are called good, too, as objects of "
                "this dataset are alike"
            ]
        if self.tells:
            sentences = [
                f"of the {self.good:,} called good about {self.good_wrong:.0f} show another object "
                f"({low:.0f} to {high:.0f}; measured on {count} of this dataset)",
                f"of all {self.assets:,} assets about {self.wrong_share:.1%} show another object "
                f"({shares[0]:.1%} to {shares[1]:.1%})",
            ]
        else:
            likely = (
                f"likely at most {math.ceil(high):,} of the {self.good:,} called good show another "
                f"object, and at most {shares[1]:.1%} of all assets"
            )
            few = (
                f"{count} of {amount(self.assets, 'asset')} are too few to estimate errors: "
                f"{LEAST_TARGETS} objects and decoys of {LEAST_DECOYS} are needed"
            )
            sentences = [likely, few] if shares[1] <= _MOST_TOLD else [few]
        if passed := self.passed:
            pair = f"the grid of {passed[0].grid} with the SLAT of {passed[0].slat}"
            sentences.append(f"called good of {count}: {len(passed):,}, such as {pair}")
        return sentences

    def of_asset(self, asset_id: str) -> str:
        """Say how probable it is that an asset shows another object; valid only if this `tells`."""
        error = self.errors.get(asset_id)
        likely = f"below {LEAST_TOLD:.1%}" if error is None else f"{error:.1%}"
        return f"by the decoys of its dataset, the probability of another object is {likely}"


def why_no_decoys(store: Store) -> str:
    """Say why a store can have no decoys; empty if it can."""
    if count_objects(store) < 2:
        return "decoys need at least two objects, and it has one"
    if str(Engine.KNOWN) in store.column("engine"):
        return "its transforms were given, so decoys of it cannot be aligned"
    return ""


def file_of(store: Place) -> Place:
    """Return the file of a store's errors; ``demo`` and ``demo.zarr`` share a folder."""
    local = storage_of(store).local
    name = "" if local is None else local.resolve().name
    own = name and not name.endswith(".zarr")
    return manifests_of(store) / (f"{name}.{ERRORS}" if own else ERRORS)


def measured_errors(store: Place) -> MeasuredErrors | None:
    """Return the last measurement of a store, perhaps from before an update; None if none."""
    try:
        return read_as(MeasuredErrors, read_bounded(file_of(store), _MAX_BYTES))
    except (OSError, ValueError):
        return None  # The errors are measured anew.


def errors_of(store: Store) -> MeasuredErrors | None:
    """Return the last measurement of a store if any of its decoys is still one, else None."""
    measured = measured_errors(store.path)
    if measured is None or not measured.decoys or measured.build == store.about.manifest:
        return measured
    records = StoredRecords(store)

    def key_of(asset_id: str) -> str:
        with suppress(StoreError):  # It is not there, or damaged.
            return records.of(asset_id).of_first_pass().key
        return ""

    still = any(one.keys == (key_of(one.grid), key_of(one.slat)) for one in measured.decoys)
    # Otherwise another dataset lay at this place, or all assets were aligned with other parameters.
    return measured if still else None


def count_objects(store: Store) -> int:
    """Return the number of a store's objects."""
    return len(set(map(str, store.column("object_id"))))


def told_of(store: Store) -> list[str]:
    """Return sentences on what is known of a store's errors, or on why nothing is known."""
    if (measured := errors_of(store)) is None:
        if reason := why_no_decoys(store):
            return [f"not measured: {reason}"]
        few = count_objects(store) < LEAST_TARGETS
        too = f", and so does a build of {LEAST_TARGETS} objects or more" if few else ""
        return [f"not measured; `slatprep measure-errors` does it{too}"]
    told = measured.sentences()
    if measured.build != store.about.manifest:
        told.append(
            f"measured before the last update, when there were {measured.assets:,} assets; "
            "`slatprep measure-errors` counts them anew"
        )
    return told


def writable_file(store: Place) -> Place:
    """Return `file_of` a store; raise SlatprepError if a file of other origin is there."""
    file = file_of(store)
    if (local := storage_of(file).local) is not None:
        require_beside(local.parent)
        require_free(local, mark=ERRORS)
    return file


def write_errors(store: Store, measured: MeasuredErrors) -> None:
    """Write a measurement beside the store; warn if it cannot be written there."""
    file = writable_file(store.path)
    try:
        with storage_of(file).staged() as path:
            path.write_bytes(orjson.dumps(measured, option=orjson.OPT_INDENT_2) + b"\n")
    except OSError as error:  # It took long, and its reader has it all the same.
        told = f"{file}: what was measured could not be kept ({error.strerror})"
        warnings.warn(told, stacklevel=3)

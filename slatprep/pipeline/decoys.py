"""Measure how many of a store's alignments show another object, on decoys of its own dataset.

A decoy is an asset's grid aligned with the SLAT of another object that is nearest in size. The
draw of grids depends only on a seed and the ids. So an update draws mostly the same decoys as
before, and takes over what was measured on them.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.errors import SlatprepError, StoreError
from slatprep.judge.evidence import FIGURES
from slatprep.judge.verdict import LEAST_DECOYS, LEAST_TARGETS
from slatprep.pipeline.measured import (
    LEAST_TOLD,
    Decoy,
    Kept,
    MeasuredErrors,
    count_objects,
    measured_errors,
    why_no_decoys,
    writable_file,
    write_errors,
)
from slatprep.pipeline.plan import Crew
from slatprep.pipeline.rows import SourceStore, slat_contents
from slatprep.records import Verdict
from slatprep.storage.place import storage_of
from slatprep.store import Store
from slatprep.store.record import StageParameters
from slatprep.store.records import StoredRecords
from slatprep.workers import Progress, counted
from slatprep.workers.local import Jobs, run_unordered

DECOYS = 200
"""Number of decoys of a dataset, which has at most one for each asset."""

EVERY, SPARSELY = 20, 60
"""Number of assets that a build aligns for each decoy: the first up to `LEAST_DECOYS` decoys, the
second as soon as it gives more. A decoy takes three times as long as an asset. So a build of 2,400
assets or more takes 5 % longer, and one of 800 takes 15 %."""

RATES = (0.001, 0.01, 0.05)
"""Shares of wrong assets for which the number of assets that may be kept is computed."""

_TAKEN_OVER = ("refitted", "wrong_share", "wrong_share_range", "good", "good_wrong",
               "good_wrong_range")  # fmt: skip
"""Fields that are copied from `slatprep.judge.decoys.ErrorRates`."""

BINS = 40


def measure_errors(
    store: Store,
    decoys: int = DECOYS,
    seed: int = 0,
    jobs: Jobs = 1,
    progress: Progress | None = None,
    *,
    most_new: int | None = None,
    before: MeasuredErrors | None = None,
) -> MeasuredErrors:
    """Measure the errors of a store's alignments on decoys, without aligning its assets again.

    Parameters
    ----------
    store : Store
        An aligned dataset.
    decoys : int
        Largest number of decoys.
    seed : int
        Seed of their draw.
    jobs : int or Workers
        Worker processes; the result does not depend on it.
    progress : callable, optional
        Called with the number of decoys done, and of decoys to align.
    most_new : int, optional
        Largest number of decoys to align; the others were aligned before.
    before : MeasuredErrors, optional
        Measurement whose decoys are taken over; by default the last one of this store.

    Returns
    -------
    MeasuredErrors
        The result, which is also written to `file_of` the store, or a warning tells why not.

    Raises
    ------
    StoreError
        If the store has fewer than two objects, its transforms were given, or its records have
        no evidence.
    SlatprepError
        If a decoy kills its worker again when it runs alone.
    """
    from slatprep.judge.decoys import error_rates

    if reason := why_no_decoys(store):
        raise StoreError(f"{store.path}: {reason}")
    if (file := storage_of(writable_file(store.path)).local) is not None:
        there = next(one for one in file.parents if one.exists())
        if not os.access(there, os.W_OK):
            raise StoreError(f"{there}: cannot be written to; expected a folder for {file}")
    keys, grids, evidence = _evidence_of(store)
    objects = unrelated_objects(store, grids)
    if not (wanted := draw_decoys(store, keys, objects, decoys, seed)):
        raise StoreError(f"{store.path}: decoys need two objects that share neither grid nor SLAT")
    measured = before or measured_errors(store.path)
    known = {(one.grid, one.slat, one.keys): one for one in measured.decoys} if measured else {}
    found = [known.get((one.grid, one.slat, one.keys), one) for one in wanted]
    missing = [number for number, one in enumerate(found) if not one.evidence][:most_new]
    source = SourceStore(store)
    tasks = ((source, k, wanted[k], source.records.of(wanted[k].grid).parameters) for k in missing)
    results = run_unordered(align_decoy, tasks, jobs, fail_decoy)
    for number, decoy in counted(results, len(missing), progress):
        found[number] = decoy
    made = tuple(one for one in found if one.evidence)
    rates = error_rates(
        evidence,
        np.array([one.evidence for one in made], dtype=np.float64),
        objects,
        [objects[store.find(one.grid)] for one in made],
        good=store.column("verdict") == str(Verdict.GOOD),
        good_decoys=np.array([one.verdict == Verdict.GOOD for one in made]),
        seed=seed,
    )
    both = np.concatenate([rates.scores, rates.decoy_scores])
    edges = np.linspace(both.min(), max(both.max(), both.min() + 1e-6), BINS + 1)
    errors = zip(store.ids, rates.errors.tolist(), strict=True)
    result = MeasuredErrors(
        build=store.about.manifest,
        seed=seed,
        assets=len(store),
        **{name: getattr(rates, name) for name in _TAKEN_OVER},
        kept=tuple(Kept(rate, *rates.kept(rate)) for rate in RATES),
        errors={one: round(error, 6) for one, error in sorted(errors) if error >= LEAST_TOLD},
        edges=tuple(edges.tolist()),
        targets=tuple(np.histogram(rates.scores, edges)[0].tolist()),
        counts=tuple(np.histogram(rates.decoy_scores, edges)[0].tolist()),
        decoys=made,
    )
    write_errors(store, result)
    return result


def measure_build(
    store: Store, aligned: int, most: int, crew: Crew, previous: SourceStore | None
) -> None:
    """Measure the errors of a store that a build has just written, on as many decoys as allowed.

    `aligned` is the number of assets that the build aligned, `most` the largest number of decoys,
    and `previous` the store that was replaced. If no decoy is allowed, the earlier measurement
    stays, and `told_of` says that it is an earlier one.
    """
    measured = measured_errors(store.path) or (measured_errors(previous.path) if previous else None)
    new = min(allowed_decoys(aligned), most)
    if new == 0 or count_objects(store) < LEAST_TARGETS or why_no_decoys(store):
        if measured:
            write_errors(store, measured)
        return
    crew.tell(f"measuring errors on at most {new:,} new decoys")
    # A person may have asked for more decoys before; their number is kept.
    count = max(min(allowed_decoys(len(store)), most), len(measured.decoys) if measured else 0)
    seed, jobs = measured.seed if measured else 0, crew.of(new)
    measure_errors(store, count, seed, jobs, most_new=new, before=measured)


def allowed_decoys(assets: int) -> int:
    """Return how many decoys a build of so many assets may align; see `EVERY`."""
    return max(min(assets // EVERY, LEAST_DECOYS), assets // SPARSELY)


def _evidence_of(store: Store) -> tuple[dict[str, str], list[str], NDArray[np.float64]]:
    """Read the keys of first passes by id, digests of grids by row, and evidence (A, F)."""
    records = StoredRecords(store)
    keys: dict[str, str] = {}
    grids: list[str] = []
    evidence: list[NDArray[np.float64]] = []
    for row, asset_id in enumerate(store.ids):
        # Checking a whole record takes a millisecond, and only these entries are needed.
        try:
            record = orjson.loads(records.text(row))
            # A pass that places an asset anew, or only counts others anew, changes no decoy.
            keys[asset_id] = str((record.get("first_pass") or record)["key"])
            own = (file["sha256"] for file in record["sources"] if file["role"] == "grid")
            grids.append(next(own, ""))
            evidence.append(np.array(record["judgement"]["evidence"], dtype=np.float64))
        except (ValueError, KeyError, TypeError, AttributeError):
            raise StoreError(
                f"{store.path}: the record of {asset_id} cannot be read; run `slatprep verify`"
            ) from None
    if any(one.shape != (len(FIGURES),) for one in evidence):
        raise StoreError(f"{store.path}: its records hold other evidence; build it again")
    return keys, grids, np.array(evidence)


def draw_decoys(
    store: Store, keys: Mapping[str, str], objects: Sequence[str], count: int, seed: int
) -> list[Decoy]:
    """Draw grids by a hash of their ids, and for each another object's SLAT of the nearest size.

    `objects` are those of `unrelated_objects`. Each has one decoy before any has two, and none the
    same other object twice.
    """
    ids, sizes = store.ids, np.diff(store.offsets).tolist()
    by_hash = sorted(range(len(ids)), key=lambda row: _hash(seed, ids[row]))
    # The sort is stable, so assets of equal size are in the order of their hashes.
    by_size = sorted(by_hash, key=sizes.__getitem__)
    place = {row: at for at, row in enumerate(by_size)}
    paired: defaultdict[str, set[str]] = defaultdict(set)
    drawn, every = [], len(set(objects))
    for row in _in_turn(by_hash, objects)[:count]:
        at, taken = place[row], paired[objects[row]] | {objects[row]}
        if len(taken) == every:
            continue  # It has met all others, so the search below would be of all rows.
        sides = range(at - 1, -1, -1), range(at + 1, len(by_size))  # smaller ones, and larger ones
        others = ((by_size[k] for k in own if objects[by_size[k]] not in taken) for own in sides)
        if near := [k for own in others for k in islice(own, 1)]:
            other = min(near, key=lambda k: abs(sizes[k] - sizes[row]))
            paired[objects[row]].add(objects[other])
            drawn.append(Decoy(ids[row], ids[other], (keys[ids[row]], keys[ids[other]])))
    return drawn


def unrelated_objects(store: Store, grids: Sequence[str]) -> list[str]:
    """Return the object of each row; objects that share a SLAT or a grid have the same name.

    `grids` are digests of the rows' grids, empty if they are unknown.
    """
    from scipy.cluster.hierarchy import DisjointSet

    objects = list(map(str, store.column("object_id")))
    related = DisjointSet(objects)
    for contents in (slat_contents(store), grids):
        seen: dict[object, str] = {}
        for content, name in zip(contents, objects, strict=True):
            if content:
                related.merge(seen.setdefault(content, name), name)
    first = {related[name]: name for name in sorted(related, reverse=True)}
    return [first[related[name]] for name in objects]


def _in_turn(rows: Sequence[int], objects: Sequence[str]) -> list[int]:
    """Return rows in rounds, each with the next row of every object."""
    times: Counter[str] = Counter()
    rounds = []
    for row in rows:
        rounds.append(times[objects[row]])
        times[objects[row]] += 1
    return [row for _, row in sorted(zip(rounds, rows, strict=True), key=lambda one: one[0])]


def _hash(seed: int, text: str) -> bytes:
    return hashlib.sha256(f"decoy {seed} {text}".encode()).digest()


def align_decoy(
    store: SourceStore, number: int, decoy: Decoy, parameters: StageParameters
) -> tuple[int, Decoy]:
    """Align and judge a decoy with the parameters of its grid; return it with its number."""
    from slatprep.align import align
    from slatprep.pipeline.annotate import look_up

    field, latents = store.asset(decoy.grid).field, store.asset(decoy.slat).latents
    alignment = align(field, latents, parameters.align)
    _, judgement = look_up(field, latents, alignment, parameters.sample)
    return number, replace(decoy, verdict=str(judgement.verdict), evidence=judgement.evidence)


def fail_decoy(
    store: SourceStore, number: int, decoy: Decoy, parameters: StageParameters
) -> tuple[int, Decoy]:
    """Raise for a decoy that killed its worker twice, the second time when it ran alone."""
    raise SlatprepError(
        f"{store.path}: the decoy of {decoy.grid} with the SLAT of {decoy.slat} killed its worker "
        "process twice, probably because memory ran out"
    )

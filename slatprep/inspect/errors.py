"""How many of a store's alignments show another object, measured on decoys of the dataset itself.

A decoy is an asset's grid aligned with the SLAT of another object, of the size nearest to its
own. Which assets' grids are drawn depends on a seed and their ids alone, so those of an update are
mostly those of before, and what was found of them is taken over.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.records import Place
from slatprep.storage.atomic import staged, writing
from slatprep.store import Store, open_store
from slatprep.store.manifests import manifests_beside
from slatprep.store.records import StoredRecords
from slatprep.workers.local import Jobs, run_unordered

if TYPE_CHECKING:
    from slatprep.judge.decoys import ErrorRates
    from slatprep.store.record import StageParameters

DECOYS = 200
"""Decoys of a dataset, at most one for each asset."""

FILE = "decoys.json"
"""Beside the records of the build."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Decoy:
    """An asset's grid with another one's SLAT.

    Attributes
    ----------
    grid, slat : str
        Ids of the assets.
    keys : tuple of str
        What these two were made from and how.
    evidence : tuple of float
        `slatprep.judge.evidence.FIGURES` of their alignment.
    """

    grid: str
    slat: str
    keys: tuple[str, str]
    evidence: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class MeasuredErrors:
    """The errors of a store's alignments.

    Attributes
    ----------
    rates : ErrorRates
        What the decoys say.
    ids : list of str
        Ids of the assets, in the order of ``rates.scores``.
    seed : int
        Of the draw of decoys.
    aligned : int
        Decoys that were aligned now; the others had been before.
    """

    rates: ErrorRates
    ids: list[str]
    seed: int
    aligned: int

    def sentences(self) -> list[str]:
        """Say in words what was measured."""
        rates, most = self.rates, len(self.ids)
        low, high = rates.good_wrong_range
        share, shares = rates.wrong_share, rates.wrong_share_range
        told = [
            f"of the {rates.good:,} of {most:,} assets whose object and placement are sure, about "
            f"{rates.good_wrong:.0f} show another object ({low:.0f} to {high:.0f}; measured on "
            f"{rates.decoys:,} decoys of this dataset)",
            f"of all {most:,} assets about {share:.1%} show another object "
            f"({shares[0]:.1%} to {shares[1]:.1%})",
        ]
        if not rates.refitted:
            told.append("too few assets or decoys to learn from: the shipped model stands")
        return told


def measure_errors(
    store: Store,
    decoys: int = DECOYS,
    seed: int = 0,
    jobs: Jobs = 1,
    progress: Progress | None = None,
) -> MeasuredErrors:
    """Count the errors of a store's alignments on decoys; none of its assets is aligned again.

    Parameters
    ----------
    store : Store
        An aligned dataset.
    decoys : int
        How many decoys at most.
    seed : int
        Of their draw.
    jobs : int or Workers
        Worker processes; the result does not depend on it.
    progress : callable, optional
        Called with the decoys done and the decoys in all.

    Returns
    -------
    MeasuredErrors

    Raises
    ------
    StoreError
        If the store has fewer than two objects, or its records have no evidence.
    """
    from slatprep.judge.decoys import error_rates

    records = list(StoredRecords(store))
    evidence = [record.judgement.evidence for record in records]
    if not all(evidence):
        raise StoreError(f"{store.path}: its records hold no evidence; build it again")
    keys = {record.asset_id: record.key for record in records}
    wanted = draw_decoys(store, keys, decoys, seed)
    if not wanted:
        raise StoreError(f"{store.path}: decoys need at least two objects, and it has one")
    known = {(one.grid, one.slat, one.keys): one.evidence for one in read_decoys(store)}
    found = [known.get((one.grid, one.slat, one.keys), ()) for one in wanted]
    missing = [k for k, figures in enumerate(found) if not figures]
    how = {record.asset_id: record.parameters for record in records}
    tasks = ((store.path, k, wanted[k], how[wanted[k].grid]) for k in missing)
    for done, (k, figures) in enumerate(run_unordered(align_decoy, tasks, jobs), 1):
        found[k] = figures
        if progress:
            progress(done, len(missing))
    made = [
        Decoy(one.grid, one.slat, one.keys, tuple(figures))
        for one, figures in zip(wanted, found, strict=True)
    ]
    objects = dict(zip(store.ids, map(str, store.column("object_id")), strict=True))
    folds = {asset_id: fold_of(objects[asset_id]) for asset_id in store.ids}
    rates = error_rates(
        np.array(evidence, dtype=np.float64),
        np.array([one.evidence for one in made], dtype=np.float64),
        np.array([folds[record.asset_id] for record in records]),
        np.array([folds[one.grid] for one in made]),
        seed,
    )
    measured = MeasuredErrors(rates, [record.asset_id for record in records], seed, len(missing))
    write_decoys(store, made, seed, measured.sentences())
    return measured


def draw_decoys(store: Store, keys: dict[str, str], count: int, seed: int) -> list[Decoy]:
    """Choose grids by a hash of their ids, and for each the SLAT of the size nearest to its own."""
    ids, objects = store.ids, [str(one) for one in store.column("object_id")]
    sizes = np.diff(store.offsets).tolist()
    by_hash = sorted(range(len(ids)), key=lambda row: _hash(seed, ids[row]))
    # Stable, so that of one size the order is that of the hashes.
    by_size = sorted(by_hash, key=sizes.__getitem__)
    place = {row: at for at, row in enumerate(by_size)}
    drawn = []
    for row in by_hash[:count]:
        at, own = place[row], objects[row]
        larger = next((k for k in by_size[at + 1 :] if objects[k] != own), None)
        smaller = next((k for k in reversed(by_size[:at]) if objects[k] != own), None)
        near = [k for k in (smaller, larger) if k is not None]
        if near:
            other = min(near, key=lambda k: abs(sizes[k] - sizes[row]))
            drawn.append(Decoy(ids[row], ids[other], (keys[ids[row]], keys[ids[other]])))
    return drawn


def _hash(seed: int, text: str) -> bytes:
    return hashlib.sha256(f"decoy {seed} {text}".encode()).digest()


def fold_of(object_id: str) -> int:
    """Return the part of the objects that one belongs to, whatever others there are."""
    from slatprep.judge.decoys import FOLDS

    return hashlib.sha256(f"fold {object_id}".encode()).digest()[0] % FOLDS


def align_decoy(
    path: Place, number: int, decoy: Decoy, parameters: StageParameters
) -> tuple[int, tuple[float, ...]]:
    """Align a decoy as its grid was; return the decoy's number and its evidence."""
    from slatprep.align import align
    from slatprep.geometry.deformation import map_of
    from slatprep.judge import judge
    from slatprep.sample import sample

    store = open_store(path)
    field, latents = store.asset(decoy.grid).field, store.asset(decoy.slat).latents
    alignment = align(field, latents, parameters.align)
    places = map_of(alignment).to_pixieverse(latents.centres)
    annotation = sample(field, places, parameters.sample)
    judgement, _ = judge(field, latents, alignment, annotation, parameters.sample)
    return number, judgement.evidence


def read_decoys(store: Store) -> list[Decoy]:
    """Return the decoys that were measured of a store, or of what it was before an update."""
    document = _document(store)
    if document is None:
        return []
    try:
        return [
            Decoy(one["grid"], one["slat"], (one["keys"][0], one["keys"][1]), _numbers(one))
            for one in document["decoys"]
        ]
    except (ValueError, KeyError, TypeError, IndexError):
        return []  # They are measured anew.


def _numbers(one: dict[str, Any]) -> tuple[float, ...]:
    return tuple(np.nan if value is None else float(value) for value in one["evidence"])


def told_of(store: Store) -> list[str]:
    """Return what was said of a store when its errors were measured; empty if they were not.

    Of a store that was updated since, that it was.
    """
    document = _document(store)
    told = document.get("told") if document else None
    if not isinstance(told, list) or document is None:
        return []
    if document.get("build") != store.about.manifest:
        return ["measured before the last update; run `slatprep measure-errors` again"]
    return [str(sentence) for sentence in told]


def _document(store: Store) -> dict[str, Any] | None:
    folder = manifests_beside(store.path)
    file = None if folder is None else folder / FILE
    if file is None or not file.exists():
        return None
    try:
        document = json.loads(file.read_bytes())
    except ValueError:
        return None
    return document if isinstance(document, dict) else None


def write_decoys(
    store: Store, decoys: Sequence[Decoy], seed: int, told: Sequence[str] = ()
) -> None:
    """Write decoys and what they say beside the records of the build, if those lie on a disk."""
    folder = manifests_beside(store.path)
    if not isinstance(folder, Path):
        return
    rows = [
        {
            "grid": one.grid,
            "slat": one.slat,
            "keys": one.keys,
            "evidence": [None if np.isnan(value) else value for value in one.evidence],
        }
        for one in decoys
    ]
    document = {"build": store.about.manifest, "seed": seed, "told": [*told], "decoys": rows}
    file = folder / FILE
    with writing(str(file), folder), staged(file) as path:
        path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def histogram_of(errors: MeasuredErrors, bins: int = 40) -> tuple[NDArray[np.float64], ...]:
    """Return edges (B+1,) of the scores, and the counts of targets and of decoys in between."""
    scores, decoys = errors.rates.scores, errors.rates.decoy_scores
    both = np.concatenate([scores, decoys])
    edges = np.linspace(both.min(), max(both.max(), both.min() + 1e-6), bins + 1)
    return edges, np.histogram(scores, edges)[0], np.histogram(decoys, edges)[0]

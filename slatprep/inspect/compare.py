"""Compare two stores: their settings, and the changes of each asset."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, StoreError
from slatprep.geometry.frames import displacement, voxel_centres
from slatprep.geometry.voxels import flat_index
from slatprep.normalize import denormalize_properties
from slatprep.pipeline.rows import SourceStore
from slatprep.records import RESOLUTION, Place
from slatprep.store import Store, open_store
from slatprep.store.assets import ASSET_COLUMNS
from slatprep.store.reader import VOXEL_COLUMNS
from slatprep.workers import Progress, counted
from slatprep.workers.local import run_in_order

_ROUNDING = 1e-6
"""Smallest change that counts, as a share of a range: above the rounding of two normalisations."""


@dataclass(frozen=True)
class Setting:
    """A root attribute that differs between two stores; None if a store does not have it."""

    name: str
    a: object
    b: object


@dataclass(frozen=True)
class PropertyChange:
    """Change of a property over voxels that are valid in both stores.

    Attributes
    ----------
    voxels, changed : int
        Number of voxels valid in both, and of voxels whose value differs.
    mean, most : float
        Mean and largest absolute change, in the SI unit.
    log10 : float or None
        Mean absolute change of log10; None unless both stores normalise the property by log10.
    """

    voxels: int
    changed: int
    mean: float
    most: float
    log10: float | None


@dataclass(frozen=True)
class AssetChange:
    """The change of an asset that is in both stores.

    Attributes
    ----------
    asset_id : str
        Its id.
    what : tuple of str
        Words for the differences: ``sources``, ``verdict``, ``placement``, ``voxels``,
        ``labels``, ``properties``, ``latents``, ``columns``; empty if there are none.
    verdicts : tuple of str
        Verdicts in the two stores.
    sources : tuple of str
        Roles of the source files whose content differs.
    columns : tuple of str
        Other arrays that differ, such as ``asset/fitness`` and ``voxel/confidence``.
    moved : float
        Mean distance, in voxels of the PixieVerse frame, between the two places of a SLAT
        voxel; from the transforms alone if the SLATs have different voxels.
    voxels, unmatched : int
        Number of SLAT voxels in both stores, and in only one.
    labels : int
        Number of voxels in both stores whose class differs, or that are valid in only one.
    properties : dict of str to PropertyChange
        Changes of the properties that both stores have, by name.
    """

    asset_id: str
    what: tuple[str, ...]
    verdicts: tuple[str, str]
    sources: tuple[str, ...]
    columns: tuple[str, ...]
    moved: float
    voxels: int
    unmatched: int
    labels: int
    properties: dict[str, PropertyChange]


@dataclass(frozen=True)
class StoreDifference:
    """The differences between two stores.

    Attributes
    ----------
    a, b : Place
        The stores.
    same : bool
        Whether there are no differences. Grids are not read: the digests of their sources stand for
        them.
    settings : tuple of Setting
        Attributes that differ: format, ranges, parameters, versions, the digest of the records.
    only_a, only_b : tuple of str
        Ids of assets in only one of the stores.
    assets, changed : int
        Number of assets in both, and of assets that changed.
    what : dict of str to int
        Number of changed assets by the words of `AssetChange.what`.
    verdicts : dict of str to int
        Number of assets by change of verdict, such as ``good > failed``.
    moved, moved_most : float
        Median and maximum of `AssetChange.moved` over the assets that moved; NaN if none did.
    voxels, labels : int
        Number of SLAT voxels in both stores, and sum of `AssetChange.labels`.
    properties : dict of str to PropertyChange
        Changes over the voxels of all assets, by name.
    worst : tuple of AssetChange
        Changed assets, sorted by the share of changed labels and voxels, then by distance moved.
    """

    a: Place
    b: Place
    same: bool
    settings: tuple[Setting, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    assets: int
    changed: int
    what: dict[str, int]
    verdicts: dict[str, int]
    moved: float
    moved_most: float
    voxels: int
    labels: int
    properties: dict[str, PropertyChange]
    worst: tuple[AssetChange, ...]


def compare_stores(
    a: Store | str | Place,
    b: Store | str | Place,
    *,
    worst: int | None = None,
    jobs: int = 1,
    progress: Progress | None = None,
) -> StoreDifference:
    """Return the differences between two stores.

    Each asset is read once from both stores, without ``grid/*``: the digests of the sources
    show whether the grids differ.

    Parameters
    ----------
    a, b : Store, str or Place
        Open stores, or their paths or URLs.
    worst : int, optional
        Number of changed assets to return, about 1 kB each; all by default.
    jobs : int
        Worker processes. The result does not depend on it.
    progress : callable, optional
        Called with the number of assets done and the number of all assets.

    Returns
    -------
    StoreDifference
        The differences, in total and by asset.

    Raises
    ------
    ConfigError
        If `worst` is negative.
    StoreError
        If a store cannot be read.
    """
    if worst is not None and worst < 0:
        raise ConfigError(f"worst is {worst}; expected 0 or more")
    a, b = open_store(a), open_store(b)
    rows_b = {asset_id: row for row, asset_id in enumerate(b.ids)}
    rows = [(row, rows_b[name]) for row, name in enumerate(a.ids) if name in rows_b]
    settings = tuple(_settings(a.attributes, b.attributes))
    only_a = tuple(name for name in a.ids if name not in rows_b)
    only_b = tuple(sorted(rows_b.keys() - set(a.ids)))
    total = _Sum()
    changes = total.of(_changes(a, b, rows, jobs, progress))
    most = len(rows) if worst is None else worst
    # The totals are of all changes, and heapq would take none if it kept none.
    kept = heapq.nlargest(max(most, 1), changes, key=_how_much)[:most]
    moved = total.moved or [math.nan]
    return StoreDifference(
        a=a.path,
        b=b.path,
        same=not (settings or only_a or only_b or total.changed),
        settings=settings,
        only_a=only_a,
        only_b=only_b,
        assets=len(rows),
        changed=total.changed,
        what=dict(sorted(total.what.items())),
        verdicts=dict(sorted(total.verdicts.items())),
        moved=float(np.median(moved)),
        moved_most=float(np.max(moved)),
        voxels=total.voxels,
        labels=total.labels,
        properties=total.properties,
        worst=tuple(kept),
    )


class _Sum:
    """The totals of all changes."""

    def __init__(self) -> None:
        self.changed = self.voxels = self.labels = 0
        self.what, self.verdicts = Counter[str](), Counter[str]()
        self.moved: list[float] = []
        self.properties: dict[str, PropertyChange] = {}

    def of(self, changes: Iterator[AssetChange]) -> Iterator[AssetChange]:
        """Add all changes to the totals, and yield the changes that are not empty."""
        for change in changes:
            self.voxels += change.voxels
            self.labels += change.labels
            for name, own in change.properties.items():
                before = self.properties.get(name)
                self.properties[name] = own if before is None else _sum_of(before, own)
            if not change.what:
                continue
            self.changed += 1
            self.what.update(change.what)
            if change.verdicts[0] != change.verdicts[1]:
                self.verdicts[" > ".join(change.verdicts)] += 1
            if change.moved:
                self.moved.append(change.moved)
            yield change


def _sum_of(one: PropertyChange, other: PropertyChange) -> PropertyChange:
    voxels, log10 = one.voxels + other.voxels, None
    shares = one.voxels / max(voxels, 1), other.voxels / max(voxels, 1)
    if one.log10 is not None and other.log10 is not None:
        log10 = shares[0] * one.log10 + shares[1] * other.log10
    mean = shares[0] * one.mean + shares[1] * other.mean
    changed, most = one.changed + other.changed, max(one.most, other.most)
    return PropertyChange(voxels, changed, mean, most, log10)


def _how_much(change: AssetChange) -> tuple[float, ...]:
    share = (change.labels + change.unmatched) / max(change.voxels + change.unmatched, 1)
    return (share, change.moved, sum(own.changed for own in change.properties.values()))


def _settings(a: Mapping[str, Any], b: Mapping[str, Any], above: str = "") -> Iterator[Setting]:
    """Yield the entries that differ between two JSON objects, named by their dotted paths."""
    for key in sorted(a.keys() | b.keys()):
        one, other, name = a.get(key), b.get(key), f"{above}{key}"
        if isinstance(one, dict) and isinstance(other, dict):
            yield from _settings(one, other, f"{name}.")
        elif one != other:
            yield Setting(name, one, other)


def _changes(
    a: Store, b: Store, rows: Sequence[tuple[int, int]], jobs: int, progress: Progress | None
) -> Iterator[AssetChange]:
    """Yield the change of each asset that both stores have."""
    both = [list(own) for own in zip(*rows, strict=True)] or [[], []]
    # Column by column: all columns of a large store take much memory.
    names = (*(name for name in ASSET_COLUMNS if name != "verdict"), "transform")
    columns = np.stack([_differ(name, a, b, a.column(name)[both[0]], b.column(name)[both[1]])
                        for name in names])  # fmt: skip
    verdicts = [store.column("verdict")[own] for store, own in zip((a, b), both, strict=True)]
    sources = SourceStore(a), SourceStore(b)
    tasks = (
        (
            *sources,
            pair,
            tuple(str(own[k]) for own in verdicts),
            [f"asset/{name}" for name, other in zip(names, columns[:, k], strict=True) if other],
        )
        for k, pair in enumerate(rows)
    )
    yield from counted(run_in_order(_compare, tasks, jobs), len(rows), progress)


def _differ(
    name: str, a: Store, b: Store, one: NDArray[Any], other: NDArray[Any]
) -> NDArray[np.bool_]:
    """Return which rows of a column differ; differences of properties count as by one range."""
    scaled = name in ("property_ambiguity", "spread") and one.shape[1:] == other.shape[1:]
    if not scaled or a.normalization.ranges == b.normalization.ranges:
        return _unequal(one, other)
    widths = [np.ptp(store.normalization.spans, axis=1) for store in (a, b)]
    same = np.isclose(one * widths[0], other * widths[1], _ROUNDING, _ROUNDING, equal_nan=True)
    return np.asarray(~same.all(axis=1), bool)


def _unequal(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which rows of two arrays differ; NaN equals NaN."""
    if a.shape[1:] != b.shape[1:]:
        return np.ones(len(a), bool)
    other = (a != b) & ((a == a) | (b == b))
    return np.asarray(other.any(axis=tuple(range(1, other.ndim))), bool)


_WORDS = {"voxel/material": "labels", "voxel/valid": "labels", "voxel/feats": "latents",
          "voxel/properties": "properties", "voxel/place": "placement",
          "voxel/coords": "voxels"}  # fmt: skip
"""The word for a difference in an array; ``columns`` for all others and for ``asset/*``."""


def _compare(
    a: SourceStore,
    b: SourceStore,
    rows: tuple[int, int],
    verdicts: tuple[str, str],
    columns: Sequence[str],
) -> AssetChange:
    """Compare an asset, in a worker, given its verdicts and the `columns` that differ."""
    records = a.records.read(rows[0]), b.records.read(rows[1])
    digests = [{(one.role, one.sha256) for one in record.sources} for record in records]
    roles = {role for role, _ in digests[0] ^ digests[1]}
    one, other = a.read(rows[0], VOXEL_COLUMNS), b.read(rows[1], VOXEL_COLUMNS)
    coords = one.pop("coords"), other.pop("coords")
    unmatched, moved = 0, 0.0
    # Voxels of grids with different resolutions never match.
    sides = [store.contents.latents.resolution for store in (a, b)]
    order = sides[0] == sides[1] and np.array_equal(*coords)
    if not order:
        pairs = zip(coords, sides, strict=True)
        codes = [flat_index(own, 256) + (side << 24) for own, side in pairs]
        found, mine, theirs = np.intersect1d(codes[0], codes[1], return_indices=True)
        one = {name: values[mine] for name, values in one.items()}
        other = {name: values[theirs] for name, values in other.items()}
        unmatched = len(codes[0]) + len(codes[1]) - 2 * len(found)
    if unmatched:
        here, there = (
            store.read_rows("asset/transform", row, row + 1)[0]
            for store, row in zip((a, b), rows, strict=True)
        )
        try:
            moved = displacement(there, here, voxel_centres(coords[0], sides[0]))
        except ValueError as error:
            where = f"{a.path} or {b.path}: asset {a.ids[rows[0]]}"
            raise StoreError(f"{where}: {error}; run `slatprep verify`") from None
    elif not np.array_equal(one["place"], other["place"]):
        apart = other["place"].astype(np.float64) - one["place"]
        moved = float(np.linalg.norm(apart, axis=1).mean() * RESOLUTION)
    labels = (one["material"] != other["material"]) | (one["valid"] != other["valid"])
    properties = _properties(a, b, one.pop("properties"), other.pop("properties"))
    differ = [name for name in one if _differ(name, a, b, one[name], other[name]).any()]
    differ += ["properties"] * any(own.changed for own in properties.values())
    differ += ["coords"] * (not order)
    arrays = [*columns, *(f"voxel/{name}" for name in differ)]
    words = {_WORDS.get(name, "columns") for name in arrays}
    others = {"sources": roles, "verdict": verdicts[0] != verdicts[1], "placement": moved}
    words |= {word for word, differ in others.items() if differ}
    return AssetChange(
        asset_id=a.ids[rows[0]],
        what=tuple(sorted(words)),
        verdicts=verdicts,
        sources=tuple(sorted(roles)),
        columns=tuple(name for name in arrays if name not in _WORDS),
        moved=moved,
        voxels=len(labels),
        unmatched=unmatched,
        labels=int(labels.sum()),
        properties=properties,
    )


def _properties(
    a: Store, b: Store, one: NDArray[np.float32], other: NDArray[np.float32]
) -> dict[str, PropertyChange]:
    """Compare normalised properties of the same voxels, in SI units."""
    spans = {span.name: (k, span) for k, span in enumerate(b.normalization.ranges)}
    si = [
        denormalize_properties(values, store.normalization).astype(np.float64)
        for values, store in ((one, a), (other, b))
    ]
    changes = {}
    for k, span in enumerate(a.normalization.ranges):
        if span.name not in spans:
            continue
        column, other_span = spans[span.name]
        both = np.isfinite(one[:, k]) & np.isfinite(other[:, column])
        here, there = si[0][both, k], si[1][both, column]
        apart = mapped = np.abs(there - here)
        powers = span.log10 and other_span.log10
        if powers:
            mapped = np.abs(np.log10(there) - np.log10(here))
        if span == other_span:
            changed = one[both, k] != other[both, column]
        else:
            changed = mapped > _ROUNDING * (span.hi - span.lo)
        changes[span.name] = PropertyChange(
            voxels=len(here),
            changed=int(changed.sum()),
            mean=_mean(apart),
            most=float(apart.max(initial=0.0)),
            log10=_mean(mapped) if powers else None,
        )
    return changes


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else 0.0

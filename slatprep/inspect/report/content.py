"""Collect the content of the page as one JSON document, without its layout."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slatprep.align.consensus import degrees_between
from slatprep.align.starts import distinct_starts
from slatprep.errors import StoreError
from slatprep.geometry.frames import split_transform
from slatprep.inspect.check import LIMITS
from slatprep.inspect.pictures.canvas import DISTANCE_COLOURS
from slatprep.inspect.report.drawn import BINS, COLUMNS, LEVELS, PER_SHEET, VIEWS, Drawn
from slatprep.inspect.tallies import Tally, no_tally
from slatprep.judge import THRESHOLDS
from slatprep.normalize import PIXIE_RANGES
from slatprep.pipeline.measured import errors_of, told_of
from slatprep.pipeline.notices import shared_sources
from slatprep.pipeline.rows import slat_contents
from slatprep.records import MATERIAL_COLOURS, UNANNOTATED_COLOUR, Place, Status
from slatprep.store.reader import Store
from slatprep.store.record import AssetRecord, BuildRecord, FailedRecord
from slatprep.store.records import StoredRecords, build_in

# Matplotlib's viridis (CC0) at even steps. Its lightness rises with the value, so
# colour-blind readers can order the colours too.
_PROPERTY_COLOURS = ("#440154", "#472D7B", "#3B528B", "#2C728E", "#21918C", "#28AE80",
                     "#5EC962", "#ADDC30", "#FDE725")  # fmt: skip

_FIGURES = ("confidence", "same_object", "right_placement", "expected_accuracy", "fitness",
            "fitness_backward", "inlier_rmse", "overlap", "valid_share", "ambiguity",
            "margin")  # fmt: skip

_UNTOLD: Mapping[str, Any] = {"ties": [], "reasons": []}
"""Columns of an asset whose record is not read."""

MOST_TIES = 8
"""Largest number of tied placements that the page has for an asset."""

DIGITS = 5
"""Number of decimal places of numbers on the page."""

# "failed" is a verdict on an alignment, and these assets were not aligned at all.
_ABSENT = {Status.FAILED: "not built", Status.SKIPPED: "skipped"}

_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?")

_PATH = re.compile(r"^(?:/.*?|\S*[/\\.]\S*): ")
"""Pattern of the path at the start of a reason."""

Columns = dict[str, Any]
"""Values of one asset in the page's table, by the names of its columns."""


def build_of(manifests: Place, store: Store, most_absent: int) -> BuildRecord:
    """Return the record of a store's build, with at most `most_absent` failed assets, by id.

    Raises StoreError if the record cannot be read, or belongs to another build.
    """
    build = build_in(manifests)
    if build.id != store.about.manifest:
        raise StoreError(
            f"{manifests} holds the records of build {build.id[:12]!r}, the store was written by "
            f"{store.about.manifest[:12]!r}; name the folder of its own records with --manifests, "
            "or build again"
        )
    absent = sorted(build.failed[:most_absent], key=lambda one: one.asset_id)
    return replace(build, failed=tuple(absent))


def told_by_records(store: Store, listed: Iterable[int]) -> dict[int, Columns]:
    """Return columns from the assets' records, by row; raise StoreError if one is unreadable."""
    records = StoredRecords(store)
    return {row: _columns_of(records.read(row)) for row in listed}


def _columns_of(record: AssetRecord) -> Columns:
    placements, merged = record.alignment.placements, record.merged
    return {
        "reasons": list(record.judgement.reasons),
        # "tied" counts all tied placements; "ties" has the transforms of the first ones.
        "tied": len(placements),
        "ties": [
            [round(number, 6) for number in one.transform[:3].ravel().tolist()]
            for one in placements[:MOST_TIES]
        ],
        "displacement": rounded(max((one.displacement for one in placements), default=None)),
        "annotations": [sum(not one.left_out for one in merged), len(merged)] if merged else None,
    }


def rounded(value: float | None) -> float | None:
    """Return a number rounded to `DIGITS` decimal places; None if it is not finite."""
    return None if value is None or not np.isfinite(value) else round(value, DIGITS)


def kinds_of(reasons: Iterable[str]) -> dict[str, str]:
    """Map each reason to its kind: the reason without its file, with N for numbers that vary.

    >>> list(kinds_of(["only 7% lie within 1 voxel", "only 8.5% lie within 1 voxel"]).values())
    ['only N% lie within 1 voxel', 'only N% lie within 1 voxel']
    >>> list(kinds_of(["a/b.npz: holds 3 voxels twice; expected distinct coordinates"]).values())
    ['holds 3 voxels twice']
    """
    parts = {}
    common: dict[tuple[str, ...], list[str]] = {}
    for reason in reasons:
        fault = _PATH.sub("", reason.partition("; expected")[0])
        words, numbers = tuple(_NUMBER.split(fault)), _NUMBER.findall(fault)
        known = common.setdefault(words, numbers)
        common[words] = [a if a == b else "N" for a, b in zip(known, numbers, strict=True)]
        parts[reason] = words
    return {
        reason: "".join(chain.from_iterable(zip(words, [*common[words], ""], strict=True)))
        for reason, words in parts.items()
    }


def page_content(
    store: Store,
    built: BuildRecord | None,
    told: Mapping[int, Columns],
    tallies: Mapping[str, Tally],
    listed: Sequence[int],
    drawn: Sequence[Drawn],
    side: int,
) -> dict[str, Any]:
    """Return the content of a page, JSON-ready; NaN and unknown values are None.

    `built` and `told` come from the records, if any, and `tallies` count voxels by category. The
    table has the `listed` rows; `drawn` rows also have a thumbnail and a 3D view with `side` voxels
    per edge. Both ascend. Columns of the table are lists over assets, with the store's assets
    first; ``all`` also counts assets outside the store.
    """
    build, labels = store.about.build, store.contents.labels
    states = Counter(map(str, store.column("verdict")))
    if built:
        states += Counter({name: built.statuses.get(str(of), 0) for of, name in _ABSENT.items()})
    return {
        "title": store.name,
        "name": build.name,
        "build_id": store.about.manifest,
        "created": built and f"{built.created:%Y-%m-%d}",
        "records": built is not None,
        "versions": build.versions,
        "parameters": [
            (f"{group}.{name}", json.dumps(value))
            for group, entries in sorted(store.attributes["build"]["parameters"].items())
            for name, value in sorted(entries.items())
        ],
        "voxels": int(store.offsets[-1]),
        "path": _PATH.pattern,
        "engine": sorted(set(map(str, store.column("engine")))),
        "thresholds": {name: limit for name, (_, _, limit) in LIMITS.items()},
        "classes": [
            {"name": name, "colour": MATERIAL_COLOURS[index]}
            # Unused numbers have an empty name.
            for index, name in enumerate([*labels, *[""] * (store.contents.n_labels - len(labels))])
        ],
        "scales": {
            "none": UNANNOTATED_COLOUR,
            "property": _PROPERTY_COLOURS,
            "distance": DISTANCE_COLOURS,
            "max_distance": build.parameters.sample.max_distance,
            "radius": build.parameters.align.radius,
        },
        "detail": {
            "side": side,
            "assets": len(drawn),
            "levels": LEVELS,
            "per_sheet": PER_SHEET,
            "columns": COLUMNS,
            "views": VIEWS,
        },
        "errors": _errors(store),
        "turns": quarter_turns(),
        "properties": _properties(store, tallies),
        "balance": _balance(store, tallies),
        "assets": _table(store, built.failed if built else (), told, listed, drawn),
        "shared": list(shared_sources(store, "SLAT", slat_contents(store))),
        "all": {
            "stored": len(store),
            "assets": sum(states.values()),
            "states": states,
            "ambiguous": int((store.column("ambiguity") > THRESHOLDS.good_ambiguity).sum()),
            "unusual": int((store.column("unusual") != "").sum()),
        },
    }


def _errors(store: Store) -> dict[str, Any]:
    """Return the verdicts' error rates measured on decoys, and the histograms of scores."""
    measured, told = errors_of(store), {"told": told_of(store)}
    if measured is None:
        return told
    return told | {
        "edges": [round(edge, DIGITS) for edge in measured.edges],
        "assets": measured.targets,
        "decoys": measured.counts,
        "kept": [
            (one.rate, one.assets, rounded(one.score if measured.tells else None))
            for one in measured.kept
        ],
    }


def _properties(store: Store, tallies: Mapping[str, Tally]) -> list[dict[str, Any]]:
    """Return the histograms of each property by class, its ranges, and numbers of clipped values.

    The numbers are those of the field and of the SLAT.
    """
    normalization, published = store.normalization, {one.name: one for one in PIXIE_RANGES.ranges}
    total = sum(tallies.values(), start=no_tally(store, BINS)).histogram.astype(np.int64)
    return [
        {
            **vars(span),
            "source": normalization.source,
            "title": one.title,
            "unit": one.sign,
            "pixie": [pixie.lo, pixie.hi] if (pixie := published.get(span.name)) else None,
            "field": field.tolist(),
            "slat": slat.tolist(),
            "clipped": clipped,
        }
        for span, one, field, slat, *clipped in zip(
            normalization.ranges,
            store.contents.properties,
            *total,
            store.column("clipped_grid").sum(axis=0).tolist(),
            store.column("clipped").sum(axis=0).tolist(),
            strict=True,
        )
    ]


def _balance(store: Store, tallies: Mapping[str, Tally]) -> list[dict[str, Any]]:
    """Return the number of SLAT voxels by category and class, with those not valid last."""
    assets = Counter(str(category) for category in store.column("category"))
    return [
        {
            "category": category,
            "assets": assets[category],
            "classes": tallies[category].voxels[1].tolist(),
        }
        for category in sorted(tallies)
    ]


def _table(
    store: Store,
    absent: Sequence[FailedRecord],
    told: Mapping[int, Columns],
    listed: Sequence[int],
    drawn: Sequence[Drawn],
) -> dict[str, list[Any]]:
    """Return the columns of the table of assets."""
    rows = np.array(listed, dtype=np.intp)
    of_records = [told.get(row, _UNTOLD) for row in listed]
    of_absent = [
        {"id": one.asset_id, "category": one.category, "state": _ABSENT[one.status],
         "reasons": [one.reason]} for one in absent
    ]  # fmt: skip
    transforms = store.column("transform")[rows]
    nearest = [nearest_quarter_turn(transform) for transform in transforms]
    pictures = {one.index: number for number, one in enumerate(drawn)}
    merged = {one.index: one for one in drawn if one.spreads}
    of_stored: dict[str, Iterable[Any]] = {
        "id": [store.ids[row] for row in listed],
        "category": map(str, store.column("category")[rows]),
        "state": map(str, store.column("verdict")[rows]),
        "unusual": [str(lines).splitlines() for lines in store.column("unusual")[rows]],
        "voxels": np.diff(store.offsets)[rows].tolist(),
        "unphysical": store.column("unphysical")[rows].tolist(),
        "model": map(str, store.column("model")[rows]),
        "turn": (index for index, _ in nearest),
        "tilt": (round(angle, 2) for _, angle in nearest),
        "transform": (
            [round(float(value), 6) for value in matrix[:3].ravel()] for matrix in transforms
        ),
        **{
            name: [own.get(name) for own in of_records]
            for name in ("tied", "ties", "displacement", "reasons")
        },
        "picture": map(pictures.get, listed),
        "annotations": (own.get("annotations") for own in of_records),
        "votes": (rounded(merged[row].votes) if row in merged else None for row in listed),
        "spreads": (
            list(map(rounded, merged[row].spreads)) if row in merged else None for row in listed
        ),
        **{name: map(rounded, store.column(name)[rows].tolist()) for name in _FIGURES},
    }
    columns = {
        name: [*own, *(one.get(name) for one in of_absent)] for name, own in of_stored.items()
    }
    kinds = kinds_of(reason for own in columns["reasons"] for reason in own)
    columns["kinds"] = [[kinds[reason] for reason in own] for own in columns["reasons"]]
    return columns


def nearest_quarter_turn(transform: ArrayLike) -> tuple[int, float]:
    """Return the quarter turn nearest to a transform's rotation, and the angle between them.

    `transform` is (4, 4). The turn is an index of `quarter_turns`, the angle is in degrees.
    """
    turns = [start.rotation for start in distinct_starts()]
    angles = degrees_between(turns, split_transform(transform)[0])
    index = int(angles.argmin())
    return index, float(angles[index])


def quarter_turns() -> tuple[str, ...]:
    """Return in words where each of the 24 quarter turns takes the axes x, y and z.

    >>> quarter_turns()[0]
    'x→+x y→+y z→+z'
    """
    turns = []
    for start in distinct_starts():
        axes = np.abs(start.rotation).argmax(axis=0)
        signs = ("+" if column.sum() > 0 else "\u2212" for column in start.rotation.T)
        ends = zip("xyz", signs, axes, strict=True)
        turns.append(" ".join(f"{name}→{sign}{'xyz'[axis]}" for name, sign, axis in ends))
    return tuple(turns)

"""The content of the page as one JSON document, without its layout."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.align.starts import distinct_starts
from slatprep.geometry.frames import split_transform
from slatprep.inspect.check import LIMITS
from slatprep.inspect.pictures.canvas import DISTANCE_COLOURS
from slatprep.inspect.report.drawn import BINS, COLUMNS, LEVELS, PER_SHEET, VIEWS
from slatprep.inspect.report.outcomes import DIGITS, Outcomes, kinds_of, rounded
from slatprep.inspect.tallies import Tally, no_tally
from slatprep.judge import THRESHOLDS
from slatprep.normalize import PIXIE_RANGES
from slatprep.pipeline.decoys import measured_errors, told_of
from slatprep.records import MATERIAL_COLOURS, UNANNOTATED_COLOUR
from slatprep.store.reader import Store

# Matplotlib's viridis (CC0) at even steps: its lightness rises with the value, so that
# colour-blind readers can order the colours too.
_PROPERTY_COLOURS = ("#440154", "#472D7B", "#3B528B", "#2C728E", "#21918C", "#28AE80",
                     "#5EC962", "#ADDC30", "#FDE725")  # fmt: skip

_FIGURES = ("confidence", "expected_accuracy", "fitness", "fitness_backward", "inlier_rmse",
            "overlap", "valid_share", "ambiguity", "margin")  # fmt: skip

_UNTOLD: Mapping[str, Any] = {"ties": [], "reasons": []}
"""What the table says of an asset without the records of its build."""

Agreement = Mapping[int, tuple[float, tuple[float, ...]]]
"""Mean votes and mean spreads of rows with merged labels."""


def page_content(
    store: Store,
    outcomes: Outcomes | None,
    tallies: Mapping[str, Tally],
    listed: Sequence[int],
    chosen: Sequence[int],
    side: int,
    agreement: Agreement,
) -> dict[str, Any]:
    """Return the content of a page, JSON-ready; NaN and unknown values are None.

    `outcomes` come from the records, if any, and `tallies` count voxels by category. Rows `listed`
    are in the table, rows `chosen` also have a thumbnail and a 3D view with `side` voxels per edge;
    both ascend. `agreement` has mean votes and mean spreads of merged labels by row. Columns of the
    table are lists over assets, those of the store first; ``all`` counts also assets outside it.
    """
    build, labels = store.about.build, store.contents.labels
    states = Counter(map(str, store.column("verdict")))
    if outcomes:
        states += outcomes.states
    return {
        "title": store.name,
        "name": build.name,
        "build_id": store.about.manifest,
        "created": outcomes and outcomes.created,
        "records": outcomes is not None,
        "versions": build.versions,
        "parameters": [
            (f"{group}.{name}", json.dumps(value))
            for group, entries in sorted(store.attributes["build"]["parameters"].items())
            for name, value in sorted(entries.items())
        ],
        "voxels": int(store.offsets[-1]),
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
            "assets": len(chosen),
            "levels": LEVELS,
            "per_sheet": PER_SHEET,
            "columns": COLUMNS,
            "views": VIEWS,
        },
        "errors": _errors(store),
        "turns": quarter_turns(),
        "properties": _properties(store, outcomes, tallies),
        "balance": _balance(store, tallies),
        "assets": _table(store, outcomes, listed, chosen, agreement),
        "all": {
            "stored": len(store),
            "assets": sum(states.values()),
            "states": states,
            "ambiguous": int((store.column("ambiguity") > THRESHOLDS.good_ambiguity).sum()),
        },
    }


def _errors(store: Store) -> dict[str, Any]:
    """Return what decoys say of the verdicts, and the histograms of scores that show it."""
    measured, told = measured_errors(store.path), {"told": told_of(store)}
    if measured is None:
        return told
    return told | {
        "edges": [round(edge, DIGITS) for edge in measured.edges],
        "assets": measured.targets,
        "decoys": measured.counts,
        "kept": [(one.rate, one.assets, rounded(one.score)) for one in measured.kept],
    }


def _properties(
    store: Store, outcomes: Outcomes | None, tallies: Mapping[str, Tally]
) -> list[dict[str, Any]]:
    """Return the histograms of each property by class, and its ranges."""
    normalization, published = store.normalization, {one.name: one for one in PIXIE_RANGES.ranges}
    total = sum(tallies.values(), start=no_tally(normalization, BINS, contents=store.contents))
    return [
        {
            **vars(span),
            "source": normalization.source,
            "title": one.title,
            "unit": one.sign,
            "pixie": [pixie.lo, pixie.hi] if (pixie := published.get(span.name)) else None,
            "field": field.tolist(),
            "slat": slat.tolist(),
            "clipped": int(count) if outcomes else None,
        }
        for span, one, field, slat, count in zip(
            normalization.ranges,
            store.contents.properties,
            total.field.histogram.astype(np.int64),
            total.slat.histogram.astype(np.int64),
            store.column("clipped").sum(axis=0),
            strict=True,
        )
    ]


def _balance(store: Store, tallies: Mapping[str, Tally]) -> list[dict[str, Any]]:
    """Return the number of SLAT voxels by category and class, those that are not valid last."""
    assets = Counter(str(category) for category in store.column("category"))
    return [
        {
            "category": category,
            "assets": assets[category],
            "classes": tallies[category].slat.voxels.tolist(),
        }
        for category in sorted(tallies)
    ]


def _table(
    store: Store,
    outcomes: Outcomes | None,
    listed: Sequence[int],
    chosen: Sequence[int],
    agreement: Agreement,
) -> dict[str, list[Any]]:
    """Return the columns of the table of assets."""
    rows = np.array(listed, dtype=np.intp)
    ids = [store.ids[row] for row in listed]
    told = [outcomes.stored[asset_id] if outcomes else _UNTOLD for asset_id in ids]
    absent = outcomes.absent if outcomes else []
    transforms = store.column("transform")[rows]
    nearest = [nearest_quarter_turn(transform) for transform in transforms]
    pictures = {index: number for number, index in enumerate(chosen)}
    of_stored: dict[str, Iterable[Any]] = {
        "id": ids,
        "category": map(str, store.column("category")[rows]),
        "state": map(str, store.column("verdict")[rows]),
        "voxels": np.diff(store.offsets)[rows].tolist(),
        "unphysical": store.column("unphysical")[rows].tolist(),
        "model": map(str, store.column("model")[rows]),
        "turn": (index for index, _ in nearest),
        "tilt": (round(angle, 2) for _, angle in nearest),
        "transform": (
            [round(float(value), 6) for value in matrix[:3].ravel()] for matrix in transforms
        ),
        **{
            name: [own.get(name) for own in told]
            for name in ("tied", "ties", "displacement", "reasons")
        },
        "picture": map(pictures.get, listed),
        "annotations": (own.get("annotations") for own in told),
        "votes": (rounded(agreement.get(row, (None, ()))[0]) for row in listed),
        "spreads": (
            [rounded(one) for one in agreement[row][1]] if row in agreement else None
            for row in listed
        ),
        **{name: map(rounded, store.column(name)[rows].tolist()) for name in _FIGURES},
    }
    columns = {name: [*own, *(one.get(name) for one in absent)] for name, own in of_stored.items()}
    kinds = kinds_of(reason for own in columns["reasons"] for reason in own)
    columns["kinds"] = [[kinds[reason] for reason in own] for own in columns["reasons"]]
    return columns


def nearest_quarter_turn(transform: ArrayLike) -> tuple[int, float]:
    """Return the quarter turn nearest to the rotation of a transform (4, 4), and their angle.

    The first is an index of `quarter_turns`, the second is in degrees.
    """
    rotation, _, _ = split_transform(transform)
    turns = np.stack([start.rotation for start in distinct_starts()])
    traces = np.einsum("kij,ij->k", turns, rotation)
    index = int(np.argmax(traces))
    cosine = np.clip((traces[index] - 1.0) / 2.0, -1.0, 1.0)
    return index, float(np.degrees(np.arccos(cosine)))


def quarter_turns() -> tuple[str, ...]:
    """Return in words where each of the 24 quarter turns takes the axes x, y and z.

    >>> quarter_turns()[0]
    'x→+x y→+y z→+z'
    """
    return tuple(_in_words(start.rotation) for start in distinct_starts())


def _in_words(rotation: NDArray[np.float64]) -> str:
    words = []
    for name, column in zip("xyz", rotation.T, strict=True):
        axis = int(np.argmax(np.abs(column)))
        words.append(f"{name}→{'+' if column[axis] > 0 else '−'}{'xyz'[axis]}")  # noqa: RUF001
    return " ".join(words)

"""Verify the ``asset/*`` arrays: ids, offsets and columns."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from slatprep.readers.patterns import ASSET_ID, NAME
from slatprep.records import RESOLUTION, Engine, Model, Search, Verdict
from slatprep.store.attributes import segments_of
from slatprep.store.contract import MAX_VOXELS, Finding
from slatprep.store.reader import Store

SHARES = ("fitness", "fitness_backward", "overlap", "ambiguity", "valid_share", "confidence",
          "expected_accuracy")  # fmt: skip
"""Columns of shares and probabilities, 0 to 1."""

DISTANCES = ("inlier_rmse", "inlier_rmse_backward", "margin")
"""Columns of numbers of at least 0, or NaN where they are not defined."""

WORDS = {
    words.__name__.lower(): tuple(map(str, words)) for words in (Engine, Model, Search, Verdict)
}
"""Allowed words by column."""

# R of a similarity satisfies R^T R = s^2 I; rounding leaves this much.
_TOLERANCE = 1e-6


def index_findings(store: Store) -> Iterator[Finding]:
    """Yield findings on the ``asset/*`` arrays."""
    ids = store.ids
    begins = store.attributes.get("segments")
    if json.dumps(begins) != json.dumps(segments_of(ids)):  # True is 1, and 4.0 is 4
        what = f"attribute segments is {begins!r}"
        yield Finding("zarr.json", "", what, "the rows at which ids begin to ascend")
    known = set(ids[:1])
    for row, (before, after) in enumerate(pairwise(ids), 1):
        stated = not isinstance(begins, list) or row in begins
        if after in known or (before > after and not stated):
            what = "occurs twice" if after in known else f"comes after {before!r}"
            yield Finding("asset/id", after, what, "ids ascending in each segment, each once")
        known.add(after)
    for name, allowed in (("id", ASSET_ID), ("object_id", NAME), ("view", NAME)):
        for asset_id, value in zip(ids, store.column(name), strict=True):
            # An object with one SLAT has no view.
            if not (allowed.fullmatch(value) or (name == "view" and value == "")):
                yield Finding(
                    f"asset/{name}", asset_id, f"is {value!r}", "letters, digits, '.', '_' and '-'"
                )
    yield from _offset_findings(store)
    for name in SHARES:
        yield from _outside(store, name, 0.0, 1.0)
    for name in DISTANCES:
        yield from _outside(store, name, 0.0, np.inf, nan=True)
    yield from _outside(store, "unphysical", 0, RESOLUTION**3)
    for name, words in WORDS.items():
        for asset_id, word in zip(ids, store.column(name), strict=True):
            if str(word) not in words:
                yield Finding(f"asset/{name}", asset_id, repr(word), f"one of {words}")
    yield from _transform_findings(store)


def _offset_findings(store: Store) -> Iterator[Finding]:
    where, offsets = "asset/offset", store.offsets
    voxels = store.shape("voxel/coords")[0]
    if offsets[0] != 0 or offsets[-1] != voxels:
        ends = f"runs from {offsets[0]} to {offsets[-1]}"
        yield Finding(where, "", ends, f"0 to {voxels}, the rows of voxel/*")
    sizes = np.diff(offsets)
    for row in np.flatnonzero((sizes < 1) | (sizes > MAX_VOXELS)):
        yield Finding(where, store.ids[row], f"{sizes[row]} rows", f"1 to {MAX_VOXELS} rows")


def _outside(store: Store, name: str, lo: float, hi: float, nan: bool = False) -> Iterator[Finding]:
    values = store.column(name)
    fine = (values >= lo) & (values <= hi)
    if nan:
        fine |= np.isnan(values)
    for row in np.flatnonzero(~fine):
        yield Finding(f"asset/{name}", store.ids[row], f"is {values[row]}", f"{lo:g} to {hi:g}")


def _transform_findings(store: Store) -> Iterator[Finding]:
    for asset_id, model, transform in zip(
        store.ids, store.column("model"), store.column("transform"), strict=True
    ):
        linear = transform[:3, :3]
        similar = np.isfinite(transform).all() and (transform[3] == (0, 0, 0, 1)).all()
        determinant = float(np.linalg.det(linear)) if similar else 0.0
        square = abs(determinant) ** (2 / 3)
        kind = "rigid" if model == "rigid" else "similarity"
        unit = abs(determinant - 1) <= _TOLERANCE if model == "rigid" else True
        rest = np.abs(linear.T @ linear - square * np.eye(3)).max() if similar else np.inf
        if determinant <= 0 or not unit or rest > _TOLERANCE * max(square, 1.0):
            yield Finding(
                "asset/transform",
                asset_id,
                f"{transform.tolist()} is no {kind} transform",
                "a rotation (scaled by one factor unless rigid) and a shift, finite",
            )

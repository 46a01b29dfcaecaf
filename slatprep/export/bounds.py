"""World bounds of PixieVerse fields, from the records of a store."""

from __future__ import annotations

from collections.abc import Sequence

from slatprep.errors import StoreError
from slatprep.records import RESOLUTION
from slatprep.store import Store

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Smallest and largest world coordinate of a field, x, y, z."""

UNIT_CUBE: Bounds = ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
"""Pixie's own default bounds."""

LAST = RESOLUTION - 1
"""Index of the voxel that lies on the largest bound."""


def read_bounds(store: Store, ids: Sequence[str]) -> tuple[dict[str, Bounds], tuple[str, ...]]:
    """Read the world bounds of assets from their records.

    Parameters
    ----------
    store : Store
        The store.
    ids : sequence of str
        The assets.

    Returns
    -------
    bounds : dict
        By asset id; `UNIT_CUBE` where the sources stated none.
    notes : tuple of str
        What a person should know.

    Raises
    ------
    StoreError
        If a record's bounds make no sense.
    """
    from slatprep.provenance.stored import StoredRecords

    records = StoredRecords(store)
    bounds, missing = {}, 0
    for asset_id in ids:
        stated = records.of(asset_id).bounds
        missing += not stated
        bounds[asset_id] = _bounds(stated, store, asset_id) if stated else UNIT_CUBE
    notes: tuple[str, ...] = ()
    if missing:
        notes = (f"{missing:,} assets have no world bounds; Pixie's default -0.5..0.5 was taken",)
    return bounds, notes


def _bounds(stated: object, store: Store, asset_id: str) -> Bounds:
    try:
        lo, hi = (tuple(map(float, stated[key])) for key in ("min_bounds", "max_bounds"))  # type: ignore[index]
        if len(lo) != 3 or len(hi) != 3 or not all(a < b for a, b in zip(lo, hi, strict=True)):
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise StoreError(
            f"{store.path}: {asset_id} has bounds {stated}; expected min_bounds and max_bounds of "
            "three numbers each, min below max"
        ) from None
    return (lo[0], lo[1], lo[2]), (hi[0], hi[1], hi[2])

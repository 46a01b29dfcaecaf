"""World bounds of PixieVerse fields, from the records of a build."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path

from slatprep.errors import ConfigError, InputError
from slatprep.records import RESOLUTION
from slatprep.store import Store

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Smallest and largest world coordinate of a field, x, y, z."""

UNIT_CUBE: Bounds = ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
"""Pixie's own default bounds."""

LAST = RESOLUTION - 1
"""Index of the voxel that lies on the largest bound."""


def read_bounds(
    store: Store, ids: Collection[str], records: Path | None = None
) -> tuple[dict[str, Bounds], tuple[str, ...]]:
    """Read the world bounds of assets from the records of the build that made a store.

    Parameters
    ----------
    store : Store
        The store.
    ids : collection of str
        The assets.
    records : Path, optional
        The build's folder of records; the one beside the store by default.

    Returns
    -------
    bounds : dict
        By asset id; `UNIT_CUBE` where the sources stated none.
    notes : tuple of str
        What a person should know.

    Raises
    ------
    ConfigError
        If there are no records, or they are of another build.
    InputError
        If a record's bounds make no sense.
    """
    # Imported here: the builder brings all stages with it.
    from slatprep.build import default_manifests

    folder = default_manifests(store.path) if records is None else Path(records)
    try:
        build = json.loads((folder / "build.json").read_text(encoding="utf-8"))
        lines = (folder / "assets.jsonl").read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{folder}: no records of a build there ({error}); expected the folder that "
            "build-store wrote, which holds the world bounds"
        ) from None
    if build.get("id") != store.attributes["manifest"]:
        raise ConfigError(f"{folder}: the records are of another build than {store.path}")
    wanted, found = set(ids), {}
    for record in map(json.loads, lines):
        if record["asset_id"] in wanted and record.get("bounds"):
            found[record["asset_id"]] = _bounds(record, folder / "assets.jsonl")
    missing = len(wanted - found.keys())
    notes: tuple[str, ...] = ()
    if missing:
        notes = (f"{missing:,} assets have no world bounds; Pixie's default -0.5..0.5 was taken",)
    return {asset_id: found.get(asset_id, UNIT_CUBE) for asset_id in sorted(wanted)}, notes


def _bounds(record: dict[str, dict[str, object]], path: Path) -> Bounds:
    stated = record["bounds"]
    try:
        lo, hi = (tuple(map(float, stated[key])) for key in ("min_bounds", "max_bounds"))  # type: ignore[call-overload]
        if len(lo) != 3 or len(hi) != 3 or not all(a < b for a, b in zip(lo, hi, strict=True)):
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise InputError(
            path,
            f"{record['asset_id']} has bounds {stated}",
            "min_bounds and max_bounds of three numbers each, min below max",
        ) from None
    return (lo[0], lo[1], lo[2]), (hi[0], hi[1], hi[2])

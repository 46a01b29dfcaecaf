"""Labels merged of several annotations, recomputed from the sources."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from slatprep.errors import SlatprepError
from slatprep.inspect.check import TOLERANCES
from slatprep.normalize import normalize_change, normalize_properties
from slatprep.pipeline.annotate import annotate
from slatprep.readers import read_field
from slatprep.records import AssetPair, Contribution, SourceRoots
from slatprep.sample import in_table, merge
from slatprep.store.contract import Finding
from slatprep.store.reader import StoredAsset
from slatprep.store.record import AssetRecord

TOLERANCE = 1e-5
"""Largest difference of shares and normalised spreads: another machine may round otherwise."""


def merged_findings(
    asset: StoredAsset, record: AssetRecord, roots: SourceRoots
) -> Iterator[Finding]:
    """Yield findings where merged labels differ from what sources and recorded alignments give."""
    latents, contents = asset.latents, asset.store.contents
    parts = []
    for one in record.merged:
        if one.left_out or one.alignment is None or one.judgement is None:
            continue
        try:
            pair = _pair_of(asset, record, one, roots)
            field = read_field(pair, record.parameters.sample.max_unphysical)
        except (IndexError, SlatprepError) as error:
            where = f"sample {one.sample} cannot be looked up again ({error})"
            yield Finding("sources", asset.asset_id, where, "the sources of the build")
            return
        placed = annotate(pair, field, latents, record.parameters, one.alignment, one.judgement)
        parts.append(in_table(placed.annotation, field, contents))
    if not parts:
        yield Finding("asset/record", asset.asset_id, "merges no annotation", "one at least")
        return
    made = merge(parts, contents.properties)
    ranges = asset.store.normalization
    spread = None if made.spread is None else normalize_change(made.spread, ranges)
    properties = normalize_properties(made.properties, ranges)
    now = vars(made) | {"properties": properties, "spread": spread}
    for name in ("valid", "material", "properties", "confidence", "spread", "votes"):
        limit = TOLERANCES.get(f"voxel/{name}", TOLERANCE)
        held, given = getattr(asset, name), np.asarray(now[name], dtype=np.float64)
        same = np.isclose(held, given, rtol=0.0, atol=limit, equal_nan=True)
        wrong = int(np.count_nonzero(~same.reshape(len(same), -1).all(axis=1)))
        if wrong:
            what = f"{wrong} of {len(same)} voxels differ"
            yield Finding(f"voxel/{name}", asset.asset_id, what, "what the sources give, merged")


def _pair_of(
    asset: StoredAsset, record: AssetRecord, one: Contribution, roots: SourceRoots
) -> AssetPair:
    """Return where the files of one annotation are now."""
    found = [record.sources[k] for k in one.sources]
    own = (roots, *roots.also)[found[0].source]
    files = {file.role: own.pixieverse / file.path for file in found}
    slat = next(roots.slat / file.path for file in record.sources if file.role == "slat")
    return AssetPair(
        record.asset_id,
        record.object_id,
        record.view,
        record.category,
        replace(own, contents=asset.store.contents),
        files.get("grid"),
        files.get("mask"),
        files.get("bounds"),
        slat,
        transform=files.get("transform"),
        beside=tuple(own.pixieverse / file.path for file in found if file.role == "description"),
        sample=one.sample,
    )

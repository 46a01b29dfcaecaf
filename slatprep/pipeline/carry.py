"""What a new store takes over unchanged from the existing one: assets, shards, chunks.

An update keeps the order of the rows. What did not change stays where it is, what
changed takes the place of what it was, and what is new comes behind, by id. So shards
before the first change, and after it where no asset's number of voxels changed,
are the same files; of a shard that changes, chunks are copied as they are packed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slatprep.normalize import ranges_from_extents
from slatprep.parameters import StoreParameters, percentiles_of
from slatprep.pipeline.context import BuildContext
from slatprep.pipeline.plan import Names, PlannedAsset
from slatprep.pipeline.previous import PreviousBuild
from slatprep.pipeline.seen import Seen
from slatprep.pipeline.spool import SpooledAsset
from slatprep.provenance.make import origin
from slatprep.records import AssetPair, Contents, LatentMoments, Normalization
from slatprep.storage.files import take_file
from slatprep.storage.place import storage_of
from slatprep.store.layout import arrays_with, rows_per_shard
from slatprep.store.records import RECORD_ARRAY, RECORDS_IN_SHARD
from slatprep.store.shard_writer import Written
from slatprep.store.unmoved import Unmoved, unmoved


@dataclass(frozen=True, slots=True, eq=False)
class KeptAsset:
    """An asset whose rows are taken from the existing store.

    Attributes
    ----------
    asset_id : str
        Id of the row.
    key : str
        What it was made from and how.
    row : int
        Its row there.
    n_voxels : int
        Its SLAT voxels.
    extent : ndarray of float64, shape (P, 2)
        What `slatprep.normalize.property_extent` gave.
    clipped : ndarray of int64, shape (P,)
        Values of its voxels outside the ranges.
    latents : LatentMoments or None
        Of its latents.
    record : bytes
        Digest of its record as the existing store has it.
    names : Names or None
        Where its record has other ones.
    merged : bool
        Whether its labels are merged of several annotations.
    """

    asset_id: str
    key: str
    row: int
    n_voxels: int
    extent: NDArray[np.float64]
    clipped: NDArray[np.int64]
    latents: LatentMoments | None
    record: bytes
    names: Names | None = None
    merged: bool = False


MOST_BEHIND = 0.1
"""The most assets that an update adds behind the others, as a share of those. To pack a row that is
there takes a tenth of the time that a new asset takes."""

Row = SpooledAsset | KeptAsset
"""An asset that goes into a store."""


def kept_assets(
    unchanged: Sequence[AssetPair],
    plan: Mapping[str, PlannedAsset],
    made: Sequence[SpooledAsset],
    context: BuildContext,
    seen: Seen,
    given: Normalization | None,
    declared: Contents,
) -> list[KeptAsset] | None:
    """Return the unchanged assets, if their rows can be taken over; None where one cannot.

    They can where the ranges stay as they are, no pass over the whole dataset may
    change them, and the rest of what decides a store's bytes is the same.

    Parameters
    ----------
    unchanged : sequence of AssetPair
        Those whose alignment is in the existing store.
    plan : mapping of str to PlannedAsset
        What is to be done by id.
    made : sequence of SpooledAsset
        The other assets that go in.
    context : BuildContext
        The build.
    seen : Seen
        What the last build found of them.
    given : Normalization or None
        Ranges that do not depend on the dataset.
    declared : Contents
        What the sources hold.
    """
    previous, parameters = context.previous, context.parameters
    if previous is None:
        return None
    if parameters.consensus.settle or parameters.witness.settle:
        return None
    normalize = parameters.normalize
    if given is None and (normalize.objects != "all" or percentiles_of(normalize.ranges)):
        return None  # Such ranges are of the values of all fields.
    store = previous.store
    before = dict(store.attributes["build"])
    tables = [(one.properties, one.classes) for one in (store.contents, declared)]
    if tables[0] != tables[1] or {**before, "name": ""} != {**origin(parameters), "name": ""}:
        return None
    sizes, kept = np.diff(store.offsets).tolist(), []
    for pair in unchanged:
        planned = plan[pair.asset_id]
        found = seen.found(planned.key)
        if found is None:
            return None
        row = store.find(pair.asset_id)
        told = (*found[1:], planned.names, bool(pair.others))
        kept.append(KeptAsset(pair.asset_id, planned.key, row, sizes[row], *told))
    rows: list[Row] = [*kept, *made]
    if not rows or store.merges != any(asset.merged for asset in rows):
        return None  # An array more, or less, is written anew.
    extents = [asset.extent for asset in rows]
    ranges = given or ranges_from_extents(extents, normalize.ranges, declared.properties)
    return kept if ranges == store.normalization else None


def in_order(assets: Sequence[Row], previous: PreviousBuild | None, compact: bool) -> list[Row]:
    """Return assets in the order of rows: by id, or as in the existing store, new ones last.

    Where so many are new that packing all rows again costs no more than they do, it is by id.

    Parameters
    ----------
    assets : sequence of SpooledAsset or KeptAsset
        Those that go in.
    previous : PreviousBuild or None
        The store that rows are taken from.
    compact : bool
        Whether to take them by id nevertheless.
    """
    by_id = sorted(assets, key=lambda asset: asset.asset_id)
    if compact or previous is None:
        return by_id
    place = {asset_id: row for row, asset_id in enumerate(previous.store.ids)}
    new = sum(asset.asset_id not in place for asset in assets)
    if new > MOST_BEHIND * len(place):
        return by_id
    return sorted(by_id, key=lambda asset: place.get(asset.asset_id, len(place)))


class Carried:
    """What a new store takes over from the existing one.

    Parameters
    ----------
    previous : PreviousBuild
        The existing store, every file of which has been compared with its digest.
    assets : sequence of SpooledAsset or KeptAsset
        Those of the new store, by row.
    parameters : StoreParameters
        Sizes of the chunks and shards of both.

    Attributes
    ----------
    previous : PreviousBuild
        The same.
    rows : dict of str to Unmoved
        By group, ``voxel``, ``grid`` or ``record``, the rows that stay where they are.
    per_shard : dict of str to int
        Likewise, rows of a shard of the new store.
    """

    def __init__(
        self, previous: PreviousBuild, assets: Sequence[Row], parameters: StoreParameters
    ) -> None:
        self.previous = previous
        before = previous.store.offsets.tolist()
        offsets = [0, *accumulate(asset.n_voxels for asset in assets)]
        there = [
            (row, asset)
            for row, asset in enumerate(assets)
            if isinstance(asset, KeptAsset) and asset.row == row
        ]
        ends = list(pairwise(offsets))
        voxels = [ends[row] for row, _ in there if before[row] == offsets[row]]
        grids = [(row, row + 1) for row, _ in there]
        records = [(row, row + 1) for row, asset in there if asset.names is None]
        sizes = len(before) - 1, len(assets)
        per_shard = [rows_per_shard(parameters, rows) for rows in (before[-1], offsets[-1])]
        self.per_shard = {
            "voxel": per_shard[1],
            "grid": parameters.grid_assets_per_shard,
            "record": RECORDS_IN_SHARD,
        }
        alike = per_shard[0] == per_shard[1]
        self.rows: dict[str, Unmoved] = {
            "voxel": unmoved(voxels, before[-1], offsets[-1], alike),
            "grid": unmoved(grids, *sizes),
            "record": unmoved(records, *sizes),
        }

    def take_shards(self, path: Path) -> tuple[dict[str, Written], frozenset[int]]:
        """Give a new store the shards that are the same as a whole.

        On an object store they are named alone, as the server copies them when the others
        are uploaded.

        Parameters
        ----------
        path : Path
            The new store, on the disk of the other if that is on one; its arrays are created.

        Returns
        -------
        files : dict of str to Written
            The files taken over.
        records : frozenset of int
            Shards of records among them.
        """
        store = self.previous.store
        names = [layout.name for layout in arrays_with(store.merges)]
        arrays = [(name.partition("/")[0], name) for name in names]
        there, local = self.previous.files, storage_of(store.path).local
        taken: dict[str, Written] = {}
        records = set()
        for group, name in (*arrays, ("record", RECORD_ARRAY)):
            if group not in self.rows:
                continue
            rows, per_shard = self.rows[group], self.per_shard[group]
            for shard in range(-(-rows.new // per_shard)):
                if rows.holds_shard(shard * per_shard, (shard + 1) * per_shard):
                    file = store.reader(name).key(shard)
                    if local is not None:
                        take_file(local / file, path / file)
                    taken[file] = there[file]
                    if group == "record":
                        records.add(shard)
        return taken, frozenset(records)

"""Bring a store of format 1 to today's, without its sources and without aligning again.

What format 1 lacks follows from what it holds: places from the transform,
confidences and verdict by judging the alignment in its records as a build
would. All other rows are taken over byte by byte.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.judge import judge
from slatprep.pipeline.rewrite import Source, places_of_sources, write_rows
from slatprep.pipeline.summary import BuildSummary
from slatprep.provenance.record import AssetRecord
from slatprep.provenance.stored import StoredRecords
from slatprep.readers.slat import checked_latents
from slatprep.records import (
    Annotation,
    Judgement,
    LatentMoments,
    Place,
)
from slatprep.store import Store, open_store
from slatprep.store.integrity import file_findings, metadata_findings
from slatprep.store.layout import FORMAT_VERSION
from slatprep.workers import Progress


def upgrade_store(
    store: str | Place,
    out: str | Place | None = None,
    *,
    manifests: str | Place | None = None,
    progress: Progress | None = None,
) -> BuildSummary | None:
    """Make a store of today's format of one of format 1.

    Parameters
    ----------
    store : str or Place
        The store; its records keep the key and the code that aligned them, so a
        build over it aligns anew.
    out : str or Place, optional
        The new store; by default it replaces the old one, in one step.
    manifests : str or Path, optional
        Folder of its records; by default beside it.
    progress : callable, optional
        Called with the shards written and those there are.

    Returns
    -------
    BuildSummary or None
        What it holds; None where the store has today's format already.

    Raises
    ------
    StoreError
        If it cannot be read or is not as it was written, or the disk does not take the new one.
    InputError
        If what it holds of an asset is no SLAT.
    """
    opened = open_store(store)
    if opened.format_version == FORMAT_VERSION:
        return None
    damaged = [*metadata_findings(opened.path), *file_findings(opened, jobs=1)[1]]
    if damaged:
        first = min(damaged, key=str)
        raise StoreError(f"{opened.path}/{first}; `slatprep verify` says more")
    judged = _Judged(opened)
    source = Source(opened, judged, opened.attributes["build"], places_of_sources(opened))
    rows = [(source, row) for row in range(len(opened))]
    return write_rows(
        rows,
        opened.normalization,
        source.build,
        opened.path if out is None else out,
        manifests,
        progress,
        opened.contents,
        in_place=out is None,
    )


class _Judged(StoredRecords):
    """The records of a store of format 1 as today's build would judge them, and rows it lacks."""

    def __init__(self, store: Store) -> None:
        super().__init__(store)
        self._known: dict[int, tuple[Judgement, LatentMoments]] = {}
        self._rows: tuple[int, dict[str, NDArray[Any]]] = (-1, {})

    def read(self, row: int) -> AssetRecord:
        """Return the record of a row, judged."""
        record = super().read(row)
        if row not in self._known:
            self._judge(row, record)
        judgement, moments = self._known[row]
        return replace(record, judgement=judgement, latents=moments)

    def rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Return rows of any array, those that the store does not hold among them."""
        column = name.removeprefix("voxel/")
        if column not in ("place", "confidence"):
            return super().rows(name, start, stop)
        row = int(np.searchsorted(self.store.offsets, start, side="right")) - 1
        if self._rows[0] != row:
            self._judge(row, super().read(row))
        first = int(self.store.offsets[row])
        return self._rows[1][column][start - first : stop - first]

    def _judge(self, row: int, record: AssetRecord) -> None:
        asset = self.store.asset(self.store.ids[row])
        annotation = Annotation(
            asset.properties_si, asset.material, asset.valid, asset.distance, asset.place
        )
        where = f"{self.store.path} [{asset.asset_id}]"
        latents = checked_latents(asset.coords, asset.feats, where)
        judgement, likely = judge(
            asset.field, latents, record.alignment, annotation, record.parameters.sample
        )
        self._known[row] = judgement, latents.moments
        self._rows = row, {"place": asset.place, "confidence": likely}

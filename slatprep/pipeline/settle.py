"""What the passes over a whole dataset share: an asset of the spool, placed or judged anew.

They work on what the first pass left in the spool and change nothing there: an
asset that comes out otherwise is written again under a key of its own. Its
record keeps what the first pass found, so the next build does not align it
again, with these passes or without.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace

from slatprep.align.deformation import map_of
from slatprep.align.settle import refit
from slatprep.judge import judge
from slatprep.parameters import BuildParameters
from slatprep.pipeline.spool import Spool, SpooledAsset
from slatprep.provenance.record import AssetRecord, FailedRecord, FirstPass
from slatprep.provenance.record_json import to_json
from slatprep.records import Alignment, Annotation, Judgement, MaterialField, StructuredLatents
from slatprep.sample import sample


class Reopened:
    """A finished asset, read back from the spool.

    Parameters
    ----------
    asset : SpooledAsset
        Which.
    spool : Spool
        Where it lies.
    """

    def __init__(self, asset: SpooledAsset, spool: Spool) -> None:
        record = spool.record(asset.key)
        if isinstance(record, FailedRecord):
            raise TypeError(f"{record.asset_id}: an asset that failed is not judged anew")
        self._asset, self._spool = asset, spool
        self.record: AssetRecord = record
        self.latents: StructuredLatents = spool.latents(asset.key)
        self.annotation: Annotation = spool.annotation(asset.key)
        self.field: MaterialField = spool.field(asset.key)

    def placed(
        self, alignment: Alignment, parameters: BuildParameters
    ) -> tuple[Alignment, Annotation, Judgement]:
        """Look up and judge under another alignment; fit it first if its placement is another."""
        if alignment.transform is not self.record.alignment.transform:
            alignment = refit(alignment, self.field, self.latents, parameters.align)
        places = map_of(alignment).to_pixieverse(self.latents.centres)
        annotation = sample(self.field, places, parameters.sample)
        judgement, likely = judge(
            self.field, self.latents, alignment, annotation, parameters.sample
        )
        return alignment, replace(annotation, confidence=likely), judgement

    def put(
        self, alignment: Alignment, annotation: Annotation, judgement: Judgement
    ) -> SpooledAsset:
        """Write the asset with these beside itself; return what the parent keeps."""
        first = self.record
        record = replace(
            first,
            alignment=alignment,
            judgement=judgement,
            first_pass=first.first_pass or FirstPass(first.key, first.alignment, first.judgement),
            counts=replace(first.counts, valid=int(annotation.valid.sum())),
        )
        key = hashlib.sha256(to_json(record.without_duration())).hexdigest()
        put = self._spool.put(replace(record, key=key), self.field, self.latents, annotation)
        return replace(put, damaged=self._asset.damaged)

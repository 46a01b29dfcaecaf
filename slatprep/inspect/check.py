"""Recompute from the store alone whether an asset's alignment is good."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slatprep.align.quality import measure_quality
from slatprep.judge import THRESHOLDS, verdict_of
from slatprep.records import Consensus, Place, Verdict
from slatprep.sample import sample
from slatprep.store.reader import Store, StoredAsset, open_store
from slatprep.store.records import StoredRecords

QUALITY_TOLERANCE = 1e-3
"""Largest allowed difference of a recomputed figure: a voxel at the radius may round either way."""

TOLERANCES = {
    "voxel/valid": 0.0,
    "voxel/material": 0.0,
    "voxel/properties": 1e-5,
    "voxel/distance": 1e-3,
}
"""Largest allowed difference between an array and its recomputed values, by name.

Properties are normalised; converting float32 to SI and back costs digits. Distances are in
voxels.
"""

FITNESS = ("fitness", "fitness_backward")
"""Names of the shares of each side's boundary that lie near the other side's boundary."""

_QUALITY = ("fitness", "inlier_rmse", "fitness_backward", "inlier_rmse_backward", "overlap")

LIMITS = {
    "confidence": (">=", operator.ge, THRESHOLDS.good_confidence),
    "expected_accuracy": (">=", operator.ge, THRESHOLDS.good_accuracy),
    "valid_share": (">=", operator.ge, THRESHOLDS.good_valid_share),
    "ambiguity": ("<=", operator.le, THRESHOLDS.good_ambiguity),
}
"""Threshold of each figure in a good alignment: its sign, comparison and limit."""


@dataclass(frozen=True)
class Figure:
    """One number of a check: the `value` computed now and the `stored` one.

    `limit` is their largest allowed difference. A `settled` figure has no threshold, because
    consensus or a witness chose among the ties.
    """

    name: str
    value: float
    stored: float
    limit: float
    settled: bool = False

    @property
    def passes(self) -> bool | None:
        """Whether the value is that of a good alignment; None if it has no threshold."""
        if self.settled or self.name not in LIMITS:
            return None
        _, compare, limit = LIMITS[self.name]
        return bool(compare(self.value, limit))

    @property
    def threshold_text(self) -> str:
        """The threshold in words, like ``>= 0.8``, or ``settled``; empty if there is none."""
        if self.passes is None:
            return "settled" if self.settled else ""
        sign, _, limit = LIMITS[self.name]
        return f"{sign} {limit:g}"

    @property
    def ok(self) -> bool:
        """Whether the two agree; two NaN agree, such as the margins of a known frame."""
        both_unknown = math.isnan(self.value) and math.isnan(self.stored)
        return both_unknown or bool(abs(self.value - self.stored) <= self.limit)


@dataclass(frozen=True)
class AlignmentCheck:
    """The result of a check.

    Attributes
    ----------
    asset_id : str
        The asset.
    verdict : Verdict
        The verdict on the quality computed now.
    reasons : tuple of str
        Why the verdict is not better.
    stored_verdict : str
        The verdict that the store holds.
    figures : tuple of Figure
        Every number, computed now and as stored. Ambiguity and margin come from the store,
        because it does not hold the placements that give them.
    transform : ndarray of float64, shape (4, 4)
        PixieVerse frame to SLAT frame.
    radius : float
        Distance [voxel] up to which fitness counts a voxel as near the other side.
    unusual : tuple of str
        What is unusual about its values, masks, places or latents.
    ties : str
        What other placements that fit about as well would change, and what chose among them.
    settled_by : dict of str to float
        ``consensus`` or ``latents``, if either chose the placement, and the probability that the
        choice is right.
    """

    asset_id: str
    verdict: Verdict
    reasons: tuple[str, ...]
    stored_verdict: str
    figures: tuple[Figure, ...]
    transform: NDArray[np.float64]
    radius: float
    unusual: tuple[str, ...]
    ties: str
    settled_by: dict[str, float]

    def value(self, name: str) -> float:
        """Return the value of a figure; NaN if the store does not have it."""
        return next((figure.value for figure in self.figures if figure.name == name), math.nan)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Why the verdict is not better, and what chose among placements."""
        return (*self.reasons, *([self.ties] if self.settled_by else []))

    @property
    def words(self) -> tuple[str, ...]:
        """The reasons of the verdict: why it is not better, or what makes it good."""
        if self.reasons:
            return self.remarks
        if all(figure.ok for figure in self.figures if figure.name in _QUALITY):
            sure, same, placed = map(self.value, ("confidence", "same_object", "right_placement"))
            rests = (
                f"confidence {sure:.1%}: the two sides show the same object with a probability of "
                f"{same:.1%}, and its placement is right with {placed:.1%}"
            )
        else:  # The probabilities hold for the stored fit alone; the verdict uses the fitness.
            forward, backward = map(self.value, FITNESS)
            rests = (
                f"{forward:.1%} of the PixieVerse boundary and {backward:.1%} of the SLAT boundary "
                f"lie within {self.radius:g} voxel of the other side before any deformation"
            )
        return (f"{rests}; {self.ties}",)

    @property
    def consistent(self) -> bool:
        """Whether the stored figures agree with the stored grid, voxels and transform."""
        return self.verdict == self.stored_verdict and all(figure.ok for figure in self.figures)

    @property
    def ok(self) -> bool:
        """Whether the alignment is good and the store consistent."""
        return self.verdict is Verdict.GOOD and self.consistent


def check_alignment(store: Store | Place, name: str | int) -> AlignmentCheck:
    """Recompute an alignment's quality and annotation from the store alone.

    Raises StoreError if the store has no such asset.
    """
    store = open_store(store)
    asset = store.asset(name)
    radius = store.about.build.parameters.align.radius
    valid_share, differs = recompute_annotation(asset)
    record = StoredRecords(store).read(asset.index)
    alignment, columns = record.alignment, asset.columns
    # The columns are checked, so their values replace those of the record.
    judgement = replace(
        record.judgement,
        ambiguity=replace(record.judgement.ambiguity, material_share=float(columns["ambiguity"])),
        same_object=float(columns["same_object"]),
        right_placement=float(columns["right_placement"]),
        expected_accuracy=float(columns["expected_accuracy"]),
        contradicted=bool(columns["contradicted"]),
    )
    quality = measure_quality(asset.field, asset.latents, asset.transform, radius, alignment.ground)
    figures = [
        Figure(name, getattr(quality, name), float(columns[name]), QUALITY_TOLERANCE)
        for name in _QUALITY
    ]
    if not all(figure.ok for figure in figures):
        # The probabilities were computed for the stored fit and hold for no other.
        judgement = replace(judgement, same_object=math.nan, right_placement=math.nan)
    verdict, reasons = verdict_of(replace(alignment, quality=quality), judgement, valid_share)
    ambiguity = judgement.ambiguity.material_share
    ties = f"the labels of {ambiguity:.1%} of the voxels" if ambiguity else "no labels"
    ties, settled_by = f"placements that fit as well change {ties}", {}
    if (by := alignment.settled_by) is not None:
        name = "consensus" if isinstance(by, Consensus) else "latents"
        settled_by = {name: by.probability}
        ties = f"settled by {name}, right with a probability of {by.probability:.1%}: other {ties}"

    def stored(name: str, settled: bool = False) -> Figure:
        return Figure(name, float(columns[name]), float(columns[name]), 0, settled)

    def largest(name: str, array: str) -> Figure:
        most = float(differs[array].max(initial=0.0))
        return Figure(f"largest change of a {name}", most, 0, TOLERANCES[array])

    figures += [
        Figure("valid_share", valid_share, float(columns["valid_share"]), QUALITY_TOLERANCE),
        stored("ambiguity", alignment.settled_by is not None),
        stored("margin"),
        Figure("voxels whose valid changes", differs["voxel/valid"].sum(), 0, 0),
        Figure("voxels whose material changes", differs["voxel/material"].sum(), 0, 0),
        largest("property", "voxel/properties"),
        largest("distance", "voxel/distance"),
    ]
    figures += map(stored, ("confidence", "same_object", "right_placement", "expected_accuracy"))
    if asset.merged:
        means = [("votes for its class", asset.votes[asset.valid])]
        spreads = zip(store.about.property_columns, asset.spread.T, strict=True)
        means += [(f"spread of {name}", own[~np.isnan(own)]) for name, own in spreads]
        for name, values in means:
            mean = float(values.mean(dtype=np.float64)) if len(values) else math.nan
            figures.append(Figure(f"mean {name}", mean, mean, 0))
    said, odd = str(columns["verdict"]), tuple(str(columns["unusual"]).splitlines())
    return AlignmentCheck(
        asset.asset_id, verdict, reasons, said, tuple(figures), asset.transform, radius, odd, ties,
        settled_by,
    )  # fmt: skip


def recompute_annotation(asset: StoredAsset) -> tuple[float, dict[str, NDArray[np.float64]]]:
    """Sample an asset's annotation again from the stored grid and compare it with the store.

    Returns the share of SLAT voxels that get an annotation now, and the difference (N,) of each
    voxel by the arrays of `TOLERANCES`. The difference of valid and material is 1 if they changed;
    that of properties is the largest over the properties. The stored grid is one annotation, so
    labels merged from several are compared only at voxels where all agree.
    """
    parameters = asset.store.about.build.parameters.sample
    # The lookup only copies properties, so they can stay normalised.
    annotation = sample(asset.normalised_field, asset.place, parameters)
    changes = functools.reduce(np.maximum, np.abs(annotation.properties - asset.properties).T)
    both = annotation.valid & asset.valid
    valid, material = annotation.valid != asset.valid, annotation.material != asset.material
    share = float(annotation.valid.mean())
    if asset.merged:
        valid, material = annotation.valid & ~asset.valid, material & both & (asset.votes == 1)
        both &= ~(asset.spread > 0).any(axis=1)
        share = float(asset.valid.mean())
    differences = {
        "voxel/valid": valid,
        "voxel/material": material,
        "voxel/properties": np.where(both, changes, 0.0),
        "voxel/distance": np.abs(annotation.distance - asset.distance),
    }
    return share, {name: difference.astype(np.float64) for name, difference in differences.items()}


def choose_assets(
    store: Store, asset_ids: Iterable[str] = (), worst: int = 0, ambiguous: bool = False
) -> list[str]:
    """Choose assets to check, each once: the named assets, then the worst, then the ambiguous.

    The `worst` are sorted by verdict (failed first), then confidence, then the lower of the two
    fitness values. `ambiguous` adds all assets above the threshold, the most ambiguous first.
    """
    rows = [store.match(asset_id) for asset_id in asset_ids]
    if worst:
        places = {Verdict.FAILED: 0, Verdict.DOUBTFUL: 1, Verdict.GOOD: 2}
        rank = [places.get(verdict, -1) for verdict in store.column("verdict")]
        figures = store.column("confidence"), np.minimum(*map(store.column, FITNESS))
        # Assets with NaN come first.
        confidence, fitness = (np.nan_to_num(figure, nan=-1.0) for figure in figures)
        rows += np.lexsort((fitness, confidence, rank))[:worst].tolist()
    if ambiguous:
        share = store.column("ambiguity")
        order = np.argsort(-share, kind="stable")
        rows += order[share[order] > THRESHOLDS.good_ambiguity].tolist()
    return [store.ids[row] for row in dict.fromkeys(rows)]

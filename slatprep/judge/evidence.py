"""Measure the figures of an alignment, and of its voxels, that determine the confidence."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.frames import VOXEL_SIZE, places_of, split_transform
from slatprep.judge.ambiguity import HARMLESS, NOTABLE, notable
from slatprep.normalize import property_extent, to_mapped
from slatprep.records import UNANNOTATED, Alignment, Annotation, MaterialField, StructuredLatents
from slatprep.sample import TOLERANCE, same_within


class Figure(NamedTuple):
    """What a figure of an alignment says, and who may weigh it.

    Attributes
    ----------
    sign : int
        1 if right pairs have larger values, -1 if smaller ones.
    shows : str
        What a bad value speaks of: another object's ``shape``, a fit's ``roughness``, or another
        ``placement``.
    learned : bool
        Whether the decoys of a dataset may change its weight; see `slatprep.judge.decoys`.
    """

    sign: int
    shows: str = "roughness"
    learned: bool = False


MEANING = {
    "score_slat": Figure(1), "score_pixieverse": Figure(1), "score_similarity": Figure(1, "shape"),
    "within_1": Figure(1), "within_2": Figure(1, "shape"), "within_3": Figure(1, "shape"),
    "moved": Figure(-1, "shape", learned=True), "moved_most": Figure(-1, "shape"),
    "bending": Figure(-1, "shape", learned=True), "stretch": Figure(-1, "shape", learned=True),
    "scale": Figure(-1, "shape"), "offset": Figure(-1), "margin": Figure(1, "placement"),
    "clear_by": Figure(1, "placement"), "ties": Figure(-1, "placement"), "fitness": Figure(1),
    "fitness_backward": Figure(1), "valid_share": Figure(1, learned=True), "distance": Figure(-1),
    "depth": Figure(-1), "alike": Figure(-1, "placement"), "ground": Figure(-1, "shape"),
    "directions_near": Figure(-1, learned=True), "directions_middle": Figure(-1, learned=True),
    "directions_worst": Figure(-1, "shape", learned=True), "blocks_near": Figure(1, learned=True),
    "blocks_middle": Figure(1, learned=True), "blocks_far": Figure(1, "shape", learned=True),
    "slat_within_half": Figure(1), "slat_within_1": Figure(1, learned=True),
    "slat_within_15": Figure(1), "pixieverse_within_half": Figure(1),
    "pixieverse_within_1": Figure(1, learned=True), "pixieverse_within_15": Figure(1),
}  # fmt: skip
"""Every figure of an alignment by name; `evidence_of` has their values in this order."""

FIGURES = tuple(MEANING)

RADII = (1, 2, 4, 7)
"""Distances [voxel] at which the classes around a voxel's position are compared."""

VOXEL_FIGURES = (
    *(f"others_{radius}" for radius in RADII),
    *(f"others_{radius}_rough" for radius in RADII),
    *(f"others_{radius}_unsure" for radius in RADII),
    "distance", "depth", "moved", "asset_unsure", "asset_rough", "asset_distance", "asset_moved",
)  # fmt: skip
"""Names of a voxel's figures, in the order of `confidence.voxel_figures`."""

MARGIN_CAP = 0.3
"""Largest margin; larger margins are reduced to it."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The surroundings of N voxels' positions in the PixieVerse frame.

    Attributes
    ----------
    others, solid : ndarray of float32, shape (N, 4)
        Shares of the cells at `RADII`: annotated cells with another class (without
        classes, with other properties) among annotated ones, and annotated cells
        among all.
    distance : ndarray of float32, shape (N,)
        Distance to the annotation used, in voxels.
    moved : ndarray of float32, shape (N,)
        Distance by which the deformation moves the voxel's position, in voxels.
    tied : ndarray of float32, shape (N,)
        Share of the tied placements, with the chosen one, that give the voxel another
        class or notably other properties. If a consensus or latents chose, the probability
        that another one is right, times the share of the others that do. It is 0 if the mean is
        at most `HARMLESS`.
    """

    others: NDArray[np.float32]
    solid: NDArray[np.float32]
    distance: NDArray[np.float32]
    moved: NDArray[np.float32]
    tied: NDArray[np.float32]

    @property
    def depth(self) -> NDArray[np.float32]:
        """Share of annotated cells two voxels away, less the half that a surface has."""
        return self.solid[:, 1] - np.float32(0.5)

    def where(self, chosen: NDArray[np.bool_]) -> Surroundings:
        """Return the surroundings of the `chosen` (N,) voxels."""
        return Surroundings(*(getattr(self, field.name)[chosen] for field in fields(self)))


def surroundings_of(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    annotation: Annotation,
    tied: NDArray[np.float32],
) -> Surroundings:
    """Measure the surroundings of the positions at which SLAT voxels were looked up.

    `tied` (N,) comes from `slatprep.judge.measure_ambiguity`.
    """
    from slatprep.geometry.surroundings import labelled, shares_around

    of_voxels, labels = _labels_of(field, annotation)
    cells = labelled(field.voxels, of_voxels, max(RADII), UNANNOTATED)
    others, solid = shares_around(cells, annotation.place, labels, RADII, UNANNOTATED)
    moved = np.zeros(len(annotation.place), dtype=np.float32)
    if alignment.deformation is not None:
        before = places_of(latents.centres, alignment.transform).astype(np.float32)
        moved = np.linalg.norm(annotation.place - before, axis=1) / np.float32(VOXEL_SIZE)
    return Surroundings(others, solid, annotation.distance, moved, tied)


def _labels_of(
    field: MaterialField, annotation: Annotation
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return a label of each annotated voxel (K,), and of each SLAT voxel (N,).

    Without classes, voxels have the same label if each property rounds to the same multiple of
    `NOTABLE` times its extent. If there are more than 255 combinations, multiples are coarser.
    """
    if field.classified:
        return field.material, annotation.material
    number, _ = _combinations(_steps(field, annotation)[0])
    every = np.minimum(number, UNANNOTATED - 1).astype(np.uint8)
    own = np.full(len(annotation.valid), UNANNOTATED, dtype=np.uint8)
    own[annotation.valid] = every[len(field.properties) :]
    return every[: len(field.properties)], own


def labels_hold(
    field: MaterialField, annotation: Annotation, off: NDArray[np.float64], tied: bool = False
) -> bool:
    """Return whether rounding of the properties leaves the labels of `surroundings_of` the same.

    It changes each mapped property by at most `off` (P,). Classes are never rounded. With ties,
    rounding may change what counts as the same if it is coarse beside the smallest limit of that.
    """
    if tied:
        smallest = np.abs(to_mapped(field.properties, field.table)).min(axis=0)
        if (4.0 * off > TOLERANCE * same_within(smallest, field.table, notable(field))).any():
            return False
    if field.classified:
        return True
    steps, size = _steps(field, annotation)
    _, coarsest = _combinations(steps)
    # Four errors add up: of the value, of the end that it is measured from, and of the two ends.
    slack = 4.0 * off / size
    coarse = 1
    while coarse <= coarsest:
        to_border = np.abs(steps / coarse - np.floor(steps / coarse) - 0.5) * coarse
        if (to_border <= slack).any():
            return False
        coarse *= 2
    return True


def _steps(
    field: MaterialField, annotation: Annotation
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mapped properties of annotated and valid voxels in steps, and a step's size (P,)."""
    ends = property_extent(field)
    size = NOTABLE * np.where(ends[:, 1] > ends[:, 0], ends[:, 1] - ends[:, 0], 1.0)
    values = np.concatenate([field.properties, annotation.properties[annotation.valid]])
    return (to_mapped(values, field.table) - ends[:, 0]) / size, size


def _combinations(steps: NDArray[np.float64]) -> tuple[NDArray[np.intp], int]:
    """Return the number of each combination of rounded steps, and the multiple for rounding."""
    coarse = 1
    while True:
        found, number = np.unique(np.rint(steps / coarse), axis=0, return_inverse=True)
        if len(found) <= UNANNOTATED or coarse > 1.0 / NOTABLE:
            return number.reshape(-1), coarse
        coarse *= 2


def evidence_of(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    annotation: Annotation,
    around: Surroundings,
    ambiguity: float,
) -> NDArray[np.float64]:
    """Return the `FIGURES` of an alignment of any engine.

    `ambiguity` is the share of the voxels whose labels depend on the choice among ties. Ties that
    change nearly none, as of a ball, count as one placement. Then ``ties`` is 0, ``margin`` and
    ``clear_by`` are NaN, and ``alike`` is 1. The same holds if a consensus or latents chose among
    ties. Figures of the agreement that were not measured are NaN.
    """
    fit = alignment.figures
    if fit is None:
        from slatprep.align.figures import measure_figures

        fit = measure_figures(field, latents, alignment)
    count, margin = len(alignment.open_placements), min(alignment.margin, MARGIN_CAP)
    clear_by = fit.clear_by
    if (count and ambiguity <= HARMLESS) or alignment.settled_by is not None:
        count, margin, clear_by = 0, math.nan, math.nan
    _, _, scale = split_transform(alignment.transform)
    agreement = np.full(len(FIGURES) - FIGURES.index("directions_near"), np.nan)
    if fit.agreement is not None:
        agreement = np.hstack(astuple(fit.agreement))
    return np.array(
        [
            fit.score_slat,
            fit.score_pixieverse,
            fit.score_similarity,
            *fit.within,
            fit.moved,
            fit.moved_most,
            fit.bending,
            max(abs(math.log(stretch)) for stretch in fit.stretch),
            abs(math.log(scale)),
            abs(fit.offset),
            margin,
            clear_by,
            math.log1p(count),
            alignment.quality.fitness,
            alignment.quality.fitness_backward,
            annotation.valid.mean(),
            np.minimum(annotation.distance, 5.0).mean(),
            around.depth.std(),
            float(math.isnan(margin)),
            float(alignment.ground is not None),
            *agreement,
        ],
        dtype=np.float64,
    )

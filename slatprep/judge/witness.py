"""Measure by latents which of several placements has the likelier labels.

If geometry cannot tell placements apart, latents may, provided that they know classes. A Gaussian
of the latents of each class is estimated from assets whose labels are sure, with one covariance for
all classes (linear discriminant analysis). An asset is never judged by a model that has seen its
object. Neighbouring voxels are much alike, so the sum of log likelihoods over a block of space has
to be calibrated. The sure assets serve for that: their labels are compared with the labels after
half a turn (Platt, "Probabilistic Outputs for Support Vector Machines", 1999, without a bias).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import chain, combinations
from operator import add
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, expit, logsumexp, softmax

from slatprep.geometry.frames import Array, places_of
from slatprep.judge.ambiguity import HARMLESS, compare_labels
from slatprep.parameters import SampleParameters
from slatprep.records import (
    BACKGROUND,
    RESOLUTION,
    UNANNOTATED,
    Alignment,
    Annotation,
    LatentChoice,
    MaterialField,
    StructuredLatents,
)
from slatprep.sample import sample, voxel_index_of

FOLDS = 5
"""Number of parts of a dataset, by object; a model of the others judges each part."""

DECISIVE = 0.95
"""Smallest probability at which a placement is treated as right."""

CHANCE = 1e-3
"""Probability of the observed agreement by chance below which latents are used."""

MOST_FACTOR = 1e4
"""Upper limit of the log odds of a block of usual strength; Platt's target keeps far below it."""

RARE = 0.005
"""Quantile of the sure assets' gains below which labels are contradicted, if they are also less
likely than classes drawn at random."""

OTHER_LABELS = 0.01
"""Largest share of voxels that differ between placements with the same labels."""

BLOCK = 8
"""Edge, in voxels, of a block that counts as one observation."""

REACH = 6.0
"""Largest distance, in voxels, from a position after half a turn to an annotated voxel."""

_Found = TypeVar("_Found")

_SHRINK = 1.0  # weight, in objects, of the mean of all latents in the mean of each class
_RIDGE = 1e-3  # share of a channel's variance


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over latents, each object with weight one: by class (K,), (K, C); of products (C, C)."""

    weight: Array
    total: Array
    products: Array

    @classmethod
    def summed(cls, some: Sequence[Moments], each: float = 1.0) -> Moments:
        """Return the sums over several, each with this weight."""
        arrays = ((one.weight, one.total, one.products) for one in some)
        return cls(*(each * reduce(add, of) for of in zip(*arrays, strict=True)))


@dataclass(frozen=True, eq=False)
class LatentModel:
    """Gaussians of latents by class, with one precision matrix, and the shares of the classes."""

    means: Array
    precision: Array
    shares: Array

    def log_likelihood(self, feats: NDArray[np.float32]) -> Array:
        """Return the log likelihood (N, K) of latents (N, C) by class, without a term of each row.

        The term -z P z / 2 is the same for all classes, and only differences count.
        """
        weights = self.precision @ self.means.T
        likely: Array = feats.astype(np.float64) @ weights - 0.5 * (self.means.T * weights).sum(0)
        return likely

    def gain(self, feats: NDArray[np.float32], material: NDArray[np.uint8]) -> float:
        """Return the mean log likelihood of labels (N,) less that of classes drawn at random.

        Voxels without a label do not count. Return 0 if no voxel has a label.
        """
        known = material != UNANNOTATED
        if not known.any():
            return 0.0
        likely, present = self.log_likelihood(feats[known]), self.shares > 0
        chance = logsumexp(likely[:, present], axis=1, b=self.shares[present])
        return float((likely[np.arange(len(chance)), material[known]] - chance).mean())


@dataclass(frozen=True, eq=False)
class LatentEvidence:
    """The evidence of an asset's latents, before it is weighted by their reliability.

    Attributes
    ----------
    support : ndarray of float64, shape (K,)
        Log likelihood under each placement, the chosen one first, over the voxels that
        have a class under all placements; K is 1 without ties.
    differing : ndarray of int64, shape (K, K)
        Number of these voxels whose class or properties differ between two placements.
    voxels : int
        Number of these voxels.
    gain : float
        `LatentModel.gain` of the asset's labels.
    against : tuple of ndarray of float64, shape (B,)
        Log likelihood of the labels less that of the labels after half a turn about
        each of three axes, in B blocks. A turn that changes too few classes is left
        out.
    """

    support: Array
    differing: NDArray[np.int64]
    voxels: int
    gain: float
    against: tuple[Array, ...]


@dataclass(frozen=True)
class Reliability:
    """The reliability of latents: how those of sure assets fit right and wrong labels.

    Attributes
    ----------
    witnesses, agreeing : int
        Number of objects with sure assets that could be compared, and of those most of whose
        assets have latents that fit their own labels best.
    factor : float
        Factor of a log likelihood; 0 if latents are not used.
    least_gain : float
        Gain below which latents contradict labels; minus infinity if they are not used.
    """

    witnesses: int
    agreeing: int
    factor: float
    least_gain: float


def fold_of(object_id: str, folds: int = FOLDS) -> int:
    """Return which part of the dataset, 0..folds - 1, an object belongs to."""
    return int(hashlib.sha256(object_id.encode()).hexdigest()[:8], 16) % folds


def moments_of(
    feats: NDArray[np.float32], material: NDArray[np.uint8], labels: int = BACKGROUND
) -> Moments:
    """Return the moments of one asset from its latents (N, C) and classes (N,) below `labels`."""
    known = material < labels
    z, classes = feats[known].astype(np.float64), material[known]
    one = 1.0 / max(len(z), 1)
    total = np.zeros((labels, z.shape[1]))
    np.add.at(total, classes, z)
    weight = np.bincount(classes, minlength=labels).astype(np.float64)
    return Moments(one * weight, one * total, one * (z.T @ z))


def fit_models(moments: Iterable[tuple[str, Moments]]) -> list[LatentModel] | None:
    """Fit, for each part, a model of the latents of the classes in all other parts.

    `moments` has the object id and the moments of each sure asset, in an order that does not depend
    on the number of jobs. Return None if the other parts of any part have fewer than two classes.
    """
    sums: dict[int, list[Moments]] = {}
    for object_id, own in by_object(moments).items():
        sums.setdefault(fold_of(object_id), []).append(Moments.summed(own, 1.0 / len(own)))
    models = []
    for fold in range(FOLDS):
        others = [Moments.summed(sums[other]) for other in sorted(sums) if other != fold]
        seen = Moments.summed(others) if others else None
        if seen is None or np.count_nonzero(seen.weight) < 2:
            return None
        models.append(_model_of(seen))
    return models


def by_object(found: Iterable[tuple[str, _Found]]) -> dict[str, list[_Found]]:
    """Return what was found of assets, by their object."""
    grouped: dict[str, list[_Found]] = {}
    for object_id, one in found:
        grouped.setdefault(object_id, []).append(one)
    return grouped


def _model_of(seen: Moments) -> LatentModel:
    objects = seen.weight.sum()
    mean = seen.total.sum(axis=0) / objects
    present = seen.weight > 0
    by_class = seen.total[present]
    between = (by_class / seen.weight[present, None]).T @ by_class
    variance = np.diag(seen.products) / objects - mean**2
    ridge = _RIDGE * np.diag(np.where(variance > 0, variance, 1.0))
    precision: Array = np.linalg.inv((seen.products - between) / objects + ridge)
    means = (seen.total + _SHRINK * mean) / (seen.weight[:, None] + _SHRINK)
    return LatentModel(means, precision, seen.weight / objects)


def weigh(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    material: NDArray[np.uint8],
    model: LatentModel,
    parameters: SampleParameters,
) -> LatentEvidence:
    """Compare an asset's latents with its labels, and with the labels of tied placements.

    `material` (N,) are its labels, 255 for none. The model must come from other objects.
    """
    likely = model.log_likelihood(latents.feats)
    labels, found = material[None], list[Annotation]()
    if alignment.placements:
        # The other placements have no deformation, so the best one is compared without it.
        tied = (alignment.transform, *(p.transform for p in alignment.placements))
        places = (places_of(latents.centres, transform) for transform in tied)
        found = [sample(field, place, parameters) for place in places]
        labels = np.stack([one.material for one in found])
    differing = np.zeros((len(labels),) * 2, dtype=np.int64)
    rows = np.flatnonzero((labels != UNANNOTATED).all(axis=0))
    for i, j in combinations(range(len(labels)), 2):
        count = np.count_nonzero(compare_labels(field, found[i], found[j])[0][rows])
        differing[i, j] = differing[j, i] = count
    support = np.array([likely[rows, one[rows]].sum() for one in labels])
    return LatentEvidence(
        support,
        differing,
        len(rows),
        model.gain(latents.feats, material),
        tuple(_against(field, latents, alignment, material, likely)),
    )


def _against(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    material: NDArray[np.uint8],
    likely: Array,
) -> Iterator[Array]:
    if len(latents.coords) < 2:
        return  # One voxel has no axes.
    index = voxel_index_of(field)
    places = places_of(latents.centres, alignment.transform)
    centre = places.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((places - centre).T))
    steps = (RESOLUTION // BLOCK) ** np.arange(3)
    cells = ((latents.centres + 0.5) * RESOLUTION).astype(np.intp)
    blocks = cells // BLOCK @ steps
    for axis in axes.T:
        turned = centre + (places - centre) @ (2.0 * np.outer(axis, axis) - np.eye(3))
        _, used = index.nearest(turned, limit=REACH)
        rows = np.flatnonzero((used >= 0) & (material != UNANNOTATED))
        own, other = material[rows], field.material[used[rows]]
        differ = own != other
        if np.count_nonzero(differ) > HARMLESS * len(rows):
            gains = likely[rows, own] - likely[rows, other]
            sums = np.bincount(blocks[rows], gains)
            yield sums[np.unique(blocks[rows[differ]])]


def reliability_of(evidence: Iterable[tuple[str, LatentEvidence]]) -> Reliability:
    """Measure the reliability of latents on assets whose labels are sure, with their object ids.

    Assets of one object share labels or latents, so they are one witness. The factor is 0 if
    latents do not prefer their own labels more often than by chance.
    """
    assets = list(evidence)
    compared = by_object((name, one.against) for name, one in assets if one.against).values()
    agreeing = sum(
        2 * sum(min(float(blocks.sum()) for blocks in against) > 0 for against in own) > len(own)
        for own in compared
    )
    factor = 0.0
    # The probability of at least that many heads in tosses of a coin.
    if compared and bdtrc(agreeing - 1, len(compared), 0.5) < CHANCE:
        factor = _factor([np.concatenate([*chain(*own)]) for own in compared])
    gains = np.array([one.gain for _, one in assets])
    least = min(0.0, float(np.quantile(gains, RARE))) if factor else -np.inf
    return Reliability(len(compared), agreeing, factor, least)


def _factor(compared: Sequence[Array]) -> float:
    """Return the factor that makes log likelihoods (B,) of blocks log odds, each object alike."""
    # Imported here: it takes half a second of CPU, which a build with nothing to do is spared.
    from scipy.optimize import brentq

    blocks = np.concatenate(compared)
    weight = np.concatenate([np.full(len(some), 1.0 / len(some)) for some in compared])
    unit = float(np.sqrt(np.average(blocks**2, weights=weight)))
    # Platt's target is below 1: agreement of all objects is no proof for the next one.
    target = (len(compared) + 1.0) / (len(compared) + 2.0)

    def slope(factor: float) -> float:
        return float(np.sum(weight * blocks / unit * (target - expit(factor * blocks / unit))))

    # If blocks do not favour their own labels on the whole, the slope is negative from the start.
    return brentq(slope, 0.0, MOST_FACTOR) / unit if slope(0.0) > 0.0 > slope(MOST_FACTOR) else 0.0


def choice_of(found: LatentEvidence, reliability: Reliability) -> tuple[int, LatentChoice] | None:
    """Choose among an asset's tied placements, if its latents are decisive.

    Return the number of the placement and the choice. Number 0 is the asset's own placement, which
    stays if it has the labels of the likeliest one. Return None if no tied placement changes
    labels, or if the latents are not decisive.
    """
    different = found.differing > OTHER_LABELS * max(found.voxels, 1)
    best = int(np.argmax(found.support))
    if reliability.factor == 0.0 or not different[best].any():
        return None
    probability = float(softmax(reliability.factor * found.support)[~different[best]].sum())
    # A choice cannot be more certain than the latents of sure objects are reliable.
    probability = min(probability, (reliability.agreeing + 1.0) / (reliability.witnesses + 2.0))
    if probability < DECISIVE:
        return None
    chosen = 0 if not different[best, 0] else best
    rivals = np.flatnonzero(different[best])
    rival = rivals[np.argmax(found.support[rivals])]
    evidence = float(found.support[best] - found.support[rival])
    return chosen, LatentChoice(
        probability,
        evidence,
        int(found.differing[best, rival]),
        reliability.witnesses,
        reliability.agreeing,
    )

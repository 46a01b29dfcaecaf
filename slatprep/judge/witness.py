"""What latents say of labels: under which of several placements they are likelier.

Where geometry cannot tell placements apart, latents may, if they know of
classes at all. Of every class a Gaussian of the latents is estimated from
assets whose labels are sure, with one covariance for all classes (linear
discriminant analysis); an asset is never judged by a model that has seen its
object. What the sum of log likelihoods over a block of space is worth,
neighbouring voxels being much alike, is calibrated on the sure assets: their
labels against those that they would have half a turn away (Platt,
"Probabilistic Outputs for Support Vector Machines", 1999, without a bias).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, expit, logsumexp, softmax

from slatprep.geometry.frames import Array, places_of
from slatprep.judge.evidence import HARMLESS
from slatprep.parameters import SampleParameters
from slatprep.records import (
    BACKGROUND,
    RESOLUTION,
    UNANNOTATED,
    Alignment,
    LatentChoice,
    MaterialField,
    StructuredLatents,
)
from slatprep.sample import lattice_of, sample

PARTS = 5
"""Parts of a dataset, by object, each judged by a model of the others."""

DECISIVE = 0.95
"""From this probability on a placement is taken to be the right one."""

CHANCE = 1e-3
"""Latents are used if so many sure assets agreeing would be rarer than this by chance."""

MOST_FACTOR = 1e4
"""Log odds that a block of usual strength can be worth; Platt's target keeps far below."""

RARE = 0.005
"""Labels are contradicted that are less likely than those of all but this share of sure assets,
and less likely than if their classes were drawn at random."""

OTHER_LABELS = 0.01
"""Tied placements that change the class of more than this share of the voxels differ in labels."""

BLOCK = 8
"""Edge, in voxels, of the blocks that count as one observation each."""

REACH = 6.0
"""Voxels that half a turn may carry a place off the nearest annotated voxel."""

_SHRINK = 1.0  # assets' worth of the mean of all latents in the mean of each class
_RIDGE = 1e-3  # of a channel's usual variance


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over latents, each asset's with weight one: of each class, and of all products."""

    weight: Array
    total: Array
    products: Array

    def __add__(self, other: Moments) -> Moments:
        """Return the sums over the assets of both."""
        return Moments(
            self.weight + other.weight, self.total + other.total, self.products + other.products
        )


@dataclass(frozen=True, eq=False)
class LatentModel:
    """Gaussians of latents by class, with one precision, and the classes' shares."""

    means: Array
    precision: Array
    shares: Array

    def log_likelihood(self, feats: NDArray[np.float32]) -> Array:
        """Return the log likelihood (N, K) of latents (N, C) by class, but for a term of each row.

        That term, -z P z / 2, is the same for all classes, and only differences count.
        """
        weights = self.precision @ self.means.T
        likely: Array = feats.astype(np.float64) @ weights - 0.5 * (self.means.T * weights).sum(0)
        return likely

    def gain(self, feats: NDArray[np.float32], material: NDArray[np.uint8]) -> float:
        """Return the mean log likelihood of labels (N,) less that of classes drawn at random.

        Voxels without a label do not count; 0 where none has one.
        """
        known = material != UNANNOTATED
        if not known.any():
            return 0.0
        likely, present = self.log_likelihood(feats[known]), self.shares > 0
        chance = logsumexp(likely[:, present], axis=1, b=self.shares[present])
        return float((likely[np.arange(len(chance)), material[known]] - chance).mean())


@dataclass(frozen=True, eq=False)
class LatentEvidence:
    """What an asset's latents say, before it is known how much that is worth.

    Attributes
    ----------
    support : ndarray of float64, shape (K,)
        Sum of the log likelihoods of the voxels that have a class under all
        placements, the one chosen first; K is 1 where nothing is tied.
    differing : ndarray of int64, shape (K, K)
        Of those, how many have other classes under the two placements.
    voxels : int
        How many those are.
    gain : float
        What `LatentModel.gain` says of its labels.
    against : tuple of ndarray of float64, shape (B,)
        Log likelihood of its labels less that of labels half a turn away, about
        each of three axes, in B blocks; a turn that changes too few classes is
        left out.
    """

    support: Array
    differing: NDArray[np.int64]
    voxels: int
    gain: float
    against: tuple[Array, ...]


@dataclass(frozen=True)
class Reliability:
    """How far latents can be relied on: how those of sure assets fit right and wrong labels.

    Attributes
    ----------
    witnesses, agreeing : int
        Sure assets that could be compared, and those whose latents fit their own labels
        best.
    factor : float
        By which a log likelihood is multiplied; 0 where latents are not used.
    least_gain : float
        Gain below which latents contradict labels; minus infinity where they are not used.
    """

    witnesses: int
    agreeing: int
    factor: float
    least_gain: float


def part_of(object_id: str) -> int:
    """Return the part of the dataset, 0..PARTS - 1, that an object belongs to."""
    return int(hashlib.sha256(object_id.encode()).hexdigest()[:8], 16) % PARTS


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
    """Estimate for each part the latents of the classes in all others.

    `moments` has the object id and the moments of each sure asset, in an order that does not depend
    on the number of jobs. None where the assets of all other parts have less than two classes.
    """
    sums: dict[int, Moments] = {}
    for object_id, some in moments:
        part = part_of(object_id)
        sums[part] = sums[part] + some if part in sums else some
    models = []
    for part in range(PARTS):
        others = [sums[other] for other in sorted(sums) if other != part]
        seen = reduce(add, others) if others else None
        if seen is None or np.count_nonzero(seen.weight) < 2:
            return None
        models.append(_model_of(seen))
    return models


def _model_of(seen: Moments) -> LatentModel:
    assets = seen.weight.sum()
    mean = seen.total.sum(axis=0) / assets
    present = seen.weight > 0
    by_class = seen.total[present]
    between = (by_class / seen.weight[present, None]).T @ by_class
    variance = np.diag(seen.products) / assets - mean**2
    ridge = _RIDGE * np.diag(np.where(variance > 0, variance, 1.0))
    precision: Array = np.linalg.inv((seen.products - between) / assets + ridge)
    means = (seen.total + _SHRINK * mean) / (seen.weight[:, None] + _SHRINK)
    return LatentModel(means, precision, seen.weight / assets)


def weigh(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    material: NDArray[np.uint8],
    model: LatentModel,
    parameters: SampleParameters,
) -> LatentEvidence:
    """Compare an asset's latents with its labels, and with those it could have instead.

    Its labels `material` (N,) are 255 where there is none; the model is of other objects.
    """
    likely = model.log_likelihood(latents.feats)
    labels = material[None]
    if alignment.placements:
        # The others have no deformation, so the best is compared without its own.
        tied = (alignment.transform, *(p.transform for p in alignment.placements))
        places = (places_of(latents.centres, transform) for transform in tied)
        labels = np.stack([sample(field, place, parameters).material for place in places])
    shared = (labels != UNANNOTATED).all(axis=0)
    rows = np.flatnonzero(shared)
    support = np.array([likely[rows, one[rows]].sum() for one in labels])
    differing = np.array(
        [[np.count_nonzero(one[rows] != two[rows]) for two in labels] for one in labels]
    )
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
    lattice = lattice_of(field)
    places = places_of(latents.centres, alignment.transform)
    centre = places.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((places - centre).T))
    steps = (RESOLUTION // BLOCK) ** np.arange(3)
    cells = ((latents.centres + 0.5) * RESOLUTION).astype(np.intp)
    blocks = cells // BLOCK @ steps
    for axis in axes.T:
        turned = centre + (places - centre) @ (2.0 * np.outer(axis, axis) - np.eye(3))
        _, used = lattice.nearest(turned, limit=REACH)
        rows = np.flatnonzero((used >= 0) & (material != UNANNOTATED))
        own, other = material[rows], field.material[used[rows]]
        differ = own != other
        if np.count_nonzero(differ) > HARMLESS * len(rows):
            gains = likely[rows, own] - likely[rows, other]
            sums = np.bincount(blocks[rows], gains)
            yield sums[np.unique(blocks[rows[differ]])]


def reliability_of(evidence: Sequence[LatentEvidence]) -> Reliability:
    """Find out from assets whose labels are sure what their latents are worth.

    The factor is 0 where these do not prefer their own labels more often than chance would have it.
    """
    compared = [one.against for one in evidence if one.against]
    agreeing = sum(min(float(blocks.sum()) for blocks in against) > 0 for against in compared)
    factor = 0.0
    # The probability of so many heads or more.
    if compared and bdtrc(agreeing - 1, len(compared), 0.5) < CHANCE:
        factor = _factor([np.concatenate(against) for against in compared])
    gains = np.array([one.gain for one in evidence])
    least = min(0.0, float(np.quantile(gains, RARE))) if factor else -np.inf
    return Reliability(len(compared), agreeing, factor, least)


def _factor(compared: Sequence[Array]) -> float:
    """Return the factor that makes log likelihoods of blocks (B,) log odds, by asset alike."""
    # Late: it takes half a second of CPU, which a build that has nothing to do would pay, too.
    from scipy.optimize import brentq

    blocks = np.concatenate(compared)
    weight = np.concatenate([np.full(len(some), 1.0 / len(some)) for some in compared])
    unit = float(np.sqrt(np.average(blocks**2, weights=weight)))
    # Platt's target: all agreeing is no proof that the next one will.
    target = (len(compared) + 1.0) / (len(compared) + 2.0)

    def slope(factor: float) -> float:
        return float(np.sum(weight * blocks / unit * (target - expit(factor * blocks / unit))))

    # Where nothing is compared for the slope falls from the start.
    return brentq(slope, 0.0, MOST_FACTOR) / unit if slope(0.0) > 0.0 > slope(MOST_FACTOR) else 0.0


def choice_of(found: LatentEvidence, reliability: Reliability) -> tuple[int, LatentChoice] | None:
    """Choose among an asset's tied placements, if its latents are decisive.

    Returns the number of the placement; 0 is the one that the asset has, which stands where its
    labels are those of the likeliest one. None where nothing tied changes labels, or the latents do
    not say enough.
    """
    different = found.differing > OTHER_LABELS * max(found.voxels, 1)
    best = int(np.argmax(found.support))
    if reliability.factor == 0.0 or not different[best].any():
        return None
    probability = float(softmax(reliability.factor * found.support)[~different[best]].sum())
    # A choice cannot be surer than the latents of sure assets are reliable.
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

"""Estimate how many verdicts are wrong by decoys: grids aligned with SLATs of other objects.

A decoy is wrong by construction, so decoys show what wrong pairs of this dataset look like.
Mass spectrometry counts its errors in this way:

- target-decoy competition (Elias and Gygi, Nature Methods 2007);
- a score learned on the decoys and cross-validated (Percolator: Kaell et al., Nature Methods 2007);
- a probability of an error for each match (PeptideProphet: Keller et al., Analytical Chemistry
  2002);
- the share of wrong matches, estimated from matches that score like decoys (Storey, Journal of
  the Royal Statistical Society B, 2002).

Decoys say nothing about a wrong placement of the right object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression, minimize
from scipy.special import expit

from slatprep.geometry.frames import Array
from slatprep.judge.calibration import SAME_OBJECT
from slatprep.judge.evidence import FIGURES, MEANING
from slatprep.judge.verdict import LEAST_DECOYS, LEAST_TARGETS
from slatprep.judge.witness import fold_of

Range = tuple[float, float]

FOLDS, ROUNDS = 3, 3
"""Number of parts of the objects, each scored by a fit to the others, and of rounds of fits."""

RIGHT_BELOW = 0.01
"""Largest rate of errors up to which a fit treats targets as right."""

RIDGE = 3.0
"""Strength with which a fit is held to the shipped model, relative to one sample of each side."""

LIKE_DECOYS = 0.3
"""Share of the decoys whose scores surpass a target that counts as wrong."""

DRAWS, LIKELY = 4_000, (0.025, 0.975)
"""Number of draws for an interval, and the quantiles at its ends."""

LEARNED = {name: figure.sign for name, figure in MEANING.items() if figure.learned}
"""Figures whose weight a dataset may change, and their signs."""


@dataclass(frozen=True, eq=False)
class ErrorRates:
    """Error rates of a dataset's verdicts, estimated by decoys.

    Attributes
    ----------
    refitted : bool
        Whether the score was learned on the decoys; else it is the shipped model's.
    wrong_share : float
        Share of the targets that show another object.
    wrong_share_range : tuple of float
        Interval of that share, with a probability of 0.95.
    good : int
        Number of targets that are called good.
    good_wrong : float
        Estimated number of good targets that show another object.
    good_wrong_range : tuple of float
        Interval of that number, with a probability of 0.95.
    scores, decoy_scores : ndarray of float64, shape (T,) and (D,)
        Logarithms of the odds that the object is the same.
    errors : ndarray of float64, shape (T,)
        Posterior probability that a target shows another object.
    rates : ndarray of float64, shape (T,)
        Smallest share of wrong targets in any set of all targets above a score, this one included.
    """

    refitted: bool
    wrong_share: float
    wrong_share_range: Range
    good: int
    good_wrong: float
    good_wrong_range: Range
    scores: Array
    decoy_scores: Array
    errors: Array
    rates: Array

    def kept(self, rate: float) -> tuple[int, float]:
        """Return the number of targets to keep for a share of wrong ones of at most `rate`.

        Return their lowest score as well; NaN if there are none.
        """
        kept = self.rates <= rate
        return int(kept.sum()), float(self.scores[kept].min()) if kept.any() else np.nan


def error_rates(
    targets: Array,
    decoys: Array,
    target_objects: Sequence[str],
    decoy_objects: Sequence[str],
    *,
    good: NDArray[np.bool_],
    good_decoys: NDArray[np.bool_],
    seed: int = 0,
) -> ErrorRates:
    """Estimate a dataset's errors from the `FIGURES` of its targets (T, F) and decoys (D, F).

    Objects (T,) and (D,) name the objects of their grids. Targets of one object may all be wrong
    together, so intervals and limits count objects. `good` (T,) and `good_decoys` (D,) tell which
    are called good. Intervals come from random draws with `seed`.
    """
    objects, others = len(set(target_objects)), len(set(decoy_objects))
    refitted = objects >= LEAST_TARGETS and others >= LEAST_DECOYS
    scores, decoy_scores = map(_shipped_scores, (targets, decoys))
    if refitted:
        folds = (np.array([fold_of(one, FOLDS) for one in own])
                 for own in (target_objects, decoy_objects))  # fmt: skip
        scores, decoy_scores = _refitted(targets, decoys, *folds)
    rng = np.random.default_rng(seed)
    share, shares = _wrong_share(scores, decoy_scores, objects, others, rng)
    low, high = _ends(shares)
    count, passed = len(targets), int(good_decoys.sum())
    passing = _drawn(passed / len(decoys), others, rng)
    most = int(good.sum())
    wrong = np.minimum(count * shares * passing, most)
    return ErrorRates(
        refitted=refitted,
        wrong_share=share,
        wrong_share_range=(min(low, share) if share else 0.0, high),
        good=most,
        good_wrong=float(min(count * share * (passed + 0.5) / (len(decoys) + 1.0), most)),
        good_wrong_range=_ends(wrong),
        scores=scores,
        decoy_scores=decoy_scores,
        errors=_posterior_errors(scores, decoy_scores, share),
        rates=_rates(scores, decoy_scores, share),
    )


def _ends(draws: Array) -> Range:
    low, high = np.quantile(draws, LIKELY)
    return float(low), float(high)


def _wrong_share(
    scores: Array, decoy_scores: Array, objects: int, others: int, rng: np.random.Generator
) -> tuple[float, Array]:
    """Return the estimated share of targets that score like decoys, and draws of that share.

    `objects` and `others` are the numbers of the objects of targets and of decoys.
    """
    limit = np.quantile(decoy_scores, 1.0 - LIKE_DECOYS, method="higher")
    low, low_decoys = (float(np.mean(values <= limit)) for values in (scores, decoy_scores))
    # The limit is a decoy itself, so the share of all decoys below it is distributed as its rank.
    rank = low_decoys * others
    shares = _drawn(low, objects, rng) / rng.beta(rank, others + 1 - rank, DRAWS)
    return min(low / low_decoys, 1.0), np.minimum(shares, 1.0)


def _drawn(share: float, count: int, rng: np.random.Generator) -> Array:
    """Draw what a share of so many may be: half of one is added on each side (Jeffreys' prior)."""
    return rng.beta(share * count + 0.5, (1.0 - share) * count + 0.5, DRAWS)


def _surpassed(scores: Array, by: Array) -> NDArray[np.intp]:
    """Return how many of `by` reach each score."""
    return len(by) - np.searchsorted(np.sort(by), scores, side="left")


def _rates(scores: Array, decoy_scores: Array, share: float) -> Array:
    """Return the smallest rate of wrong targets at which each target is kept."""
    # One more decoy is counted, as few decoys cannot show a rate near 0.
    wrong = (_surpassed(scores, decoy_scores) + 1.0) / (len(decoy_scores) + 1.0)
    kept = _surpassed(scores, scores)
    order = np.argsort(scores, kind="stable")
    rates = np.minimum(share * len(scores) * wrong / kept, 1.0)
    rates[order] = np.minimum.accumulate(rates[order])
    return rates


def _posterior_errors(scores: Array, decoy_scores: Array, share: float) -> Array:
    """Return the probability that each target is wrong; it never rises with the score."""
    # One more decoy with the highest score stands for the decoys that were not drawn.
    decoys = np.append(decoy_scores, max(scores.max(), decoy_scores.max()))
    values = np.concatenate([scores, decoys])
    each = share * len(scores) / len(decoys)
    wrong = np.repeat([0.0, 1.0], [len(scores), len(decoys)])
    weights = np.where(wrong > 0, max(each, 1e-12), 1.0)
    which = np.unique(values, return_inverse=True)[1]
    mass = np.bincount(which, weights)
    ratio = np.bincount(which, weights * wrong) / mass
    part = isotonic_regression(ratio, weights=mass, increasing=False).x[which][: len(scores)]
    errors: Array = np.minimum(part / np.maximum(1.0 - part, 1e-12), 1.0)
    return errors


def _refitted(
    targets: Array, decoys: Array, target_folds: NDArray[np.intp], decoy_folds: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Score the targets and decoys of each fold by a fit, from the shipped model, to the others."""
    both = np.concatenate([targets, decoys])
    folds = np.concatenate([target_folds, decoy_folds])
    decoy = np.arange(len(both)) >= len(targets)
    features = _features(both, decoy)
    scores = features[:, 0].copy()
    for _ in range(ROUNDS):
        rated = _rates(scores[~decoy], scores[decoy], 1.0)
        sure = np.zeros(len(both), dtype=bool)
        sure[: len(targets)] = rated <= RIGHT_BELOW
        found = scores.copy()
        for fold in np.unique(folds):
            seen = folds != fold
            right, wrong = seen & sure, seen & decoy
            if min(right.sum(), wrong.sum()) < LEAST_DECOYS // 2:
                return features[: len(targets), 0], features[len(targets) :, 0]
            weights = _fit(features[right], features[wrong])
            found[folds == fold] = features[folds == fold] @ weights[:-1] + weights[-1]
        scores = found
    return scores[: len(targets)], scores[len(targets) :]


def _shipped_scores(evidence: Array) -> Array:
    """Return the shipped model's logarithms of the odds, between -15 and 15."""
    # Probabilities are not used, as most decoys have the smallest one (`FLOOR`).
    odds: Array = SAME_OBJECT.contributions(evidence).sum(axis=1) + SAME_OBJECT.intercept
    return odds.clip(-15.0, 15.0)


def _features(evidence: Array, decoy: NDArray[np.bool_]) -> Array:
    """Return the shipped score and the figures `LEARNED`, in decoys' spreads; larger is better."""
    columns = [FIGURES.index(name) for name in LEARNED]
    chosen = np.nan_to_num(evidence[:, columns] * np.array(list(LEARNED.values())))
    centre, spread = chosen[decoy].mean(axis=0), chosen[decoy].std(axis=0)
    others = np.clip((chosen - centre) / np.maximum(spread, 1e-9), -4.0, 4.0)
    return np.column_stack([_shipped_scores(evidence), others])


def _fit(right: Array, wrong: Array) -> Array:
    """Fit weights and a constant to right and wrong samples, each side with a weight of one half.

    A ridge holds the shipped score's weight near 1 and the others near 0; none is negative.
    """
    x = np.concatenate([right, wrong])
    y = np.repeat([1.0, -1.0], [len(right), len(wrong)])
    weights = np.where(y > 0, 0.5 / len(right), 0.5 / len(wrong))
    prior = np.append(np.eye(1, x.shape[1])[0], 0.0)
    ridge = RIDGE / min(len(right), len(wrong)) * np.append(np.ones(x.shape[1]), 0.1)

    def loss(parameters: Array) -> tuple[float, Array]:
        odds = y * (x @ parameters[:-1] + parameters[-1])
        slope = -y * expit(-odds) * weights
        off = parameters - prior
        value = float((weights * np.logaddexp(0.0, -odds)).sum() + 0.5 * (ridge * off) @ off)
        return value, np.append(x.T @ slope, slope.sum()) + ridge * off

    bounds = [(0.0, None)] * x.shape[1] + [(None, None)]
    return np.asarray(minimize(loss, prior, jac=True, bounds=bounds, method="L-BFGS-B").x)

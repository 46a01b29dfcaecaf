"""Logistic models as data, which show each figure's part in a probability."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

FLOOR = 1e-3
"""Smallest distance of a probability from 0 and 1; the calibration has no data for a smaller
one."""


@dataclass(frozen=True)
class Term:
    """One figure of a model: clipped to `low`..`high`, less `usual`, times `weight`.

    ``usual`` is the mean over right samples, within the same bounds. So the product is what the
    figure adds to the logarithm of the odds, compared with a usual right sample. Two figures with
    one name and adjoining bounds are a piecewise linear function with one bend.
    """

    name: str
    weight: float
    usual: float
    low: float
    high: float


@dataclass(frozen=True)
class Logistic:
    """A logistic regression, and a curve that calibrates its probabilities.

    Attributes
    ----------
    names : tuple of str
        Names of the columns of values, in their order.
    terms : tuple of Term
        Terms of the model; terms of one name are adjacent.
    intercept : float
        Logarithm of the odds if all figures are as usual.
    curve : tuple of (float, float)
        Logarithm of the odds, and share of right samples found there; linear in between.
    """

    names: tuple[str, ...] = field(repr=False)
    terms: tuple[Term, ...]
    intercept: float
    curve: tuple[tuple[float, float], ...]

    @cached_property
    def _columns(self) -> NDArray[np.intp]:
        return np.array([self.names.index(term.name) for term in self.terms])

    @cached_property
    def _table(self) -> NDArray[np.float64]:
        return np.array([(f.weight, f.usual, f.low, f.high) for f in self.terms]).T

    def contributions(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return what each figure (..., F) adds to the logarithm of the odds; NaN adds nothing."""
        weight, usual, low, high = self._table
        parts = np.nan_to_num(weight * (np.clip(values[..., self._columns], low, high) - usual))
        added = np.zeros(values.shape)
        for column, part in zip(self._columns, np.moveaxis(parts, -1, 0), strict=True):
            added[..., column] += part
        return added

    def probability(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the probability for figures (..., F), within `FLOOR` of 0 and 1."""
        from slatprep.judge.odds import add_odds

        odds = np.full(values.shape[:-1], self.intercept)
        rows = values.reshape(-1, values.shape[-1])
        add_odds(rows, self._columns, self._table.astype(values.dtype), odds.reshape(-1))
        return self.calibrated(odds)

    def calibrated(self, odds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the probability for logarithms of odds, by the curve."""
        found = expit(odds)
        if self.curve:
            at, share = np.array(self.curve).T
            found = np.interp(odds, at, share)
        bounded: NDArray[np.float64] = np.clip(found, FLOOR, 1.0 - FLOOR)
        return bounded

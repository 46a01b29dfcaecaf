"""The logarithms of odds of a logistic model, for thousands of rows; a compiled inner loop."""

from __future__ import annotations

import numpy as np

from slatprep.geometry.kernel import kernel


@kernel()
def add_odds(values, columns, table, odds):  # type: ignore[no-untyped-def]
    """Add to `odds` (N,) what figures (N, F) say; one that is NaN adds nothing.

    `columns` (M,) says where each of the model's terms finds its figure, and `table` (4, M) its
    weight, what is usual, and its bounds.
    """
    for term in range(len(columns)):
        weight, usual, low, high = table[:, term]
        column = columns[term]
        for row in range(len(odds)):
            value = values[row, column]
            value = low if value < low else value
            value = high if value > high else value
            added = weight * (value - usual)
            odds[row] += np.float64(0.0) if np.isnan(added) else np.float64(added)

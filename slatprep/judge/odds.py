"""Add up logarithms of odds of a logistic model for thousands of rows; a compiled inner loop."""

from __future__ import annotations

import numpy as np

from slatprep.geometry.kernel import kernel


@kernel()
def add_odds(values, columns, table, odds):  # type: ignore[no-untyped-def]
    """Add a model's terms for figures (N, F) to the log odds `odds` (N,); NaN adds nothing.

    `columns` (M,) are the columns of the terms' figures. `table` (4, M) has the weight, the usual
    value, and the lower and upper bound of each term.
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

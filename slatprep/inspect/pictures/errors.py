"""Targets and decoys as two histograms, with the scores from which on few are wrong."""

from __future__ import annotations

import numpy as np
from scipy.special import logit

from slatprep.inspect.pictures import palette
from slatprep.inspect.pictures.canvas import STYLE, in_format, new_figure, write
from slatprep.pipeline.decoys import MeasuredErrors

RATES = {0.01: "-", 0.05: "--"}
"""Shares of wrong ones with a line, and how it is drawn."""

_WIDTH, _HEIGHT = 1200, 640
_TARGETS, _DECOYS = palette.ACCENT, palette.VERDICT_COLOURS["failed"]


def draw_errors(errors: MeasuredErrors, name: str, kind: str = "png") -> bytes:
    """Draw the scores of a store's alignments and of its decoys as a ``png``, ``svg`` or ``pdf``.

    Lines are the least scores that keep the share of wrong ones at `RATES`.
    """
    import matplotlib.style

    edges, counts = np.array(errors.edges), errors.counts
    with matplotlib.style.context(["default", STYLE]):
        figure = new_figure(_WIDTH, _HEIGHT)
        write(figure, 40, 48, f"Same object? {name}", weight="bold", size=12)
        for row, sentence in enumerate(errors.sentences()):
            write(figure, 40, 76 + 22 * row, sentence, size=7, color=palette.MUTED)
        axes = figure.add_axes((0.07, 0.13, 0.9, 0.6))
        axes.bar(edges[:-1], errors.targets, np.diff(edges), align="edge", color=_TARGETS,
                 alpha=0.7, label=f"{errors.assets:,} alignments of the dataset")  # fmt: skip
        decoys = f"{len(errors.decoys):,} decoys: grids with SLATs of other objects"
        axes.step(edges, [*counts, counts[-1]], where="post", color=_DECOYS, lw=1.6, label=decoys)
        for kept in errors.kept:
            if kept.rate in RATES and kept.assets:
                axes.axvline(kept.score, color=palette.INK, lw=1, ls=RATES[kept.rate],
                             label=f"{kept.assets:,} kept at {kept.rate:.0%} wrong")  # fmt: skip
        ticks = np.array([1e-4, 0.01, 0.5, 0.99, 0.9999])
        inside = (logit(ticks) >= edges[0]) & (logit(ticks) <= edges[-1])
        axes.set_xticks(logit(ticks)[inside], [f"{tick:.4g}" for tick in ticks[inside]])
        axes.set_xlabel("score, as a probability that the object is the same")
        axes.set_ylabel("count")
        axes.legend(frameon=False, loc="upper center")
        return in_format(figure, kind)

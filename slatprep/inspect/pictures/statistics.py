"""Draw the statistics of a store's voxels, or the errors of its alignments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from slatprep.inspect.pictures import canvas
from slatprep.inspect.statistics import Histogram, JointHistogram, StoreStatistics
from slatprep.pipeline.measured import MeasuredErrors
from slatprep.records import MATERIAL_CLASSES, MATERIAL_COLOURS, Property
from slatprep.store.reader import Store

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_CATEGORIES = 16
"""Largest number of categories with a bar; categories with most assets come first."""

_WIDTH, _HEAD, _FOOT = 1500, 170, 60
_LEFT, _GAP, _PLOT = 210, 100, 535
"""Left margin, gap between the two columns of plots, and width of a plot, in pixels."""
_HISTOGRAM, _JOINT, _BAR, _BETWEEN = 190, 480, 26, 90
"""Heights of each kind of plot, and of the gap between two rows, in pixels."""
_COLOURS = tuple(MATERIAL_COLOURS.values())
"""Colours of the classes by index."""
RATES = {0.01: "-", 0.05: "--"}
"""Line style of each share of wrong alignments that has a line."""

_SIDES = (("field", "PixieVerse fields, before the lookup"), ("slat", "SLAT voxels, after it"))


def draw_statistics(store: Store, statistics: StoreStatistics, kind: str = "png") -> bytes:
    """Draw the statistics of a store as a ``png``, ``svg`` or ``pdf``."""
    kept = sorted(statistics.categories, key=lambda one: -one.slat.assets)[:MOST_CATEGORIES]
    shown = [group for group in statistics.categories if group in kept]
    joint = (_JOINT + _BETWEEN) * (statistics.joint is not None)
    rows = len(statistics.histograms) * (_HISTOGRAM + _BETWEEN)
    height = _HEAD + rows + joint + _BAR * max(len(shown), 1) + _BETWEEN + _FOOT
    with canvas.styled():
        figure = canvas.new_figure(_WIDTH, height)
        _head(figure, store, statistics)
        for column, (side, _) in enumerate(_SIDES):
            top = _HEAD
            for histogram in statistics.histograms:
                _histogram(_axes(figure, column, top, _HISTOGRAM), histogram, side)
                top += _HISTOGRAM + _BETWEEN
            if statistics.joint is not None:
                axes = _axes(figure, column, top, _JOINT)
                _joint(axes, statistics.histograms, statistics.joint, side)
                top += joint
            bars = [getattr(group, side).classes for group in shown]
            names = [f"{canvas.cut(group.name, 14)} ({group.slat.assets:,})" for group in shown]
            names = names if column == 0 else [""] * len(names)
            _bars(_axes(figure, column, top, _BAR * max(len(bars), 1)), names, bars)
        return canvas.in_format(figure, kind)


def _head(figure: Figure, store: Store, statistics: StoreStatistics) -> None:
    canvas.write(figure, 40, 48, f"Statistics of {store.name}", weight="bold", size=12)
    counts = ", ".join(f"{count:,} {name}" for name, count in statistics.total.verdicts.items())
    what = "voxel weighs" if statistics.weight == "voxel" else "asset's voxels together weigh"
    words = (
        f"{statistics.assets_chosen:,} of {statistics.assets:,} assets ({counts}); "
        f"every {what} one; not annotated: {_percent(statistics.total.field.unannotated)} before, "
        f"not valid: {_percent(statistics.total.slat.unannotated)} after"
    )
    canvas.note(figure, 40, 74, words)
    coloured = [*zip(statistics.classes, _COLOURS, strict=False)]
    if len(coloured) > len(MATERIAL_CLASSES):  # There is space for the commonest alone.
        there = (one for one in coloured if one[0].field.voxels)
        coloured = sorted(there, key=lambda one: -one[0].field.voxels)
    entries = [(group.name, colour) for group, colour in coloured]
    canvas.draw_legend(figure, entries, (40, 103, _WIDTH - 40))
    for column, (_, title) in enumerate(_SIDES):
        left = _LEFT + column * (_PLOT + _GAP)
        canvas.write(figure, left, _HEAD - 14, title, size=8, weight="bold")


def _axes(figure: Figure, column: int, top: float, tall: float) -> Axes:
    return canvas.add_axes(figure, _LEFT + column * (_PLOT + _GAP), top, _PLOT, tall)


def _histogram(axes: Axes, histogram: Histogram, side: str) -> None:
    shares = _shares(getattr(histogram, side))
    upto = np.vstack([np.zeros(shares.shape[1]), np.cumsum(shares, axis=0)])
    for index in np.flatnonzero(shares.any(axis=1)):
        axes.stairs(
            upto[index + 1], histogram.edges, baseline=upto[index], fill=True, color=_COLOURS[index]
        )
    axes.set_xlim(histogram.edges[0], histogram.edges[-1])
    most = max(_shares(own).sum(axis=0).max() for own in (histogram.field, histogram.slat))
    axes.set_ylim(0, 1.05 * most or 1.0)
    axes.set_xlabel(_label(histogram), parse_math=False)
    axes.set_ylabel("share")


def _joint(axes: Axes, histograms: Sequence[Histogram], joint: JointHistogram, side: str) -> None:
    from matplotlib.colors import LinearSegmentedColormap, LogNorm

    shares = np.ma.masked_equal(_shares(getattr(joint, side)), 0.0)
    first, second = (one for one in histograms if one.name in joint.names)
    colours = LinearSegmentedColormap.from_list("shares", canvas.DISTANCE_COLOURS[1:])
    # The scale begins at 1e-5; smaller shares have its palest colour.
    mesh = axes.pcolormesh(
        *joint.edges, shares.T, cmap=colours, norm=LogNorm(1e-5, 1.0), rasterized=True
    )
    if side == _SIDES[-1][0]:
        bar = axes.figure.colorbar(mesh, cax=axes.inset_axes((1.02, 0, 0.02, 1)))
        bar.outline.set_visible(False)
        bar.set_label("share of voxels")
    axes.set_xlim(first.edges[0], first.edges[-1])
    axes.set_ylim(second.edges[0], second.edges[-1])
    axes.set_xlabel(_label(first), parse_math=False)
    axes.set_ylabel(_label(second), parse_math=False)


def _bars(axes: Axes, names: list[str], bars: list[dict[str, float]]) -> None:
    places = np.arange(len(bars))
    left = np.zeros(len(bars))
    for name, colour in zip(bars[0] if bars else (), _COLOURS, strict=False):
        shares = np.nan_to_num([bar[name] for bar in bars])
        axes.barh(places, shares, 0.8, left, color=colour)
        left = left + shares
    axes.set_xlim(0, 1)
    axes.set_ylim(max(len(bars), 1) - 0.5, -0.5)
    axes.set_yticks(places, names, parse_math=False)  # Names may contain $.
    axes.set_xlabel("share of the voxels with a class, by category (assets)")


def _shares(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    return weights / (weights.sum() or 1.0)


def _label(histogram: Histogram) -> str:
    shown = Property(histogram.name, histogram.unit, histogram.log10)
    unit = f" [{shown.sign}]" if shown.sign else ""
    return f"{'log10 of ' * shown.log10}{shown.title}{unit}"


def _percent(share: float) -> str:
    return "-" if np.isnan(share) else f"{share:.2%}"


def draw_errors(errors: MeasuredErrors, name: str, kind: str = "png") -> bytes:
    """Draw the scores of a store's alignments and of its decoys as a ``png``, ``svg`` or ``pdf``.

    Lines mark the lowest scores that keep the share of wrong alignments at `RATES`.
    """
    from scipy.special import logit

    edges, counts = np.array(errors.edges), errors.counts
    with canvas.styled():
        figure = canvas.new_figure(1200, 640)
        canvas.write(figure, 40, 48, f"Same object? {name}", weight="bold", size=12)
        for row, sentence in enumerate(errors.sentences()):
            canvas.note(figure, 40, 76 + 22 * row, sentence)
        axes = figure.add_axes((0.07, 0.13, 0.9, 0.6))
        axes.bar(edges[:-1], errors.targets, np.diff(edges), align="edge", color=canvas.ACCENT,
                 alpha=0.7, label=f"{errors.assets:,} alignments of the dataset")  # fmt: skip
        decoys = f"{len(errors.decoys):,} decoys: grids with SLATs of other objects"
        axes.step(edges, [*counts, counts[-1]], where="post", lw=1.6, label=decoys,
                  color=canvas.VERDICT_COLOURS["failed"])  # fmt: skip
        for kept in errors.kept:
            if errors.tells and kept.rate in RATES and kept.assets:
                axes.axvline(kept.score, color=canvas.INK, lw=1, ls=RATES[kept.rate],
                             label=f"{kept.assets:,} kept at {kept.rate:.0%} wrong")  # fmt: skip
        ticks = np.array([1e-4, 0.01, 0.5, 0.99, 0.9999])
        inside = (logit(ticks) >= edges[0]) & (logit(ticks) <= edges[-1])
        axes.set_xticks(logit(ticks)[inside], [f"{tick:.4g}" for tick in ticks[inside]])
        axes.set_xlabel("score, as a probability that the object is the same")
        axes.set_ylabel("count")
        axes.legend(frameon=False, loc="upper center")
        return canvas.in_format(figure, kind)

"""Fit the confidences of slatprep.judge on tables of benchmarks/confidence.py, and test them.

    python benchmarks/calibrate.py demo.npz ... [--fit [--numbers slatprep/judge/calibration.json]]
                                   [--picture docs/images/confidence.svg]

Logistic regressions answer two questions about an alignment: do both sides show the same object,
and if so, is its placement right? A third answers whether the class of a voxel is right. A weight
may only have the sign that makes sense: a better fit never lowers a confidence. For voxels,
isotonic regression on the same rows then corrects the probabilities. Alignments are weighted to
the mix `PRIOR`.

--fit writes the file of numbers, fitted to all tables. All printed and drawn results are for
objects that are not in the fit: seeds are divided into `PARTS`, and each part is judged by a fit to
the others. Without --fit the shipped numbers are tested. That test is on new objects only if the
tables' objects are not those of the shipped fit.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from confidence import GROUND, LUMPS, REAL
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression, minimize
from scipy.special import expit

from slatprep.align.pair import TIE
from slatprep.judge import calibration
from slatprep.judge.ambiguity import HARMLESS
from slatprep.judge.confidence import voxel_figures
from slatprep.judge.evidence import FIGURES, MEANING, VOXEL_FIGURES, Surroundings
from slatprep.judge.model import Logistic, Term
from slatprep.judge.verdict import THRESHOLDS

PRIOR = {"own": 0.945, "heading": 0.005, "other": 0.05}
"""Of a thousand alignments: 945 as the engine makes them, its own misses among them; five whose
right placement it was not allowed to see, for levels without a miss; 50 of other objects."""

EMPHASIS = {GROUND: 1.5, LUMPS: 2.0, REAL: 3.0}
"""Levels that count for more than one: the made-up ones from 0 to 8 are much alike."""

PLACEMENT_FIGURES = tuple(name for name, one in MEANING.items() if one.shows == "placement")
"""What the second question rests on: how far the next placement lies below, and what ties."""

SAME_FIGURES = tuple(name for name in FIGURES if name not in PLACEMENT_FIGURES)
"""What the first question rests on."""

VOXEL_PRIOR = {"own": 0.95, "heading": 0.05}
"""The same for voxels: what is right at one of another object has no meaning."""

GROWS = {name for name, figure in MEANING.items() if figure.sign > 0}
"""Figures that speak for a placement; all others speak against, where they are large."""

RIGHT_LABELS = 0.9
"""A placement that ties with others that have the same classes is right from this share on."""

KNEE = 0.02
"""Share of the right placements beyond a figure's knee, where another weight begins."""

KNOWN_KNEES = {"margin": TIE, "ties": 0.0}
"""Knees that are not taken from right placements: nearer ones are ties, which are counted."""

PARTS = 4
"""Into so many parts the seeds are divided, where each is judged by a fit to the others."""

RIDGE = 3e-2
KNOT_STEP, LEAST_WEIGHT = 0.3, 1e-3
"""Step of the logarithm of the odds from knot to knot of a curve, and least share of the mix."""

DRAWN = 1e-4
"""Share of the mix below which a bin, the voxels of one or two assets, is not drawn."""

Array = NDArray[np.float64]
Table = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Models:
    """The three models."""

    same: Logistic
    placement: Logistic
    voxel: Logistic

    def confidence(self, figures: Array) -> Array:
        """Return the product of both answers, of alignments (A, F)."""
        return self.same.probability(figures) * self.placement.probability(figures)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tables", type=Path, nargs="+", help="what is fitted to, and tested")
    parser.add_argument("--fit", action="store_true", help="fit anew")
    parser.add_argument("--numbers", type=Path, help="where the numbers go")
    parser.add_argument("--picture", type=Path, help="where the reliability diagram goes")
    options = parser.parse_args()
    table = read_tables(options.tables)
    if not options.fit:
        shipped = Models(calibration.SAME_OBJECT, calibration.PLACEMENT, calibration.VOXEL)
        report(table, *judged(table, shipped), options.picture)
        return
    if options.numbers:
        write_numbers(options.numbers, fit_all(table))
    report(table, *judged_by_others(table), options.picture)


def read_tables(paths: Sequence[Path]) -> Table:
    """Read tables as one, and mark what ties: ``torn`` where classes depend on the choice."""
    tables, rows = [], 0
    for path in paths:
        with np.load(path, allow_pickle=False) as file:
            tables.append({name: file[name] for name in file.files})
        tables[-1]["voxel_row"] += rows
        rows += len(tables[-1]["kind"])
    table = {name: np.concatenate([t[name] for t in tables]) for name in tables[0]}
    # Where placements that tie count as one the displacement says nothing, and labels do.
    alike = table["harmless"] & (table["kind"] != "other")
    table["placed"] |= alike & (table["labels"] >= RIGHT_LABELS)
    table["known"] = ~(table["symmetric"] & (table["kind"] != "other")) | alike
    table["same"] = (table["kind"] == "own") & (table["placed"] | table["symmetric"])
    sums = np.bincount(table["voxel_row"], table["voxel_voxels"][:, 10], len(table["kind"]))
    counts = np.bincount(table["voxel_row"], minlength=len(table["kind"]))
    table["torn"] = sums / np.maximum(counts, 1) > HARMLESS
    return table


def weights_of(table: Table, rows: NDArray[np.bool_], prior: Mapping[str, float] = PRIOR) -> Array:
    """Weigh rows to the mix `prior`, levels by `EMPHASIS`, objects of a level of real ones alike.

    0 where not in `rows`.
    """
    weights = np.zeros(len(rows))
    for kind, share in prior.items():
        of_kind = rows & (table["kind"] == kind)
        levels = np.unique(table["level"][of_kind])
        whole = sum(EMPHASIS.get(int(level), 1.0) for level in levels)
        for level in levels:
            there = of_kind & (table["level"] == level)
            names = table["family"][there] if level == REAL else np.zeros(there.sum())
            _, which, counts = np.unique(names, return_inverse=True, return_counts=True)
            each = 1.0 / (len(counts) * counts[which])
            weights[there] = share * EMPHASIS.get(int(level), 1.0) / whole * each
    return weights / weights.sum()


def fit(
    names: tuple[str, ...], values: Array, right: NDArray[np.bool_], weights: Array,
    knees: bool = False, use: tuple[str, ...] = (),
) -> Logistic:  # fmt: skip
    """Fit a `Logistic` with weights of the signs that `GROWS` says, of the figures `use` or all."""
    low, high = np.nanquantile(values, (0.005, 0.995), axis=0)
    usual = np.nanmean(np.where(right[:, None], np.clip(values, low, high), np.nan), axis=0)
    if knees:
        names, values, low, high = with_knees(names, values, right, low, high)
        usual = np.clip(usual[[FIGURES.index(name) for name in names]], low, high)
    clipped = np.clip(values, low, high) - usual
    spread = np.nanstd(clipped, axis=0) + 1e-9
    x = np.nan_to_num(clipped / spread)
    sign = np.array([1.0 if name in GROWS else -1.0 for name in names])
    y = np.where(right, 1.0, -1.0)

    def loss(parameters: Array) -> tuple[float, Array]:
        w, b = parameters[:-1], parameters[-1]
        odds = y * (x @ w + b)
        slope = -y * expit(-odds) * weights
        value = float((weights * np.logaddexp(0.0, -odds)).sum() + 0.5 * RIDGE * (w @ w) / len(w))
        return value, np.append(x.T @ slope + RIDGE * w / len(w), slope.sum())

    free = np.array([not use or name in use for name in names])
    bounds = [_bounds(s, f) for s, f in zip(sign, free, strict=True)] + [(None, None)]
    start = np.append(0.1 * sign * free, 1.0)
    options = {"maxiter": 5_000, "maxfun": 20_000, "ftol": 1e-13, "gtol": 1e-9}
    found = minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B", options=options).x
    figures = tuple(
        Term(name, *(float(f"{v:.6g}") for v in (w / s, u, a, b)))
        for name, w, s, u, a, b in zip(names, found[:-1], spread, usual, low, high, strict=True)
    )
    counted = tuple(figure for figure in figures if figure.weight)
    return Logistic(tuple(dict.fromkeys(names)), counted, float(f"{found[-1]:.6g}"), ())


def _bounds(sign: float, free: bool) -> tuple[float | None, float | None]:
    if not free:
        return 0.0, 0.0
    return (0.0, None) if sign > 0 else (None, 0.0)


def with_knees(
    names: tuple[str, ...], values: Array, right: NDArray[np.bool_], low: Array, high: Array
) -> tuple[tuple[str, ...], Array, Array, Array]:
    """Part each figure's bounds at the value beyond which few right ones lie."""
    parts: list[tuple[int, float, float]] = []
    for k, name in enumerate(names):
        knee = KNOWN_KNEES.get(name, np.nan)
        if np.isnan(knee):
            knee = float(np.nanquantile(values[right, k], KNEE if name in GROWS else 1.0 - KNEE))
        ends = [low[k], float(f"{knee:.6g}"), high[k]] if low[k] < knee < high[k] else None
        parts += [(k, a, b) for a, b in pairwise(ends or [low[k], high[k]])]
    which = [k for k, _, _ in parts]
    bounds = np.array([(a, b) for _, a, b in parts]).T
    return tuple(names[k] for k in which), values[:, which], bounds[0], bounds[1]


def with_curve(
    model: Logistic, values: Array, right: NDArray[np.bool_], weights: Array
) -> Logistic:
    """Add the curve that isotonic regression gives, with knots at even steps of the odds."""
    odds = model.contributions(values).sum(axis=1) + model.intercept
    steps = ((odds - odds.min()) / KNOT_STEP).astype(int)
    share = np.bincount(steps, weights)
    # What too little of the mix lies between counts as one step.
    below = ((np.cumsum(share) - share) / LEAST_WEIGHT).astype(int)
    bins = np.unique(below, return_inverse=True)[1][steps]
    total = np.bincount(bins, weights)
    at = np.bincount(bins, weights * odds) / total
    share = np.bincount(bins, weights * right) / total
    share = isotonic_regression(share, weights=total).x
    curve = tuple((float(f"{a:.5g}"), float(f"{s:.5g}")) for a, s in zip(at, share, strict=True))
    return replace(model, curve=curve)


def fit_all(table: Table) -> Models:
    """Fit the three models to a table."""
    same = table["same"] | (table["kind"] == "other")
    placed = table["known"] & (table["kind"] != "other")
    first = _fit_rows(table, same, table["same"], SAME_FIGURES)
    second = _fit_rows(table, placed, table["placed"], PLACEMENT_FIGURES)
    # What ties do is known by counting, and not fitted.
    rows = ~table["torn"]
    confidence = first.probability(table["figures"]) * second.probability(table["figures"])
    values, right, weights = voxels_of(table, rows, confidence)
    voxel = fit(VOXEL_FIGURES, values, right, weights)
    return Models(first, second, with_curve(voxel, values, right, weights))


def _fit_rows(
    table: Table, rows: NDArray[np.bool_], right: NDArray[np.bool_], use: tuple[str, ...]
) -> Logistic:
    weights = weights_of(table, rows)[rows]
    return fit(FIGURES, table["figures"][rows], right[rows], weights, knees=True, use=use)


def voxels_of(
    table: Table, rows: NDArray[np.bool_], confidence: Array
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Return figures, truth and weights of the voxels of some rows."""
    values = []
    for row in np.flatnonzero(rows):
        own = table["voxel_voxels"][table["voxel_row"] == row]
        if len(own):
            around = Surroundings(own[:, :4], own[:, 4:8], own[:, 8], own[:, 9], own[:, 10])
            values.append(voxel_figures(around, float(confidence[row])))
    chosen = rows[table["voxel_row"]]
    return (
        np.concatenate(values).astype(np.float64),
        table["voxel_right"][chosen],
        voxel_weights(table, rows)[chosen],
    )


def voxel_weights(table: Table, rows: NDArray[np.bool_]) -> Array:
    """Weigh voxels to the mix `VOXEL_PRIOR`, those of a row alike; 0 where not in `rows`."""
    counts = np.bincount(table["voxel_row"], minlength=len(rows))
    rows = rows & (counts > 0)
    weights = weights_of(table, rows, VOXEL_PRIOR) / np.maximum(counts, 1)
    of_voxels: Array = weights[table["voxel_row"]]
    return of_voxels / of_voxels.sum()


def judged(table: Table, models: Models) -> tuple[Array, Array]:
    """Return both answers (A, 2), and the confidence of each voxel whatever ties it has."""
    figures = table["figures"]
    both = np.stack([models.same.probability(figures), models.placement.probability(figures)], 1)
    values, _, _ = voxels_of(table, np.ones(len(both), dtype=bool), both.prod(axis=1))
    return both, models.voxel.probability(values)


def judged_by_others(table: Table) -> tuple[Array, Array]:
    """Return what `judged` does of each part of the seeds, by a fit to the other parts."""
    part = np.unique(table["seed"], return_inverse=True)[1] % PARTS
    both, likely = np.zeros((len(part), 2)), np.zeros(len(table["voxel_row"]))
    for own in range(PARTS):
        others, mine = rows_of(table, part != own), rows_of(table, part == own)
        both[part == own], likely[(part == own)[table["voxel_row"]]] = judged(mine, fit_all(others))
    return both, likely


def rows_of(table: Table, rows: NDArray[np.bool_]) -> Table:
    """Return some rows of a table, with their voxels."""
    number = np.cumsum(rows) - 1
    voxels = rows[table["voxel_row"]]
    chosen = {
        name: values[voxels if name.startswith("voxel_") else rows]
        for name, values in table.items()
    }
    return chosen | {"voxel_row": number[chosen["voxel_row"]]}


def reliability(
    likely: Array, right: NDArray[np.bool_], weights: Array
) -> list[tuple[float, float, float, int]]:
    """Return mean probability, share of right ones, weight and count of each of ten bins."""
    bins = np.minimum((likely * 10).astype(int), 9)
    found = []
    for k in range(10):
        w = weights * (bins == k)
        if w.sum() > 0:
            found.append(
                (float((w * likely).sum() / w.sum()), float((w * right).sum() / w.sum()),
                 float(w.sum()), int((bins == k).sum()))
            )  # fmt: skip
    return found


def report(table: Table, both: Array, likely: Array, picture: Path | None) -> None:
    clear, every = table["known"], np.ones(len(table["known"]), dtype=bool)
    likely, confidence = likely * (1.0 - table["voxel_voxels"][:, 10]), both.prod(axis=1)
    assets = reliability(confidence[clear], table["placed"][clear], weights_of(table, clear)[clear])
    diagrams = {"alignments": assets}
    of_same = table["same"] | (table["kind"] == "other")
    of_placed = clear & (table["kind"] != "other")
    for name, rows, said, right in (
        ("same object", of_same, both[:, 0], table["same"]),
        ("right placement", of_placed, both[:, 1], table["placed"]),
    ):
        weights = weights_of(table, rows)[rows]
        diagrams[name] = reliability(said[rows], right[rows], weights)
    for name, rows in (("voxels", ~table["torn"]), ("voxels, with ties", every)):
        weights = voxel_weights(table, rows)
        there = weights > 0
        right = table["voxel_right"][there]
        diagrams[name] = reliability(likely[there], right, weights[there])
    for name, bins in diagrams.items():
        print(name)
        for said, found, weight, count in bins:
            print(f"  says {said:.3f}  is {found:.3f}  off {found - said:+.3f}"
                  f"  weight {weight:.4f}  {count}")  # fmt: skip
        brier = sum(w * (s - f) ** 2 for s, f, w, _ in bins)
        print(f"  rms off {np.sqrt(brier):.4f}")
    own = clear & (table["kind"] == "own") & ~table["symmetric"]
    groups = {f"own, right, L{k}": own & table["placed"] & (table["level"] == k)
              for k in np.unique(table["level"])}  # fmt: skip
    groups |= {
        f"real, {name}": own
        & table["placed"]
        & (table["level"] == REAL)
        & (table["family"] == name)
        for name in np.unique(table["family"][own & (table["level"] == REAL)])
    }
    groups["other, real"] = (table["kind"] == "other") & (table["level"] == REAL)
    groups["own, wrong, real"] = own & ~table["placed"] & (table["level"] == REAL)
    ground = table["level"] == GROUND
    for where, there in (("", ~ground), (" on ground", ground)):
        groups |= {
            f"own, right{where}": own & table["placed"] & there,
            f"own, wrong{where}": own & ~table["placed"] & there,
            f"other{where}": (table["kind"] == "other") & there,
        }
    groups |= {
        "heading, wrong": clear & (table["kind"] == "heading") & ~table["placed"],
        "own, alike": table["harmless"] & (table["kind"] == "own"),
        "own, torn": table["torn"] & (table["kind"] == "own"),
    }
    # What `slatprep.judge.verdict_of` makes of them; `likely` is of all voxels here.
    tied, valid = (table["figures"][:, FIGURES.index(name)] for name in ("ties", "valid_share"))
    sums = np.bincount(table["voxel_row"], likely, len(every))
    expected = sums / np.maximum(np.bincount(table["voxel_row"], minlength=len(every)), 1)
    good = (confidence >= THRESHOLDS.good_confidence) & (tied == 0)
    good &= (valid >= THRESHOLDS.good_valid_share) & (expected >= THRESHOLDS.good_accuracy)
    failed = both[:, 0] < THRESHOLDS.failed_confidence
    failed |= (both[:, 1] < THRESHOLDS.failed_confidence) & (tied == 0)
    for name, rows in groups.items():
        c = confidence[rows]
        if len(c):
            print(f"{name:20s} {len(c):4d}  good {good[rows].mean():.3f}  "
                  f"failed {failed[rows].mean():.3f}  quantiles "
                  f"{np.round(np.quantile(c, (0.01, 0.05, 0.5, 0.95, 0.99)), 3)}")  # fmt: skip
    if picture:
        draw(picture, assets, diagrams["voxels"])


def draw(path: Path, assets: list[Any], voxels: list[Any]) -> None:
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "slatprep"
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(7, 3.4), layout="constrained")
    both = (("alignments", assets), ("voxels' classes", voxels))
    for ax, (name, bins) in zip(axes, both, strict=True):
        said, found, weight, _ = np.array([one for one in bins if one[2] >= DRAWN]).T
        ax.plot([0, 1], [0, 1], color="0.7", lw=1)
        ax.bar(said, weight, width=0.06, color="#cfd8e6", label="share of the mix")
        ax.plot(said, found, "o-", color="#2a5caa", label="right")
        ax.set(xlabel="confidence", ylabel="share", title=name, xlim=(0, 1), ylim=(0, 1.02))
    axes[1].legend(frameon=False, loc="upper left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})


def write_numbers(path: Path, models: Models) -> None:
    """Write the numbers as JSON, a figure and a point of a curve in a line."""
    told = zip(("same_object", "placement", "voxel"), vars(models).values(), strict=True)
    text = ",\n".join(f'  "{name}": {_written(model)}' for name, model in told)
    path.write_text(f"{{\n{text}\n}}\n", encoding="utf-8")


def _written(model: Logistic) -> str:
    terms, curve = (
        "[{}]".format(",".join(f"\n      {json.dumps(row)}" for row in rows))
        for rows in (map(astuple, model.terms), model.curve)
    )
    return (
        f'{{\n    "intercept": {model.intercept},\n    "terms": {terms},\n'
        f'    "curve": {curve}\n  }}'
    )


if __name__ == "__main__":
    main()

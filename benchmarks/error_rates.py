"""Compare the error rates that decoys state with the true ones, on tables of confidence.py.

    python benchmarks/error_rates.py table.npz ... [--wrong 0 0.05 0.2 0.35 1] [--draws 12]

A dataset is drawn from right alignments, with a share of alignments to SLATs of other objects,
as if files were paired wrongly; further alignments to other objects are its decoys. For each share,
it prints means over the draws: the stated share of wrong pairs, and how often its interval holds
the true share; the true and the stated number of wrong pairs among good alignments. At a stated
rate of 0.01 it prints the true rate, mean and worst, and the share of right alignments that is
kept, beside the share that is called good.

Tables of objects that were not in the fit of the shipped model are the strongest test.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from calibrate import Table, read_tables
from numpy.typing import NDArray

from slatprep.judge.calibration import PLACEMENT, SAME_OBJECT
from slatprep.judge.decoys import ErrorRates, error_rates
from slatprep.judge.verdict import THRESHOLDS

RATE = 0.01


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tables", type=Path, nargs="+")
    parser.add_argument("--wrong", type=float, nargs="+", default=[0.0, 0.05, 0.2, 0.35, 1.0])
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--decoys", type=int, default=200, help="at most")
    options = parser.parse_args()
    table = read_tables(options.tables)
    print("| wrong | targets | decoys | stated | holds | good: wrong, stated | range holds "
          "| rate at 0.01, mean | worst | right kept | right called good |")  # fmt: skip
    print("| --- " * 11 + "|")
    for share in options.wrong:
        rows = [_draw(table, share, options.decoys, seed) for seed in range(options.draws)]
        print(_line(share, rows), flush=True)


def _draw(table: Table, share: float, most: int, seed: int) -> dict[str, float]:
    rng = np.random.default_rng(seed)
    right = np.flatnonzero(table["same"] & ~((table["kind"] == "own") & ~table["known"]))
    others = rng.permutation(np.flatnonzero(table["kind"] == "other"))
    decoys, spare = np.array_split(others, 2)
    decoys = decoys[:most]
    count = len(spare) if share == 1 else round(share / (1 - share) * len(right))
    if count > len(spare):
        right = rng.permutation(right)[: round(len(spare) * (1 - share) / share)]
        count = len(spare)
    targets = spare[:count] if share == 1 else np.concatenate([right, spare[:count]])
    figures, wrong = table["figures"], table["kind"][targets] == "other"
    good, good_decoys = (_good(figures[rows]) for rows in (targets, decoys))
    # Each pair counts as an object of its own.
    names = [list(map(str, rows)) for rows in (targets, decoys)]
    found = error_rates(
        figures[targets], figures[decoys], *names, good=good, good_decoys=good_decoys
    )
    return _told(found, good, wrong)


def _good(figures: NDArray[np.float64]) -> NDArray[np.bool_]:
    likely = SAME_OBJECT.probability(figures) * PLACEMENT.probability(figures)
    good: NDArray[np.bool_] = likely >= THRESHOLDS.good_confidence
    return good


def _told(found: ErrorRates, good: NDArray[np.bool_], wrong: NDArray[np.bool_]) -> dict[str, float]:
    kept = found.rates <= RATE
    low, high = found.wrong_share_range
    least, most = found.good_wrong_range
    truly = int((good & wrong).sum())
    return {
        "targets": len(found.scores),
        "decoys": len(found.decoy_scores),
        "stated": found.wrong_share,
        "holds": low <= wrong.mean() <= high,
        "good wrong": truly,
        "good stated": found.good_wrong,
        "good holds": np.floor(least) <= truly <= np.ceil(most),
        "rate": (kept & wrong).sum() / max(kept.sum(), 1),
        "kept": (kept & ~wrong).sum() / max((~wrong).sum(), 1),
        "good": (good & ~wrong).sum() / max((~wrong).sum(), 1),
    }


def _line(share: float, rows: list[dict[str, float]]) -> str:
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    worst = max(row["rate"] for row in rows)
    return (
        f"| {share:g} | {mean['targets']:.0f} | {mean['decoys']:.0f} | {mean['stated']:.3f} "
        f"| {mean['holds']:.2f} | {mean['good wrong']:.1f}, {mean['good stated']:.1f} "
        f"| {mean['good holds']:.2f} | {mean['rate']:.4f} | {worst:.4f} | {mean['kept']:.3f} "
        f"| {mean['good']:.3f} |"
    )


if __name__ == "__main__":
    main()

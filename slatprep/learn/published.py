"""Published scores, and other tables of scores, to print beside an evaluation."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from slatprep.errors import InputError
from slatprep.learn.metrics import METRICS, SPREADS
from slatprep.readers.files import refusing


@dataclass(frozen=True)
class PublishedScore:
    """One row of a table.

    Attributes
    ----------
    method : str
        Name of the method.
    means : dict of str to float
        Mean by metric, for some of `slatprep.learn.metrics.metrics_of`.
    spreads : dict of str to float
        The number after ± of each metric, if published.
    spread : str
        The kind of spread, in words.
    """

    method: str
    means: dict[str, float]
    spreads: dict[str, float] = field(default_factory=dict)
    spread: str = ""


_BY_PIXIE = SPREADS["pixie"].replace("prints", "prints unless told otherwise")
_BY_SLAT_PHYS = "not said; as large as a standard deviation over objects"


def _score(method: str, *values: float, spread: str = "") -> PublishedScore:
    """Make a row from means in the order of `METRICS`, followed by their spreads, if known."""
    means, spreads = values[: len(METRICS)], values[len(METRICS) :]
    return PublishedScore(
        method,
        dict(zip(METRICS, means, strict=True)),
        dict(zip(METRICS, spreads, strict=True)) if spreads else {},
        spread,
    )


PIXIE_TABLE = (
    _score("NeRF2Physics", 1.115, 0.997, 0.462, 0.858, 0.274, 0.165, 0.162, 0.106, 0.109, 0.010,
           spread=_BY_PIXIE),
    _score("Pixie, occupancy", 0.149, 0.105, 0.124, 0.126, 0.643),
    _score("Pixie, RGB", 0.196, 0.045, 0.079, 0.106, 0.722),
    _score("Pixie", 0.022, 0.112, 0.034, 0.056, 0.985, 0.004, 0.009, 0.006, 0.005, 0.011,
           spread=_BY_PIXIE),
)  # fmt: skip
"""Le et al., "Pixie: Fast and Generalizable Supervised Learning of 3D Physics from Pixels",
arXiv 2508.17437, Table 1: NeRF2Physics, measured by Pixie's authors, and Pixie with three kinds
of features. Scores are on PixieVerse's test objects, over the voxels of Pixie's grids, normalised
by Pixie's ranges."""

SLAT_PHYS_TABLE = (
    *(score for score in PIXIE_TABLE if score.method in ("NeRF2Physics", "Pixie")),
    _score("SLAT-Phys", 0.017, 0.036, 0.054, 0.036, 0.9453, 0.025, 0.049, 0.074, 0.049, 0.112,
           spread=_BY_SLAT_PHYS),
    _score("SLAT-Phys, small", 0.0285, 0.0630, 0.0674, 0.0530, 0.9107),
    _score("SLAT-Phys, medium", 0.0195, 0.0433, 0.0573, 0.0400, 0.9355),
    _score("SLAT-Phys, large", 0.0173, 0.0361, 0.0540, 0.0358, 0.9453),
)  # fmt: skip
"""The tables of SLAT-Phys: its comparison, with rows from Pixie's table, and its ablation of the
decoder's size (2,000 steps), with the means of the three printed errors. Scores are over SLAT
voxels, normalised by Pixie's ranges."""

TABLES = {
    "pixie": ("Pixie's Table 1 (arXiv 2508.17437)", PIXIE_TABLE),
    "slat-phys": ("SLAT-Phys's comparison and ablation", SLAT_PHYS_TABLE),
}
"""Published tables with their titles, by their names in `slatprep evaluate --beside`."""


SECONDS = {"image": 0.138, "sparse structure": 4.69, "SLAT": 5.03, "decode": 0.004, "in all": 9.9}
"""SLAT-Phys's seconds an object on an NVIDIA A5000, by the stages of `slatprep predict`."""

SECONDS_OF_OTHERS = {"NeRF2Physics": 1196.0, "Pixie": 1261.0}
"""Seconds an object of other methods, as SLAT-Phys prints them: 121 and 128 times its own."""


def read_scores(path: Path, metrics: Sequence[str] = METRICS) -> tuple[PublishedScore, ...]:
    """Read a table of scores without spreads, such as from ``slatprep evaluate --csv``.

    The CSV has the methods' names in the first column, and some of the `metrics` as columns.
    InputError if it has none of them, or an entry is no number.
    """
    expected = f"a CSV with a name in the first column and some of {', '.join(metrics)}"
    try:
        with path.open(encoding="utf-8", newline="") as file:
            lines = [row for row in csv.reader(file) if row]
        if not lines:
            raise ValueError("it is empty")
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise InputError(path, f"cannot be read ({error})", expected) from error
    header, *rows = lines
    places = {name: header.index(name) for name in metrics if name in header[1:]}
    if not places:
        raise InputError(path, f"has the columns {', '.join(header)}", expected)
    twice = [name for name in places if header.count(name) > 1]
    if twice:
        raise InputError(path, f"has the column {twice[0]} twice", expected)
    longer = [row for row in rows if len(row) > len(header)]
    if longer:
        found = (
            f"has {len(longer[0])} entries under {len(header)} columns, for {longer[0][0][:80]!r}"
        )
        raise InputError(path, found, expected)
    with refusing(path, "has a row that is not numbers", expected):
        return tuple(
            PublishedScore(row[0], {n: float(row[k]) for n, k in places.items() if row[k].strip()})
            for row in rows
        )

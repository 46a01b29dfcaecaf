"""The models of the confidences; `benchmarks/calibrate.py` fits their numbers, in a JSON file."""

from __future__ import annotations

from pathlib import Path

import orjson

from slatprep.judge.evidence import FIGURES, VOXEL_FIGURES
from slatprep.judge.model import Logistic, Term

NUMBERS = Path(__file__).with_suffix(".json")
"""The file of the numbers."""


_HELD = orjson.loads(NUMBERS.read_bytes())


def _model(name: str, names: tuple[str, ...]) -> Logistic:
    held = _HELD[name]
    curve = tuple((odds, share) for odds, share in held["curve"])
    return Logistic(names, tuple(Term(*one) for one in held["terms"]), held["intercept"], curve)


SAME_OBJECT = _model("same_object", FIGURES)
"""Whether both sides show the same object."""

PLACEMENT = _model("placement", FIGURES)
"""Whether a placement is right, of the same object."""

VOXEL = _model("voxel", VOXEL_FIGURES)
"""Whether the class of a voxel is right."""

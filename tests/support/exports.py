"""What is in an export."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from support.synthetic import JELLY, METAL
from support.trees import files_below


def index_of(directory: Path) -> list[dict[str, Any]]:
    return json.loads((directory / "index.json").read_text("utf-8"))["assets"]


def bytes_of(path: Path) -> dict[str, bytes]:
    return {name: file.read_bytes() for name, file in files_below(path).items()}


def hold_truth(
    material: np.ndarray, modulus: np.ndarray, density: np.ndarray, ratio: np.ndarray
) -> None:
    """Hold the values of an asset of `support.synthetic`, by class, to those of its two stuffs."""
    assert set(np.unique(material)) == {JELLY[0], METAL[0]}
    for number, *values in (JELLY, METAL):
        here = np.asarray(material) == number
        for column, value in zip((modulus, density, ratio), values, strict=True):
            np.testing.assert_allclose(column[here], value, rtol=1e-4)


def hold_colours(material: np.ndarray, colours: np.ndarray) -> None:
    """Hold colours (N, 3), of 0 to 255, to those of jelly and metal in every picture."""
    for number, shown in ((JELLY[0], (0x5A, 0x9A, 0x5A)), (METAL[0], (0x43, 0x27, 0xAC))):
        assert (colours[material == number] == shown).all()

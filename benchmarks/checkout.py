"""Help scripts that build in processes of their own, from the synthetic data of the tests."""

from __future__ import annotations

import os
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]

# The made data (`support.synthetic`) are part of the tests, not of the package, and an
# installed package may be that of another checkout.
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]


def environment() -> dict[str, str]:
    """Return the environment in which such a process finds this checkout and its tests."""
    return {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}", "OMP_NUM_THREADS": "1"}

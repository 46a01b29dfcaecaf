"""The short version of ``benchmarks/damage.py``: no flipped bit and no gross damage does harm."""

import json
import subprocess
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[3] / "benchmarks" / "damage.py"


def test_damage_is_found_healed_or_without_meaning():
    command = [sys.executable, str(BENCHMARK), "--flips", "150", "--stores", "30", "--seed", "4"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["harm"] == 0
    outcomes = ("found by verify", "healed by the next build", "without meaning",
                "costs the next build some hashing")  # fmt: skip
    assert sum(told.get(outcome, 0) for outcome in outcomes) == told["flips"] == 150
    assert sum(count for name, count in told.items() if ": exit code" in name) == 30

"""The short version of ``benchmarks/faulty_s3.py``: spoiled answers of a server do no harm."""

import json
import subprocess
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[3] / "benchmarks" / "faulty_s3.py"


def test_spoiled_answers_end_in_the_same_store_or_in_words():
    command = [sys.executable, str(BENCHMARK), "--runs", "4", "--seed", "1"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["runs"], told["harm"]) == (4, 0)
    assert told["faults"] > 0

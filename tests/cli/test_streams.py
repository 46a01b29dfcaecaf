"""Commands whose standard output or standard error is closed, or full."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from slatprep.inspect.verify import verify_store
from slatprep.store import open_store

DEVICE = Path("/dev/full")


def shell(words: str, redirected: str) -> subprocess.CompletedProcess[str]:
    line = f"{sys.executable} -m slatprep {words} {redirected}"
    return subprocess.run(["sh", "-c", line], capture_output=True, text=True, timeout=600)


@pytest.mark.parametrize(
    ("words", "redirected"),
    [("info {}", ">&-"), ("list {} --json", "> /dev/full")],
)
def test_lost_output_is_told_on_standard_error(mixed_build, words, redirected):
    if "full" in redirected and not DEVICE.exists():
        pytest.skip("no /dev/full")
    done = shell(words.format(mixed_build.store), redirected)
    assert done.returncode == 3
    told = [line for line in done.stderr.splitlines() if line.startswith("slatprep: error:")]
    assert len(told) == 1 and "standard output cannot be written to" in told[0]
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr


@pytest.mark.parametrize("redirected", ["2> /dev/full", ">&- 2>&-"])
def test_a_subset_is_whole_whatever_happens_to_what_it_prints(mixed_build, tmp_path, redirected):
    out = tmp_path / "s.zarr"
    done = shell(f"subset {mixed_build.store} --verdict good --out {out}", redirected)
    assert "Traceback" not in done.stdout + done.stderr
    assert done.returncode in (0, 3)
    store = open_store(out)
    assert len(store) and all(asset.columns["verdict"] == "good" for asset in store)
    assert verify_store(out).ok


def test_lost_notes_are_told_on_standard_output_and_never_within_json(mixed_build, tmp_path):
    store = mixed_build.store
    done = shell(f"describe {store}", "2>&-")  # It notes what is not stated.
    assert done.returncode == 3
    assert "standard error cannot be written to" in done.stdout
    # It notes how many objects are in each split.
    done = shell(f"export {store} --format npz --out {tmp_path}/n --split train --json", "2>&-")
    assert done.returncode == 3
    assert json.loads(done.stdout)["command"] == "export"


def test_a_reader_that_has_read_enough_is_no_fault(mixed_build):
    done = shell(f"list {mixed_build.store} --ids", "| head -1")
    assert done.stdout.count(os.linesep) == 1 and "rror" not in done.stderr

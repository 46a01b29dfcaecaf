"""A build that is stopped with a signal at any step leaves the older store and nothing else."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest
from support.commands import python
from support.faults import inject
from support.synthetic import Dataset
from support.trees import tree

from slatprep.cli.commands import slatprep
from slatprep.cli.process import prepare_stop
from slatprep.pipeline.dataset import build_store

BEFORE = (
    "work folder made", "work folder locked", "asset compared", "asset begun", "asset read",
    "asset aligned", "asset spooled", "store created", "shard begun", "shard filled",
    "shard written", "records written", "directory flushed",
)  # fmt: skip
AFTER = ("directory exchanged", "store replaced", "manifests written", "manifests published")


def _run(step: str, number: signal.Signals, line: list[str], said: Path, lost: bool) -> None:
    sys.stderr = said.open("w", buffering=1)

    def reached(now: str, _: str) -> None:
        if now == step:
            with suppress(KeyboardInterrupt) if lost else nullcontext():
                os.kill(os.getpid(), number)

    # Tests that run in the background ignore it, and a command then keeps ignoring it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    prepare_stop()
    inject(pytest.MonkeyPatch(), reached)
    slatprep(line, prog_name="slatprep")


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """One asset, and in a folder the store of another, with its records."""
    old = Dataset(tmp_path_factory.mktemp("old")).having("z", seed=3)
    made = Dataset(tmp_path_factory.mktemp("made")).having("a")
    build_store(old.parameters("pixie"), made.root / "stores" / "s.zarr")
    return made


@pytest.mark.parametrize(("step", "number", "lost"), [
    *((step, signal.SIGTERM, False) for step in (*BEFORE, *AFTER)),
    ("asset begun", signal.SIGINT, False),
    ("store replaced", signal.SIGINT, False),
    # A library swallows the exception, as Python does in destructors.
    ("asset begun", signal.SIGTERM, True),
])  # fmt: skip
def test_a_signal_at_a_step(step, number, lost, sources, tmp_path):
    folder = Path(shutil.copytree(sources.root / "stores", tmp_path / "stores"))
    out = folder / "s.zarr"
    before, there = tree(out), set(folder.iterdir())
    said = tmp_path / "said"
    line = [*map(str, ("build-store", *sources.sides, "--ranges", "pixie", "--out", out))]
    how = {"target": _run, "args": (step, number, line, said, lost)}
    forked = multiprocessing.get_context("fork").Process(**how)
    forked.start()
    forked.join()
    assert forked.exitcode == 130
    assert (tree(out) == before) == (step in BEFORE)
    told = "nothing was replaced" if step in BEFORE[:-1] else "is the old store or the new one"
    assert told in said.read_text()
    # Finished assets are kept in the work folder for the next build, which removes it.
    assert set(folder.iterdir()) - {folder / ".s.zarr.work"} == there
    build_store(sources.parameters("pixie"), out)
    assert set(folder.iterdir()) == there


INTERRUPTED = """
import os, signal, time, weakref
from slatprep.cli.process import prepare_stop

def interrupted():
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.01)
    print("ended")

class Gone:
    def __del__(self):
        interrupted()

class Named:
    pass

named = Named()
watched = weakref.ref(named, lambda _: interrupted())
library = {"__name__": "zarr.core.sync", "interrupted": interrupted}
exec("def call(): interrupted()", library)
prepare_stop()
try:
    CALL
    time.sleep(30)
except KeyboardInterrupt:
    print("stopped")
"""


@pytest.mark.parametrize(("call", "printed"), [
    ("interrupted()", ["stopped"]),
    # Python drops what a destructor raises, and zarr's thread would go on writing.
    ("Gone()", ["ended", "stopped"]),
    ("del named", ["stopped"]),  # Python tells what a callback raises, and drops it.
    ("library['call']()", ["ended", "stopped"]),
])  # fmt: skip
def test_a_stop_waits_where_it_would_be_lost(call, printed):
    done = python("-c", INTERRUPTED.replace("CALL", call))
    assert (done.stdout.split(), done.stderr) == (printed, "")


ENDING = """
import atexit, os, signal, sys
from slatprep.cli import main

def end():
    os.kill(os.getpid(), signal.SIGNAL)
    print("ended", file=sys.stderr)

atexit.register(end)
sys.argv = ["slatprep", "info", "--help"]
main()
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_a_signal_while_python_ends_changes_nothing(name):
    assert python("-c", ENDING.replace("SIGNAL", name)).stderr == "ended\n"


STARTING = """
import os, signal, sys
from slatprep.cli import main

class Interrupts:
    def find_spec(self, name, *_):
        if name == "slatprep.cli.commands":
            os.kill(os.getpid(), signal.SIGTERM)

sys.meta_path.insert(0, Interrupts())
main()
"""


def test_a_signal_while_modules_are_imported_is_told_in_a_line():
    line = [sys.executable, "-c", STARTING]
    done = subprocess.run(line, capture_output=True, text=True, timeout=60)
    assert done.stderr == "slatprep: stopped; nothing was replaced\n"
    assert done.returncode == 130


EXPORTING = """
import os, signal, sys
from slatprep.cli import main
from slatprep.export.hdf5 import _LateFaults

asked = []

def fault(file):
    asked.append(file)
    if len(asked) == 3:
        os.kill(os.getpid(), signal.SIGTERM)

_LateFaults.fault = property(fault, lambda file, fault: None)
main()
"""


def test_a_signal_while_hdf5_writes_stops_the_export_and_crashes_nothing(store, tmp_path):
    words = ("export", store, "--format", "hdf5", "--out", tmp_path / "e.h5")
    done = python("-c", EXPORTING, *words, code=130)
    assert done.stderr.endswith(
        "slatprep: stopped; nothing was replaced; run it again to start anew\n"
    )
    assert not any(tmp_path.iterdir())

"""Kernels are compiled once, before any worker starts, and the user is told."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from joblib.externals.loky import cpu_count
from numba.core.caching import IndexDataCacheFile
from support.commands import python
from support.faults import no_room, wait_until
from support.synthetic import Dataset

from slatprep.geometry import kernel
from slatprep.pipeline.dataset import build_store
from slatprep.workers import local
from slatprep.workers.local import at_most

# Numba says of every kernel that it compiles; what it finds on disk it does not name. But a
# kernel knows what types it has been called with, wherever its code came from: those of a build
# must be those from before it. So one kernel alone needs to be compiled here.
SCRIPT = r"""
import gc, sys
from pathlib import Path
import numba
from numba.core import event
from numba.core.dispatcher import Dispatcher
from slatprep.demo import make_demo
from slatprep.geometry.fill import _flood
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import build_store
from slatprep.pipeline.asset import compile_kernels

def ready():
    kernels = [one for one in gc.get_objects() if isinstance(one, Dispatcher)]
    ours = [one for one in kernels if one.py_func.__module__.startswith("slatprep.")]
    return {(one.py_func.__qualname__, types) for one in ours for types in one.signatures}

root = Path(sys.argv[1])
notes = []
kept, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(root / "nothing compiled")
_flood.enable_caching()
numba.config.CACHE_DIR = kept
with event.install_recorder("numba:compile") as recorder:
    compile_kernels(notes.append)
    compiled = {one.data["dispatcher"].py_func.__qualname__ for _, one in recorder.buffer}
    assert "_flood" in compiled and len(notes) == 2, (compiled, notes)
    assert notes[0].endswith("may take a minute") and notes[1].startswith("compiled in "), notes
    compile_kernels(notes.append)
    assert len(notes) == 2, notes
    recorder.buffer.clear()
    before = ready()
    assert len(before) > 10, before
    make_demo(root / "demo", 3, 3, levels=(0, 5, 7))
    build_store(load_parameters(root / "demo" / "dataset.toml"), root / "s.zarr")
    sources = PixieverseSource(root / "few" / "pixieverse"), SlatSource(root / "few" / "slat")
    build_store(BuildParameters(*sources), root / "few.zarr")
    assert not recorder.buffer, recorder.buffer
    assert ready() == before, ready() ^ before
"""


def test_a_build_compiles_nothing_that_was_not_compiled_before_it(tmp_path):
    few, grid = Dataset(tmp_path / "few"), np.zeros((64, 64, 64, 4), np.float32)
    grid[..., 3] = 7
    grid[30:32, 30, 30] = 1000, 1e5, 0.3, 0
    few.write_grid("a", grid)
    latents = np.random.default_rng(0).normal(0, 2, (2, 8)).astype(np.float32)
    few.write_slat("a.npz", np.argwhere(grid[..., 3] == 0).astype(np.uint8), latents)
    python("-c", SCRIPT, tmp_path)


def test_on_a_full_disk_kernels_are_compiled_in_memory(monkeypatch):
    monkeypatch.setattr(IndexDataCacheFile, "save", no_room)
    monkeypatch.setattr(kernel, "KEPT", True)
    twice = kernel.kernel()(lambda value: 2 * value)
    assert twice(21) == 42


# Root may write anywhere, so Numba is left the one folder that cannot be made.
NOWHERE = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserWideCacheLocator", "XDG_CACHE_HOME": os.devnull}

UNKEPT = """
import numpy as np
import slatprep.align.deform_solver, slatprep.align.solver
from slatprep.geometry.fill import outside_of
from slatprep.pipeline import asset as kernels

shell = np.ones((3, 3, 3), dtype=bool)
shell[1, 1, 1] = False
assert not outside_of(shell).any()
assert outside_of(np.zeros((2, 2, 2), dtype=bool)).all()
assert "NUMBA_CACHE_DIR" in kernels.WHEN
"""


@pytest.mark.skipif(cpu_count() == 1, reason="one core starts no second process")
def test_no_process_goes_on_compiling_after_an_interrupt(tmp_path):
    # In the background a shell lets processes ignore SIGINT.
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from slatprep.pipeline.asset import compile_kernels; compile_kernels(print)"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    words = [sys.executable, "-u", "-c", code]
    with subprocess.Popen(words, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith(b"compiling")
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        wait_until(children.read_text)
        (helper,) = map(int, children.read_text().split())
        for _ in range(30):  # One that falls into a callback of LLVM is lost.
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(10)
                break
        assert process.poll()
        wait_until(lambda: not _runs(helper), 5)


def _runs(process: int) -> bool:
    """Return whether a process is there and is no zombie."""
    with suppress(FileNotFoundError):
        return ") Z " not in Path(f"/proc/{process}/stat").read_text()
    return False


def test_where_no_folder_can_be_written_to_kernels_are_compiled_anew():
    python("-c", UNKEPT, **NOWHERE)


def test_jobs_are_no_more_than_there_is_work_for():
    assert [at_most(assets // 20, 8) for assets in (0, 19, 40, 159, 1000)] == [1, 1, 2, 7, 8]
    cluster = SimpleNamespace(run_unordered=local.run_unordered)
    assert at_most(1, cluster) is cluster  # type: ignore[arg-type]


def test_few_assets_start_no_process(make_dataset, tmp_path, monkeypatch):
    def refuse(number: int) -> None:
        raise AssertionError(f"{number} processes for two assets")

    monkeypatch.setattr(local, "_Processes", refuse)
    parameters = make_dataset("a", "b").parameters()
    assert build_store(parameters, tmp_path / "s.zarr", jobs=4, assets_per_job=20).complete

"""A build in a process of its own, with a fault in it, forked of one that is ready to build."""

import contextlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import traceback
from functools import cache
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path
from unittest.mock import patch

from slatprep.errors import SlatprepError
from slatprep.pipeline.dataset import build_store
from support.faults import environment
from support.synthetic import Dataset


@cache
def _forks() -> ForkServerContext:
    """Start what builds are forked of, which imports all and loads the kernels once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["support.ready"])
    # What is imported ahead is not looked for where this process looks.
    with patch.dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path)):
        forkserver.ensure_running()
    return context


def kill_at(step: str, calls: int = 0) -> str:
    """Return the fault that ends the process when a step is reached after `calls` others."""
    return f"""
if step == {step!r}:
    seen.append(name)
    if len(seen) > {calls}:
        kill_self()
"""


class Build:
    """A build that was started with Pixie's ranges; `before` are statements to begin with."""

    def __init__(
        self, dataset: Dataset, out: Path, fault: str = "", jobs: int = 1, before: str = ""
    ) -> None:
        variables = environment(dataset.root.parent / "faults", fault)
        pipes = [_forks().Pipe(duplex=False) for _ in range(2)]
        self._read = [pipe[0] for pipe in pipes]
        streams = [pipe[1] for pipe in pipes]
        self._process = _forks().Process(
            target=_build, args=(dataset, out, jobs, before, variables, streams)
        )
        self._process.start()
        self.pid = self._process.pid or 0
        for stream in streams:
            stream.close()

    def kill(self) -> None:
        """Kill it, but not its workers."""
        self._process.kill()
        self._process.join()

    def kill_all(self) -> None:
        """Kill it and its workers, unless it has ended by itself."""
        with contextlib.suppress(ProcessLookupError):
            while os.getpgid(self.pid) != self.pid:
                time.sleep(0.01)
            os.killpg(self.pid, signal.SIGKILL)
        self._process.join()

    def done(self) -> "subprocess.CompletedProcess[str]":
        """Wait for its end."""
        self._process.join()
        told = [os.fdopen(os.dup(pipe.fileno())).read() for pipe in self._read]
        return subprocess.CompletedProcess([], self._process.exitcode or 0, *told)


def _build(
    dataset: Dataset,
    out: Path,
    jobs: int,
    before: str,
    variables: dict[str, str],
    streams: list[Connection],
) -> None:
    os.setsid()
    for number, stream in enumerate(streams, 1):
        os.dup2(stream.fileno(), number)
        stream.close()
    os.environ.update(variables)
    sys.path[:0] = variables["PYTHONPATH"].split(os.pathsep)
    sys.dont_write_bytecode = True  # The next fault may be written within the same second.
    code = 1
    try:
        exec(before)
        summary = build_store(dataset.parameters("pixie"), out, jobs=jobs)
        print(json.dumps([summary.statuses, dict(summary.problems)]), flush=True)
        code = 0
    except SlatprepError as error:
        print(f"refused: {error}", file=sys.stderr, flush=True)
    except Exception:
        traceback.print_exc()
    # An end as of a child process would wait for its own workers, which wait for more work.
    os._exit(code)

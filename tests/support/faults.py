"""Faults injected into builds, through the seam of `slatprep.storage.faults`."""

import errno
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from slatprep.storage.faults import VARIABLE

Fault = Callable[[str, str], object]

_here: list[Fault] = []


def call(step: str, name: str) -> None:
    """Stand at the seam of this process."""
    for fault in _here:
        fault(step, name)


def inject(monkeypatch: pytest.MonkeyPatch, fault: Fault) -> None:
    """Have builds in this process call a function at each of their steps."""
    monkeypatch.setattr(f"{__name__}._here", [*_here, fault])
    monkeypatch.setenv(VARIABLE, f"{__name__}:call")


def no_room(*_: object, **__: object) -> Any:
    """Fail as what writes does on a full disk."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def flip(path: Path, at: int, bit: int = 0) -> None:
    """Change one bit of a file."""
    data = bytearray(path.read_bytes())
    data[at] ^= 1 << bit
    path.write_bytes(data)


def wait_until(condition: Callable[[], object], seconds: float = 900.0) -> None:
    """Wait until something is so; fail where it never is."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.05)


def kill_self() -> None:
    """End this process as the kernel would."""
    os.kill(os.getpid(), signal.SIGKILL)


def environment(folder: Path, fault: str = "") -> dict[str, str]:
    """Return the environment of a process with a fault, the body of ``def reached(step, name)``."""
    folder.mkdir(exist_ok=True)
    here = str(Path(__file__).parents[1])
    paths = (str(folder), here, os.environ.get("PYTHONPATH", ""))
    variables = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(paths)}
    if fault:
        head = "import os, time\nfrom support.faults import kill_self\n\nseen = []\n\n\n"
        body = "".join(f"    {line}\n" for line in fault.strip("\n").splitlines())
        (folder / "faulty.py").write_text(f"{head}def reached(step, name):\n{body}")
        variables[VARIABLE] = "faulty:reached"
        # The next fault may be written within the second by which bytecode is known to be old.
        variables["PYTHONDONTWRITEBYTECODE"] = "1"
    return variables

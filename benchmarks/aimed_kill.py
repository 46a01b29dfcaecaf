"""Kill a build once, at one step of it; `soak_kills.py` sets the step and the process.

This module hooks into `slatprep.storage.faults`, in the build and in its workers, including
long-running workers of a cluster. The aim is a file in the folder that `FOLDER` names.
"""

from __future__ import annotations

import json
import os
import signal
from collections import Counter
from pathlib import Path

FOLDER = "SOAK_AIM"
"""Environment variable that names the folder."""

_seen: Counter[tuple[str, str]] = Counter()


def aim(folder: Path, step: str, calls: int, whom: str) -> None:
    """Have the next build killed.

    Parameters
    ----------
    folder : Path
        Where the aim is kept.
    step : str
        As `slatprep.storage.faults` names it.
    calls : int
        How often a process passes it before.
    whom : str
        ``self``, the process that reaches the step; ``parent``, the build; ``all``, both and
        what else is in the build's process group.
    """
    for name in ("done", "parent"):
        (folder / name).unlink(missing_ok=True)
    (folder / "aim.new").write_text(json.dumps([os.urandom(8).hex(), step, calls, whom]))
    (folder / "aim.new").replace(folder / "aim")


def begin() -> None:
    """Say that this process is the build."""
    Path(os.environ[FOLDER], "parent").write_text(str(os.getpid()))


def struck(folder: Path) -> bool:
    """Whether the kill came."""
    return (folder / "done").exists()


def reached(step: str, name: str) -> None:
    """Kill, if this is the step."""
    folder = Path(os.environ[FOLDER])
    turn, wanted, calls, whom = json.loads((folder / "aim").read_text())
    if step != wanted:
        return
    _seen[turn, step] += 1
    if _seen[turn, step] <= calls:
        return
    try:
        parent = int((folder / "parent").read_text())
        (folder / "done").touch(exist_ok=False)
    except (FileExistsError, FileNotFoundError):
        return  # Another process was first, or this one works for a build that is gone.
    if whom == "all":
        os.killpg(parent, signal.SIGKILL)
    elif whom == "parent":
        os.kill(parent, signal.SIGKILL)
    if whom != "parent":
        os.kill(os.getpid(), signal.SIGKILL)

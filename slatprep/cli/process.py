"""The command's process: its standard streams, and the signals that stop it.

Texts are printed even if a stream is closed or its disk is full. A signal raises KeyboardInterrupt
only where that stops the command: Python drops exceptions in destructors, and a thread of zarr
would go on writing into a folder that is being removed.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from types import FrameType

import click

_NAMES = {1: "standard output", 2: "standard error"}

_broken: dict[int, str] = {}
"""Reason why a stream cannot be written to, by its file descriptor."""

_untold: set[int] = set()
"""File descriptors of broken streams that lost a text."""

_asked: list[int] = []
"""Signals that asked this process to stop, and alarms that asked again."""

_WAITING = {"asyncio", "zarr"}
"""Packages within which no KeyboardInterrupt is raised."""

_WAITING_CALLS = "__del__", "_LateFaults.write", "_LateFaults.truncate"
"""Ends of the names of functions within which none is raised. Python drops exceptions of the first,
and HDF5 crashes the process after one of the others."""

_AGAIN, _MOST_AGAIN = 0.05, 200
"""Seconds until a stop that waits is tried again, and the number of times until it waits no more.
"""


class OutputLostError(Exception):
    """A command's result could not be printed on standard output."""


def prepare_streams() -> None:
    """Open closed standard streams as the null device.

    Otherwise a file that a command opens could get the descriptor of a closed stream, and texts
    that libraries print would go into this file.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError as error:
            os.open(os.devnull, os.O_RDWR)  # Takes the lowest free number, which is this one.
            if number in _NAMES:
                _broken[number] = error.strerror or "closed"
    # Python has no stream object for a descriptor that was closed when it started.
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: PTH123, SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: PTH123, SIM115


def emit(text: str, *, err: bool, nl: bool) -> None:
    """Print a text; raise OutputLostError if standard output cannot be written to.

    After a reader has closed its pipe, further texts are dropped and the command goes on. If
    standard error cannot be written to, `lost` reports this when the command ends.
    """
    number = 2 if err else 1
    if number not in _broken:
        try:
            click.echo(text, err=err, nl=nl)
            return
        except OSError as error:
            # The text still in the buffer must not fail again when Python ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
            if error.errno == errno.EPIPE:
                return  # The reader, such as `head`, has read enough.
            _broken[number] = error.strerror or str(error)
    _untold.add(number)
    if not err:
        raise OutputLostError


def lost() -> str:
    """Return which streams lost a text and why; empty if none did."""
    return "; ".join(
        f"{_NAMES[number]} cannot be written to ({_broken[number]})" for number in sorted(_untold)
    )


def prepare_stop() -> None:
    """Stop on SIGTERM, with which batch systems stop jobs, as on Ctrl-C.

    A SIGINT that is ignored, as in background jobs, stays ignored. On Windows, which has no alarms,
    everything stays as Python has it.
    """
    if sys.platform == "win32":
        return
    sys.unraisablehook = _not_dropped
    signal.signal(signal.SIGTERM, _stop)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _stop)


def stop_if_asked() -> None:
    """Raise KeyboardInterrupt if a signal asked to stop."""
    if _asked:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        raise KeyboardInterrupt


def ignore_stops() -> None:
    """Ignore signals from now on, as the command has ended, and Python ends by itself."""
    # If a KeyboardInterrupt left an `exec` of a text, as of a dataclass, ``python -m`` would kill
    # itself by SIGINT in spite of the exit code. CPython forgets that at the next `exec`.
    exec("")
    if sys.platform == "win32":
        return
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGALRM):
        signal.signal(number, signal.SIG_IGN)


def _stop(number: int, frame: FrameType | None) -> None:
    _asked.append(number)
    while frame and len(_asked) < _MOST_AGAIN:
        package = str(frame.f_globals.get("__name__")).partition(".")[0]
        if package in _WAITING or frame.f_code.co_qualname.endswith(_WAITING_CALLS):
            _ask_again()
            return
        frame = frame.f_back
    stop_if_asked()


def _ask_again() -> None:
    signal.signal(signal.SIGALRM, _stop)
    signal.setitimer(signal.ITIMER_REAL, _AGAIN)


def _not_dropped(raised: sys.UnraisableHookArgs) -> None:
    """Stop again where Python dropped the stop, as in a callback of an import; tell all else."""
    if _asked and raised.exc_type is KeyboardInterrupt:
        _ask_again()
    else:
        sys.__unraisablehook__(raised)

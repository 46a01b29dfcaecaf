"""Standard output and standard error, where either may be closed, or full."""

from __future__ import annotations

import errno
import os
import sys

import click

_NAMES = {1: "standard output", 2: "standard error"}

_broken: dict[int, str] = {}
"""Why a stream cannot be written to, by its file descriptor."""

_untold: set[int] = set()
"""The streams among them that something was to be printed on."""


class OutputLostError(Exception):
    """Standard output does not take what a command prints."""


def prepare_streams() -> None:
    """Open what is closed of the standard streams as the null device.

    A file that a command opens would else get the number of a closed stream, and what a library
    prints would go into that file.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError as error:
            os.open(os.devnull, os.O_RDWR)  # It takes the lowest number that is free.
            if number in _NAMES:
                _broken[number] = error.strerror or "closed"
    # Python has no stream for what was closed when it started.
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: PTH123, SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: PTH123, SIM115


def emit(text: str, *, err: bool, nl: bool) -> None:
    """Print a text; OutputLostError where standard output does not take it.

    What follows after a reader has closed its pipe is dropped, and the command goes on. That
    standard error does not take a text is told when the command ends, by `lost`.
    """
    number = 2 if err else 1
    if number not in _broken:
        try:
            click.echo(text, err=err, nl=nl)
            return
        except OSError as error:
            # What is still in the buffer must not fail again when Python ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
            if error.errno == errno.EPIPE:
                return  # Whoever reads has read enough, as `head` does.
            _broken[number] = error.strerror or str(error)
    _untold.add(number)
    if not err:
        raise OutputLostError


def lost() -> str:
    """Return which stream did not take what was printed and why, or an empty text."""
    return "; ".join(
        f"{_NAMES[number]} cannot be written to ({_broken[number]})" for number in sorted(_untold)
    )

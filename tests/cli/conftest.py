"""What the tests of the command line share."""

import shlex
from collections.abc import Callable

import click
import pytest

from slatprep.cli.commands import slatprep


@pytest.fixture
def parse_command() -> Callable[[str], None]:
    """Return a function that fails where a `slatprep` command line is not one."""
    return _parse_command


def _parse_command(line: str) -> None:
    program, *words = shlex.split(line)
    assert program == "slatprep"
    command: click.Command | None = slatprep
    while isinstance(command, click.Group):
        name, *words = words
        command = command.get_command(click.Context(command), name)
    assert command is not None, f"no such command: {line}"
    given, rest, _ = command.make_parser(click.Context(command)).parse_args(words)
    assert rest == [], line
    for parameter in command.params:
        assert not parameter.required or given.get(parameter.name or ""), line

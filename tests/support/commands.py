"""Commands as a user types them, in this process, and programs in another one."""

import json
import os
import shlex
import subprocess
import sys
from typing import Any

import click
from click.testing import CliRunner, Result

from slatprep.cli.commands import slatprep


def run(*words: object, code: int | None = 0) -> Result:
    """Run a command that ends with this exit code, whichever where it is None, and in words."""
    done = CliRunner().invoke(slatprep, [str(word) for word in words])
    assert done.exception is None or isinstance(done.exception, SystemExit), (words, done.exception)
    assert code is None or done.exit_code == code, (words, done.output)
    assert "Traceback" not in done.output, words
    return done


def refused(*words: object, code: int = 2) -> str:
    """Return what a command that ends with this exit code says on standard error."""
    return run(*words, code=code).stderr


def document(*words: object, code: int = 0) -> Any:
    """Return what a command prints as JSON."""
    return json.loads(run(*words, "--json", code=code).stdout)


def python(*words: object, code: int = 0, **variables: str) -> "subprocess.CompletedProcess[str]":
    """Run Python, which ends with this exit code, with more variables in its environment."""
    done = subprocess.run(
        [sys.executable, *map(str, words)],
        capture_output=True, text=True, check=False, env=os.environ | variables, timeout=600,
    )  # fmt: skip
    assert done.returncode == code, (words, done.stdout, done.stderr)
    return done


def parse_command(line: str) -> None:
    """Fail where a `slatprep` command line is not one."""
    program, name, *words = shlex.split(line)
    command = slatprep.get_command(click.Context(slatprep), name)
    assert program == "slatprep" and command is not None, f"no such command: {line}"
    given, rest, _ = command.make_parser(click.Context(command)).parse_args(words)
    assert rest == [], line
    for parameter in command.params:
        assert not parameter.required or given.get(parameter.name or ""), line

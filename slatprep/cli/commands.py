"""Define the table of commands, and the group that imports each command when it is used."""

from __future__ import annotations

import difflib
import errno
import pkgutil
import sys
import warnings
from pathlib import Path
from typing import Any, NoReturn

import click

from slatprep.cli import output
from slatprep.cli.output import say
from slatprep.cli.process import OutputLostError, lost
from slatprep.errors import ConfigError, SlatprepError

GROUPS = {
    "Make and build": {
        "make-demo": "slatprep.cli.build:make_demo",
        "extract-slat": "slatprep.cli.latents:extract_slat",
        "build-store": "slatprep.cli.build:build_store",
        "align": "slatprep.cli.build:align",
        "subset": "slatprep.cli.build:subset",
        "concat": "slatprep.cli.build:concat",
    },
    "Look and check": {
        "info": "slatprep.cli.info:info",
        "list": "slatprep.cli.info:list_assets",
        "stats": "slatprep.cli.info:stats",
        "report": "slatprep.cli.info:report",
        "check-alignment": "slatprep.cli.check:check_alignment",
        "score": "slatprep.cli.check:score",
        "measure-errors": "slatprep.cli.check:measure_errors",
    },
    "Take elsewhere": {
        "export": "slatprep.cli.export:export",
        "transfer": "slatprep.cli.particles:transfer",
        "simulate": "slatprep.cli.particles:simulate",
        "decode-slat": "slatprep.cli.latents:decode_slat",
        "describe": "slatprep.cli.export:describe",
        "publish": "slatprep.cli.export:publish",
    },
    "Learn": {
        "train": "slatprep.cli.learn:train",
        "predict": "slatprep.cli.learn:predict",
        "evaluate": "slatprep.cli.evaluate:evaluate",
    },
    "Maintain": {
        "verify": "slatprep.cli.verify:verify",
        "diff": "slatprep.cli.verify:diff",
    },
}
"""Commands by group; to add a command, add its name and function here.

`slatprep --help` imports all these modules, so they import heavy packages only when a command
runs.
"""

COMMANDS = {name: where for group in GROUPS.values() for name, where in group.items()}


def _loaded(name: str) -> click.Command:
    command: click.Command = pkgutil.resolve_name(COMMANDS[name])
    return command


def _say_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: object = None,
    line: str | None = None,
) -> None:
    """Print a warning; one for users has no line of code."""
    text = str(message)
    if not issubclass(category, UserWarning):
        text = warnings.formatwarning(message, category, filename, lineno, line).strip()
    say(f"slatprep: warning: {text}", err=True)


def _has_working_folder() -> bool:
    try:
        return bool(Path.cwd())
    except FileNotFoundError:
        return False


class LazyGroup(click.Group):
    """A group that imports a command when it is used, and prints errors as one line."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands' names in the order of the table."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the command named `cmd_name`."""
        return _loaded(cmd_name) if cmd_name in COMMANDS else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write each command's summary in full; click would cut it to one line."""
        widest = max(map(len, COMMANDS))
        for group, names in GROUPS.items():
            told = [
                (name.ljust(widest), _loaded(name).get_short_help_str(limit=1_000))
                for name in names
            ]
            with formatter.section(group):
                formatter.write_dl(told)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; for an unknown name, suggest a similar one."""
        close = difflib.get_close_matches(args[0], COMMANDS, n=1)
        if close and args[0] not in COMMANDS:
            ctx.fail(f"no such command {args[0]!r}; did you mean {close[0]}?")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; print an expected error as one line and set the exit code."""
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _say_warning
                done = super().invoke(ctx)
        except OutputLostError:
            self._fail_unprinted(ctx)
        except SlatprepError as error:
            say(f"slatprep: error: {error}", err=True)
            ctx.exit(
                output.EXIT_USAGE if isinstance(error, ConfigError) else output.EXIT_INCOMPLETE
            )
        except OSError as error:
            # A disk or an object store failed at a place without a message of its own.
            place, advice = error.filename, "run again"
            if place is None:
                if _has_working_folder():
                    raise
                place, advice = "working folder", "change to one that exists"
            elif error.errno == errno.ENAMETOOLONG:
                advice = "give a shorter name"
            say(f"slatprep: error: {place}: {error.strerror}; {advice}", err=True)
            ctx.exit(output.EXIT_INCOMPLETE)
        except MemoryError:
            say(
                "slatprep: error: memory ran out; run where more is free, or with fewer --jobs",
                err=True,
            )
            ctx.exit(output.EXIT_INCOMPLETE)
        except KeyboardInterrupt as stop:
            told = str(stop) or getattr(ctx.obj, "if_stopped", output.NOTHING_REPLACED)
            say(f"\nslatprep: stopped; {told}", err=True)
            ctx.exit(output.EXIT_INTERRUPTED)
        if lost():
            self._fail_unprinted(ctx)
        return done

    def _fail_unprinted(self, ctx: click.Context) -> NoReturn:
        """Print on the remaining stream that the result could not be printed."""
        if not lost().startswith("standard error") or "--json" not in sys.argv:
            told = f"slatprep: error: {lost()}; {output.DONE}"
            say(told, err="standard output" in lost())
        ctx.exit(output.EXIT_UNPRINTED)


@click.command(
    cls=LazyGroup,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 100,
        "show_default": True,
    },
    epilog="\b\nExit codes:\n"
    + "".join(f"  {code:<4} {words}\n" for code, words in output.EXIT_CODES.items())
    + """
\b
Example:
  slatprep make-demo demo --assets 12 --seed 0
  slatprep build-store --config demo/dataset.toml --out demo.zarr
""",
)
@click.version_option(package_name="slatprep", prog_name="slatprep")
def slatprep() -> None:
    """Turn PixieVerse grids and TRELLIS latents into one store of aligned supervision."""

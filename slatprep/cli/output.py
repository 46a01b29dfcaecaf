"""Print for all commands: tables, notes, JSON and a progress bar.

Results go to standard output, everything else to standard error. On a terminal,
tables are drawn with rich, which respects NO_COLOR; in a pipe they are plain
aligned columns. With ``--json``, standard output is one JSON document.
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click

from slatprep.cli.process import emit, stop_if_asked
from slatprep.errors import SlatprepError, in_unicode, printable
from slatprep.storage.place import is_place, place_of, storage_of
from slatprep.workers import Progress

EXIT_INCOMPLETE, EXIT_USAGE, EXIT_UNPRINTED, EXIT_INTERRUPTED = 1, 2, 3, 130

EXIT_CODES = {
    0: "all went in, or the check passed",
    EXIT_INCOMPLETE: "something did not go in, a check failed, or a file cannot be read or written",
    EXIT_USAGE: "wrong use: an option, a dataset definition, a name, or an extra that is missing",
    EXIT_UNPRINTED: "the work is done, but its result could not be printed",
    EXIT_INTERRUPTED: "stopped with Ctrl-C or SIGTERM; a store is the old or the new one",
}
"""Meaning of each exit code, for every command."""

NOTHING_REPLACED = "nothing was replaced; run it again to start anew"
DONE = "the work is done, run it again to see the result"
"""Texts of a stopped command that has not said anything else, and of one that was printing."""

Cell = str | int | float | bool | None

_STYLES = {"good": "green", "doubtful": "yellow", "failed": "red"}

_MAY_SHRINK = ("category", "group", "model", "why", "A", "B")
"""Columns whose texts are cut or wrapped between words on a narrow terminal."""
_LEAST_WIDTH, _GAP = 12, 2
_LEAST_ID = 8
_LISTED = 10
_SECONDS_BETWEEN_LINES = 30.0
_LEAST_DONE = 2
"""Smallest number of finished assets for an estimate of the time left."""


class Output:
    """Printer of one command's results, as tables or JSON.

    With `as_json`, standard output is one JSON document instead of tables. `verbosity` -1 prints
    only problems, and results that go to no file; 1 prints more details. If the command is
    stopped, `if_stopped` is printed: what was replaced or kept, and how to go on. `store` is the
    one that the command was given, for JSON.
    """

    def __init__(self, as_json: bool = False, verbosity: int = 0, command: str = "") -> None:
        self.as_json = as_json
        self.verbosity = verbosity
        self.command = command
        self.if_stopped = NOTHING_REPLACED
        self.store: object = None

    def result(self, document: object, show: Callable[[], None], complete: bool = True) -> None:
        """Print a result: the document as JSON, otherwise by `show`.

        The document is a mapping or a dataclass. Its entries follow the command, the version and
        ``ok``, which says whether the result is `complete`. If not, exit with `EXIT_INCOMPLETE`.
        """
        self.if_stopped = DONE
        if self.as_json:
            fields = vars(document) if is_dataclass(document) else document
            read = {"store": self.store} if self.store else {}
            self._say_document(complete, {**read, **fields})  # type: ignore[dict-item]
        else:
            show()
        if not complete:
            click.get_current_context().exit(EXIT_INCOMPLETE)

    def _say_document(self, ok: bool, fields: Any) -> None:
        say(as_json({"command": self.command, "version": version("slatprep"), "ok": ok, **fields}))

    @contextmanager
    def failing(self) -> Iterator[None]:
        """With ``--json``, print an error that ends the command as JSON too."""
        try:
            yield
        except (SlatprepError, click.UsageError, OSError) as error:
            if self.as_json:
                told = error.format_message() if isinstance(error, click.UsageError) else str(error)
                self._say_document(False, {"error": told})
            raise

    def made(self, document: object, show: Callable[[], None], complete: bool = True) -> None:
        """Print a summary of written files like `result`; if quiet, only as JSON."""
        self.result(document, show if self.verbosity >= 0 else lambda: None, complete)

    def counted(
        self, title: str, counts: Mapping[str, Cell], *, complete: bool = True, **more: object
    ) -> None:
        """Print counts of written items as a table of one row; JSON also has the entries `more`."""
        self.made({**more, **counts}, lambda: self.record(title, counts), complete)

    def note(self, message: str) -> None:
        """Print a line on standard error, unless quiet."""
        if self.verbosity >= 0:
            say(message, err=True)

    def problem(self, message: str) -> None:
        """Print a line about a failure on standard error."""
        say(message, err=True)

    def problems(self, messages: Sequence[str], where: str) -> None:
        """Print the first lines about failures, and `where` to find the rest, if there are more."""
        for message in messages[:_LISTED]:
            self.problem(message)
        if len(messages) > _LISTED:
            self.problem(f"and {len(messages) - _LISTED:,} more: {where}")

    def table(self, title: str, columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> None:
        """Print a table; columns of numbers are aligned to the right."""
        rows = list(rows)
        numeric = [
            bool(rows) and all(_is_number(row[k]) for row in rows) for k in range(len(columns))
        ]
        draw = _rich_table if sys.stdout.isatty() else _plain_table
        draw(title, columns, [[_text(cell) for cell in row] for row in rows], numeric)

    def id_length(self, ids: Iterable[str]) -> int | None:
        """Return the length of unique id prefixes if on a terminal, else None for whole ids."""
        if not sys.stdout.isatty():
            return None
        length, ids = _LEAST_ID, sorted(set(ids))
        for one, next_one in itertools.pairwise(ids):
            while one[:length] == next_one[:length]:
                length += 1
        return length

    def record(self, title: str, cells: Mapping[str, Cell]) -> None:
        """Print a table of one row, given as a mapping of columns to cells."""
        self.table(title, tuple(cells), [tuple(cells.values())])

    @contextmanager
    def progress(self, label: str, unit: str = "assets") -> Iterator[Progress]:
        """Show progress and the estimated time left on standard error.

        The estimate uses the mean time over all finished assets, once there are two. An update
        with 0 done restarts the clock. If standard error is not a terminal, a line is printed
        every half minute instead of a bar. An update raises KeyboardInterrupt if a signal asked
        to stop, and the exception was lost.
        """
        shown: AbstractContextManager[Progress]
        if self.verbosity < 0:
            shown = nullcontext(lambda done, total: None)
        elif not sys.stderr.isatty():
            shown = nullcontext(_progress_lines(label, unit))
        else:
            shown = _progress_bar(label)
        with shown as show:

            def update(done: int, total: int) -> None:
                stop_if_asked()
                show(done, total)

            yield update

    @contextmanager
    def new_file(self, file: Path) -> Iterator[Path]:
        """Yield a temporary path that then replaces `file`; StoreError if it is not writable."""
        from slatprep.storage.atomic import staged, writing

        with writing(str(file), file.parent), staged(file) as path:
            yield path
        self.if_stopped = f"{file} is new; run it again to make all"


def write_csv(
    output: Output, file: Path, header: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Write a table as CSV whose texts cannot become formulas in a spreadsheet."""
    import csv

    with output.new_file(file) as path, path.open("w", encoding="utf-8", newline="") as opened:
        csv.writer(opened).writerows([header, *(map(_for_spreadsheet, row) for row in rows)])


def _for_spreadsheet(value: object) -> object:
    if not isinstance(value, str):
        return value
    # Users may also print the file on a terminal.
    text = printable(value)
    return f"'{text}" if text.lstrip()[:1] in ("=", "+", "-", "@") else text


def say(text: object = "", *, err: bool = False, nl: bool = True) -> None:
    """Print text through `printable`; all commands use this function."""
    emit(printable(str(text)), err=err, nl=nl)


OUTPUT_OPTIONS = (
    click.Option(["--json", "as_json"], is_flag=True, help="Print JSON instead of tables."),
    click.Option(
        ["-q", "--quiet"], is_flag=True, help="Print only problems, and results that go to no file."
    ),
    click.Option(["-v", "--verbose"], is_flag=True, help="Print more details."),
)
"""Options of every command; the command's runner reads them."""


class PrintingCommand(click.Command):
    """A command with `OUTPUT_OPTIONS`; with ``--json`` it also prints wrong use as JSON."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, as click does."""
        # This precedes parsing, because click removes parsed words from the list.
        as_json = "--json" in args and not ctx.resilient_parsing
        with Output(as_json, 0, ctx.command_path.partition(" ")[2]).failing():
            try:
                return super().parse_args(ctx, args)
            except click.BadParameter as error:
                if told := _in_words(error):
                    raise click.BadParameter(told, ctx, error.param) from None
                raise


def _in_words(error: click.BadParameter) -> str:
    """Return why a word is not a number, in plainer words than click's; empty if it is one."""
    kind = error.param and error.param.type
    value, wrong, _ = error.message.partition(" is not a ")
    if not wrong or not isinstance(kind, click.IntRange | click.FloatRange):
        return ""
    words = ("above" if kind.min_open else "at least", kind.min), ("at most", kind.max)
    ends = " and ".join(f"{word} {end:g}" for word, end in words if end is not None)
    noun = "whole number" if isinstance(kind, click.IntRange) else "number"
    return f"{value} is no {noun}; expected a {noun} of {ends}"


def local_path(value: Any) -> Any:
    """Return an option's value; refuse a path that is a URL, or that UTF-8 cannot hold."""
    if is_place(value) and str(value) != in_unicode(str(value)):
        raise click.UsageError(f"{in_unicode(str(value))}: expected a path in UTF-8")
    if not isinstance(value, Path):
        return value  # The types of options that may be a URL convert it themselves.
    place = place_of(value)
    if storage_of(place).local is None:
        raise click.UsageError(f"{place}: expected a path of the local disk")
    return place


def as_json(document: object) -> str:
    """Return a result as JSON: paths and URLs as strings, NaN as null."""
    import orjson

    options = orjson.OPT_INDENT_2 | orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS
    return orjson.dumps(document, default=_jsonable, option=options).decode()


def _jsonable(value: object) -> object:
    if is_place(value):
        return str(value)
    raise TypeError(f"{type(value).__name__} in a result")


def _is_number(cell: Cell) -> bool:
    """Return whether a cell may be in a column of numbers."""
    return cell is None or (isinstance(cell, int | float) and not isinstance(cell, bool))


def _text(cell: Cell) -> str:
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return "-"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, int):
        return f"{cell:,}"
    if isinstance(cell, float):
        size = abs(cell)
        if 0 < size < 5e-4:
            return f"{cell:.1e}"
        return f"{cell:.3f}" if size < 1e4 else f"{cell:,.0f}" if size < 1e7 else f"{cell:.3g}"
    # A cell must be a single line.
    return printable(str(cell)).replace("\n", "\\n")


def _rich_table(
    title: str, columns: Sequence[str], cells: list[list[str]], numeric: list[bool]
) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False, show_edge=False)
    needed = 0
    for k, (column, right) in enumerate(zip(columns, numeric, strict=True)):
        heading = column.replace("_", "_\n")  # A figure's name may be wider than its numbers.
        widest = max(map(len, [*heading.split("\n"), *(row[k] for row in cells)]))
        fits = column not in _MAY_SHRINK
        least = widest if fits else min(widest, _LEAST_WIDTH)
        needed += least + _GAP
        table.add_column(
            Text(heading),
            justify="right" if right else "left",
            no_wrap=fits,
            min_width=least,
            overflow="fold" if fits else "ellipsis",
        )
    for row in cells:
        table.add_row(*(Text(text, style=_STYLES.get(text, "")) for text in row))
    console = Console(file=sys.stdout, highlight=False)
    # On a narrow terminal a line may wrap, but an id or a number is never cut.
    console.width = max(console.width, needed - _GAP)
    with console.capture() as drawn:
        console.print(Text(title, style="bold"), table, "", sep="\n")
    emit(drawn.get(), err=False, nl=False)


def _plain_table(
    title: str, columns: Sequence[str], cells: list[list[str]], numeric: list[bool]
) -> None:
    lines = [list(columns), *cells]
    widths = [max(len(line[k]) for line in lines) for k in range(len(columns))]
    say(title)
    for line in lines:
        padded = (
            text.rjust(width) if right else text.ljust(width)
            for text, width, right in zip(line, widths, numeric, strict=True)
        )
        say("  ".join(padded).rstrip())
    say()


def _progress_lines(label: str, unit: str) -> Progress:
    start = last = time.monotonic()

    def update(done: int, total: int) -> None:
        nonlocal start, last
        now = time.monotonic()
        if done == 0:
            start = now
        elif done >= _LEAST_DONE and now - last >= _SECONDS_BETWEEN_LINES:
            left = _clock((now - start) / done * (total - done))
            say(f"{label}: {done:,} of {total:,} {unit}, {left} left", err=True)
            last = now

    return update


@contextmanager
def _progress_bar(label: str) -> Iterator[Progress]:
    from rich import progress as rich
    from rich.console import Console
    from rich.text import Text

    class Numbers(rich.ProgressColumn):
        """Column with the number done, the time taken, and the estimated time left."""

        def render(self, task: rich.Task) -> Text:
            if task.total is None:
                return Text("starting ...")
            spent = task.elapsed or 0.0
            parts = [f"{task.completed:,.0f}/{task.total:,.0f}", _clock(spent)]
            if _LEAST_DONE <= task.completed < task.total:
                parts.append(f"{_clock(spent * (task.total / task.completed - 1))} left")
            return Text(" · ".join(parts))

    console = Console(stderr=True)
    columns = rich.TextColumn("{task.description}"), rich.BarColumn(), Numbers()
    with rich.Progress(*columns, console=console) as progress:
        task = progress.add_task(label, total=None)

        def update(done: int, total: int) -> None:
            if done == 0:
                progress.reset(task, total=total)
            progress.update(task, completed=done, total=total)

        yield update


def _clock(seconds: float) -> str:
    """Return a time as minutes and seconds, or hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"

"""Declaring commands and options, and the options that several commands share."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import inspect
import math
import pkgutil
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import click

from slatprep.cli.output import OUTPUT_OPTIONS, Output, PrintingCommand, with_output
from slatprep.cli.targets import NewPath
from slatprep.storage.place import place_of, storage_of

if TYPE_CHECKING:
    from slatprep.parameters import BuildParameters
    from slatprep.readers.splits import Assignment, Shares
    from slatprep.records import Place
    from slatprep.store import Store

    _Choice = click.Choice[str]
else:
    _Choice = click.Choice

_Function = TypeVar("_Function", bound=Callable[..., object])

_SECTION = re.compile(r"^(\w[\w ]*)\n-+\n", re.M)
_OPTION = re.compile(r"^(--[\w-]+): (.*(?:\n .*)*)", re.M)

POSITIVE = click.IntRange(min=1)
FILE = click.Path(path_type=Path, exists=True, dir_okay=False)
FOLDER = click.Path(path_type=Path, exists=True, file_okay=False)
NEW_PATH = NewPath(path_type=Path)
NEW_FILE = NewPath(path_type=Path, dir_okay=False)
NEW_FOLDER = NewPath(path_type=Path, file_okay=False)
RECORDS_FOLDER = click.Path(path_type=Path, file_okay=False)
"""Of a build, which looks itself at what lies there."""


class FiniteRange(click.FloatRange):
    """A range of finite numbers; NaN passes the comparisons of click's."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number; `click.BadParameter` if it is none of the range."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number", param, ctx)
        return number


class PlaceType(click.Path):
    """A path, which click checks, or the URL of an object store, which is not checked here."""

    def convert(
        self, value: Any, parameter: click.Parameter | None, context: click.Context | None
    ) -> Any:
        """Return a place."""
        place = place_of(value)
        if storage_of(place).local is None:
            return place
        return super().convert(str(place), parameter, context)


class ChoiceOf(_Choice):
    """A choice of words from a module, which is imported when the words are needed.

    ``slatprep --help`` imports every command, and must not import numpy with them.

    Parameters
    ----------
    name : str
        Name of an enum, a Literal, a mapping or a sequence of words, as
        ``package.module:NAME``.
    *others : str
        More words.
    """

    def __init__(self, name: str, *others: str) -> None:
        self._source = name
        self._others = others
        self.case_sensitive = True

    @property
    def choices(self) -> tuple[str, ...]:  # type: ignore[override]
        """Return the words."""
        listed = pkgutil.resolve_name(self._source)
        return (*map(str, get_args(listed) or listed), *self._others)


def option(
    flag: str,
    kind: Any = None,
    default: Any = None,
    text: str | None = None,
    *,
    name: str | None = None,
    **others: Any,
) -> Callable[[_Function], _Function]:
    """Declare an option: its flag, type, default and, if commands share it, its help.

    `name` is the function's parameter for the value, if it differs from the flag; all other
    arguments are those of `click.option`.
    """
    if default is not None:
        others["default"] = default
    return click.option(*filter(None, (flag, name)), type=kind, help=text, **others)


def command(name: str | None = None, **settings: Any) -> Callable[[_Function], click.Command]:
    """Make a command of a function, whose docstring is its help.

    The section ``Options`` of the docstring has the help of each option; all other sections,
    such as ``Example``, are printed below the options. The function gets an `Output` as its
    first argument, made from the options ``--json``, ``-q`` and ``-v``.

    Raises
    ------
    ValueError
        If the docstring and the declaration do not have the same options.
    """

    def declare(function: _Function) -> click.Command:
        text, *sections = _SECTION.split(inspect.getdoc(function) or "")
        described = dict(zip(sections[::2], sections[1::2], strict=True))
        helps = dict(_OPTION.findall(described.pop("Options", "")))
        below = [f"\b\n{title}:\n{indent(body, '  ')}" for title, body in described.items()]
        declared = click.command(
            name, PrintingCommand, help=text, epilog="\n\n".join(below), **settings
        )
        made = declared(with_output(function))
        made.params += OUTPUT_OPTIONS
        undescribed = False
        for parameter in made.params:
            if isinstance(parameter, click.Option) and parameter.help is None:
                words = " ".join(helps.pop(parameter.opts[0], "").split())
                parameter.help = words.replace(" [default:", "  [default:")
                undescribed |= not words
        # Python's -OO removes docstrings, and the help with them.
        if function.__doc__ and (helps or undescribed):
            raise ValueError(f"{made.name}: its docstring does not describe its options")
        return made

    return declare


PLACE = PlaceType(path_type=Path)
"""A path or a URL, which need not exist."""

EXISTING_FOLDER = PlaceType(path_type=Path, exists=True, file_okay=False)
"""A folder that exists, a store as well, or a URL."""


_PIXIEVERSE = "Root of the PixieVerse grids or predictions, a folder or a URL."
_MAP = "CSV that joins the ids of the two sides, or TRELLIS's metadata.csv."
_SAMPLES = (
    "Where an object has several annotations: refuse it, take the first, make an asset of each, "
    "or merge their labels in one asset.  [default: one]"
)
_ENCODER = "The encoder of the latents.  [default: trellis]"
_RANGES = "Where the normalisation ranges come from; p1-p99: percentiles.  [default: dataset]"
_RANGES_OF = "Objects that ranges of the dataset are computed from.  [default: all]"
_PRESET = "Named parameters; 'paper' is the protocol of SLAT-Phys, in Pixie's ranges."


def source_options(command: _Function) -> _Function:
    """Add the options that decide the parameters of a build."""
    preset = ChoiceOf("slatprep.parameters:PRESETS")
    options = (
        option("--config", FILE, text="Dataset definition (TOML); options override it."),
        option("--pixieverse", PLACE, text=_PIXIEVERSE),
        option("--slat", PLACE, text="Root of the TRELLIS latents, or one HDF5 file, or a URL."),
        option("--samples", ChoiceOf("slatprep.parameters:Samples"), text=_SAMPLES),
        option("--encoder", text=_ENCODER, metavar="NAME|FILE.json"),
        option("--map", PLACE, text=_MAP),
        option("--ranges", text=_RANGES, metavar="dataset|pLO-pHI|pixie|FILE"),
        option("--ranges-of", click.Choice(["all", "train"]), text=_RANGES_OF),
        split_options,
        option("--preset", preset, text=_PRESET),
    )
    return functools.reduce(lambda decorated, add: add(decorated), reversed(options), command)


def chosen_store(store: Place | None) -> Place:
    """Return the named store, or else the one that `make align` built last."""
    if store is not None:
        return store
    built = sorted(Path("data").glob("*.zarr"), key=lambda path: path.stat().st_mtime)
    if not built:
        raise click.UsageError("there is no store under data/; name one, or run `make align`")
    return built[-1]


store_argument = click.argument(
    "store",
    required=False,
    type=EXISTING_FOLDER,
    callback=lambda _context, _parameter, store: chosen_store(store),
)
"""The store, by default the one built last."""

store_option = option(
    "--store",
    EXISTING_FOLDER,
    text="The store.  [default: the one built last under data/]",
    metavar="STORE.zarr",
)


def beside(store: Place, suffix: str) -> Path:
    """Return NAME`suffix` beside NAME.zarr, or in the working folder for an object store."""
    name = f"{store.name.removesuffix('.zarr')}{suffix}"
    local = storage_of(store).local
    return local.with_name(name) if local else Path(name)


def complete_asset(
    context: click.Context, parameter: click.Parameter, incomplete: str
) -> list[str]:
    """Return the store's asset ids, for completion in the shell."""
    from slatprep.store import open_store
    from slatprep.store.reader import is_store

    # An option that still lacks its value leaves the arguments unparsed.
    for word in (context.params.get("store"), *context.args):
        if word is not None and is_store(Path(word)):
            return [known for known in open_store(word).ids if known.startswith(incomplete)]
    return []


verdicts_option = option(
    "--verdict",
    ChoiceOf("slatprep.records:Verdict", "all"),
    text="Only assets with this verdict; may be repeated.  [default: good and doubtful]",
    name="verdicts",
    multiple=True,
    callback=lambda _context, _parameter, given: () if "all" in given else given or None,
)
"""The verdicts; empty for all, None if the option was not given."""


def require_categories(store: Store, categories: Sequence[str]) -> None:
    """Refuse a category that no asset of a store has, and suggest a similar one."""
    known = sorted(set(map(str, store.column("category"))))
    for category in categories:
        if category not in known:
            close = difflib.get_close_matches(category, known, n=1) or list(filter(None, known))
            expected = f"expected {', '.join(close)}" if close else "no category is known"
            raise click.BadParameter(
                f"no asset has {category!r}; {expected}", param_hint="--category"
            )


def note_left_out(output: Output, store: Store) -> None:
    """Print how many assets of a store are left out by the default verdicts."""
    from slatprep.records import USABLE

    left = Counter(str(v) for v in store.column("verdict") if v not in USABLE)
    if left:
        counts = ", ".join(f"{count:,} {verdict}" for verdict, count in sorted(left.items()))
        output.note(f"left out: {counts} (--verdict all takes them)")


def _at_most_the_cores(_context: click.Context, _parameter: click.Parameter, jobs: int) -> int:
    if jobs == 1:
        return jobs
    from joblib.externals.loky import cpu_count

    return min(jobs, int(cpu_count()))


jobs_option = option(
    "--jobs",
    POSITIVE,
    1,
    "Worker processes, of one thread each; no more than there are cores.",
    callback=_at_most_the_cores,
)


def workers_options(command: _Function) -> _Function:
    """Add ``--jobs`` and ``--scheduler``; the function gets the choice as `jobs`.

    As a decorator it stands below `command`, since it passes on the `Output`.
    """

    @jobs_option
    @option(
        "--scheduler",
        text="Compute on the Dask cluster of this scheduler, as tcp://host:8786, instead of here.",
        metavar="ADDRESS",
    )
    @functools.wraps(command)
    def with_workers(output: Output, *, jobs: int, scheduler: str | None, **options: Any) -> object:
        if scheduler is None:
            return command(output, jobs=jobs, **options)
        given = click.get_current_context().get_parameter_source("jobs")
        if given is not click.core.ParameterSource.DEFAULT:
            raise click.UsageError(
                "--jobs is for this machine, and --scheduler uses all workers that the cluster "
                "has; give one of them"
            )
        from slatprep.workers.dask import Cluster

        with Cluster(scheduler, output.note) as cluster:
            return command(output, jobs=cluster, **options)

    return with_workers  # type: ignore[return-value]


def parameters_of(options: dict[str, Any]) -> BuildParameters:
    """Load parameters from the options of `source_options` and of the passes.

    Parameters
    ----------
    options : dict
        The values of all options of a command; those used here are removed.

    Returns
    -------
    BuildParameters
        The parameters.
    """
    from slatprep.parameters.files import OPTIONS, load_parameters

    given: dict[str, dict[str, object]] = {}
    for name, flag in OPTIONS.items():
        if (value := options.pop(flag.removeprefix("--").replace("-", "_"))) is None:
            continue
        group, key = name.split(".")
        if key == "shares":
            value = dataclasses.astuple(_shares(value))
        elif not isinstance(value, str):
            value = str(value.absolute())
        given.setdefault(group, {})[key] = value
    for name in ("consensus", "witness"):
        if options.pop(name, False):
            given[name] = {"settle": True}
    return load_parameters(options.pop("config"), given, options.pop("preset"))


def split_options(command: _Function) -> _Function:
    """Add ``--split-by`` and ``--shares``, for `split_rule`."""
    by = option(
        "--split-by",
        text="How objects are split: by a hash of their ids; by Pixie's rule; one category for "
        "testing; or by a file of ids: a list for testing, or a JSON object with the lists train, "
        "val and test.  "
        "[default: hash]",
        metavar="hash|pixie|category:NAME|FILE",
    )
    shares = option(
        "--shares",
        text="Shares of the split by hash, which also divides objects that another rule does not "
        "test on into train and val.  [default: 0.8,0.1,0.1]",
        metavar="TRAIN,VAL,TEST",
    )
    return by(shares(command))


def split_rule(split_by: str | None, shares: str | None) -> dict[str, Any]:
    """Return ``by`` and ``shares`` for `slatprep.learn.splits.assign_store`."""
    from slatprep.readers.splits import HASH, Shares

    return {
        "by": HASH if split_by is None else split_by,
        "shares": Shares() if shares is None else _shares(shares),
    }


def note_split(output: Output, assignment: Assignment, how: str) -> None:
    """Print the sizes of the splits, and ids of a file and of the store that are in none."""
    counts = ", ".join(f"{len(ids):,} {split}" for split, ids in assignment.lists().items())
    output.note(f"split:   {how}: {counts}")
    for ids, what in (
        (assignment.unknown, "are of no object of the store that has a valid voxel"),
        (assignment.unlisted, "of the store are in none of its lists, and left out"),
    ):
        if ids:
            output.note(f"note:    {len(ids):,} ids {what}: {', '.join(ids[:3])[:200]} ...")


def _shares(text: str) -> Shares:
    from slatprep.readers.splits import Shares

    try:
        train, val, test = (float(part) for part in text.split(","))
    except ValueError as error:
        raise click.BadParameter(
            f"{text!r} is not three numbers such as 0.8,0.1,0.1", param_hint="--shares"
        ) from error
    return Shares(train, val, test)

"""Define the types of values that commands take, and options that several commands share."""

from __future__ import annotations

import dataclasses
import math
import pkgutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import click

from slatprep.cli.output import Output
from slatprep.cli.signature import Click, NewPath, SomePath
from slatprep.errors import StoreError, amount, first_of, tally
from slatprep.storage.place import is_place, place_of, storage_of

if TYPE_CHECKING:
    from slatprep.parameters import BuildParameters
    from slatprep.readers.splits import Shares, Split
    from slatprep.records import Place
    from slatprep.store import Store
    from slatprep.workers.local import Workers

    _Choice = click.Choice[str]
else:
    Place = Path  # Signatures need no records, which would import numpy.
    _Choice = click.Choice


class FiniteRange(click.FloatRange):
    """A range of finite numbers; click's own range accepts NaN."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number; raise `click.BadParameter` if it is outside the range."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number", param, ctx)
        return number


class Whole(click.IntRange):
    """A range of whole numbers of at most 32 bits, which fit every function that takes them."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the number; raise `click.BadParameter` if it is outside the range."""
        number: int = super().convert(value, param, ctx)
        if number >= 2**32:
            self.fail(f"{value} is above {2**32 - 1}", param, ctx)
        return number


class PlaceType(SomePath):
    """A path, which click checks, or the URL of an object store, which is not checked."""

    def convert(
        self, value: Any, parameter: click.Parameter | None, context: click.Context | None
    ) -> Any:
        """Return the value as a place."""
        if value == "":
            return super().convert(value, parameter, context)
        place = place_of(value)
        if str(place).startswith("memory://"):
            self.fail(
                f"{place} is gone when the command ends; expected a path, or a URL that lasts"
            )
        if storage_of(place).local is None:
            return place
        return super().convert(str(place), parameter, context)


class ChoiceOf(_Choice):
    """A choice of words from a module, which is imported when the words are needed.

    ``package.module:NAME`` is an enum, a Literal, a mapping or a sequence of words; `others` are
    added to them. ``slatprep --help`` imports every command, and must not import numpy.
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


Positive = Annotated[int, Whole(min=1)]
Above0 = Annotated[float, FiniteRange(min=0, min_open=True)]
Count = Annotated[int, Whole(min=0)]
Seed = Count
"""A seed of NumPy's generators, which must not be negative."""
File = Annotated[Path, SomePath(path_type=Path, exists=True, dir_okay=False)]
Folder = Annotated[Path, SomePath(path_type=Path, exists=True, file_okay=False)]
FileOrFolder = Annotated[Path, SomePath(path_type=Path, exists=True)]
NewFile = Annotated[Path, NewPath(path_type=Path, dir_okay=False)]
NewFolder = Annotated[Path, NewPath(path_type=Path, file_okay=False)]
NewFileOrFolder = Annotated[Path, NewPath(path_type=Path)]
RecordsFolder = Annotated[
    Path,
    SomePath(path_type=Path, file_okay=False),
    "Folder for the records. [default: beside the store]",
]
"""Folder for a build's records; the build itself checks an existing folder."""
PathOrUrl = Annotated[Place, PlaceType(path_type=Path)]
"""A path that need not exist, or a URL."""
FileOrUrl = Annotated[Place, PlaceType(path_type=Path, exists=True)]
"""A file or folder that exists, or a URL."""
FolderOrUrl = Annotated[Place, PlaceType(path_type=Path, exists=True, file_okay=False)]
"""A folder that exists, such as a store, or a URL."""


def opened(store: Place) -> Store:
    """Open a store; the import is local, because ``slatprep --help`` does not need it."""
    from slatprep.store import open_store

    return open_store(store)


def chosen_store(store: Place | None) -> Place:
    """Return the named store, otherwise the store that `make align` built last."""
    if store is not None:
        return store
    built = (path for path in Path("data").glob("*.zarr") if path.is_dir())
    newest = max(built, key=lambda path: path.stat().st_mtime, default=None)
    if newest is None:
        raise click.UsageError("there is no store under data/; name one, or run `make align`")
    return newest


LastStore = Annotated[
    FolderOrUrl, Click(required=False, callback=lambda _context, _parameter, it: chosen_store(it))
]
"""A store; by default the one built last under data/."""

StoreOption = Annotated[
    FolderOrUrl,
    "The store. [default: the one built last under data/]",
    Click("--store", metavar="STORE.zarr"),
]


def _drawable(
    _context: click.Context, _parameter: click.Parameter, picture: Path | None
) -> Path | None:
    if picture is not None:
        from slatprep.records import PICTURE_FORMATS

        if picture.suffix[1:].lower() not in PICTURE_FORMATS:
            raise click.BadParameter(f"{picture} ends in none of .{', .'.join(PICTURE_FORMATS)}")
    return picture


DrawnFile = Annotated[NewFile, Click(metavar="FILE.png|svg|pdf", callback=_drawable)]


def draw_to(output: Output, picture: Path, draw: Callable[[str], bytes]) -> None:
    """Write the picture that `draw` returns for the format in the file's name."""
    with output.new_file(picture) as path:
        path.write_bytes(draw(picture.suffix[1:].lower()))
    output.note(f"picture: {picture}")


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

    # If an option still lacks its value, the arguments are not parsed yet.
    with suppress(StoreError):
        for word in (*map(context.params.get, ("store", "named")), *context.args):
            if word is not None and is_store(Path(word)):
                return [known for known in open_store(word).ids if known.startswith(incomplete)]
    return []


_NAMED = "by its id, a beginning of it, or else the number of its row, from 0"
_ASKED = Click("--asset", metavar="ID", shell_complete=complete_asset)
AssetIds = Annotated[tuple[str, ...], f"An asset, {_NAMED}; may be repeated.", _ASKED]
AssetsOrAll = Annotated[
    tuple[str, ...], f"An asset, {_NAMED}; may be repeated. [default: all]", _ASKED
]
AssetOption = Annotated[str, f"The asset, {_NAMED}.", _ASKED]


def note_numbered(output: Output, store: Store, names: Iterable[str]) -> None:
    """Print which assets are chosen by number, because a number may be meant as an id prefix."""
    for name in names:
        if not (taken := store.ids[store.match(name)]).startswith(name):
            output.note(f"--asset {name}: no id begins so; row {name} is taken, {taken}")


NewStore = Annotated[
    PathOrUrl,
    "The store, a path or URL; an existing store is replaced in one step.",
    Click(metavar="STORE.zarr"),
]

UsableVerdicts = Annotated[
    tuple[str, ...] | None,
    ChoiceOf("slatprep.records:Verdict", "all"),
    "Only assets with this verdict; may be repeated. [default: good and doubtful]",
    Click("--verdict", multiple=True, callback=lambda _context, _parameter, it: it or None),
]
"""Verdicts to take; None if the option was not given."""


@dataclass(frozen=True, kw_only=True)
class ChosenOptions:
    """Verdicts and categories that choose assets of a store.

    Attributes
    ----------
    verdicts
        Take only assets with this verdict; may be repeated.
    categories
        Take only assets of this category; may be repeated.
    """

    verdicts: Annotated[
        tuple[str, ...], ChoiceOf("slatprep.records:Verdict"), Click("--verdict")
    ] = ()
    categories: Annotated[tuple[str, ...], Click("--category")] = ()


def note_left_out(
    output: Output,
    store: Store,
    rows: Iterable[int],
    kept: Collection[str] = (),
    why: str = "--verdict all takes them",
    others: str = "",
) -> list[str]:
    """Print how many assets have a verdict that is not in `kept`; return the line, if any.

    Assets of other verdicts count only if `others` says what they are.
    """
    verdicts = store.column("verdict")
    words = (others if (one := verdicts[row]) in kept else one for row in rows)
    left = tally(filter(None, words))
    lines = [f"left out: {left} ({why})"] if left else []
    for line in lines:
        output.note(line)
    return lines


def _at_most_the_cores(_context: click.Context, _parameter: click.Parameter, jobs: int) -> int:
    if jobs == 1:
        return jobs
    from joblib.externals.loky import cpu_count

    return min(jobs, int(cpu_count()))


Jobs = Annotated[
    Positive,
    "Worker processes, of one thread each; no more than there are cores.",
    Click(callback=_at_most_the_cores),
]


@dataclass(frozen=True, kw_only=True)
class WorkersOptions:
    """Processes of this machine, or a cluster, on which a command computes.

    Attributes
    ----------
    scheduler : ADDRESS
        Compute on the Dask cluster of this scheduler (such as tcp://host:8786), not on this
        machine.
    """

    jobs: Jobs = 1
    scheduler: str | None = None

    def __post_init__(self) -> None:
        given = click.get_current_context().get_parameter_source("jobs")
        if self.scheduler is not None and given is not click.core.ParameterSource.DEFAULT:
            raise click.UsageError(
                "--jobs is for this machine, and --scheduler uses all workers that the cluster "
                "has; give one of them"
            )

    @contextmanager
    def started(self, output: Output) -> Iterator[int | Workers]:
        """Yield the argument `jobs` of `slatprep.workers`."""
        if self.scheduler is None:
            yield self.jobs
            return
        from slatprep.workers.dask import Cluster

        with Cluster(self.scheduler, output.note) as cluster:
            yield cluster


@dataclass(frozen=True, kw_only=True)
class SplitOptions:
    """Rule by which objects are split into train, val and test.

    Attributes
    ----------
    split_by : hash|pixie|category:NAME|FILE
        Split objects by a hash of their ids, by Pixie's rule, with one category for testing, or by
        a file of ids. A file has a list for testing, or a JSON object with the lists train, val and
        test. [default: hash]
    shares : TRAIN,VAL,TEST
        Shares of the split by hash. With another rule, they divide the objects that are not for
        testing into train and val. [default: 0.8,0.1,0.1]
    """

    split_by: str | None = None
    shares: str | None = None

    @property
    def given(self) -> bool:
        """Whether the command line has an option of the split."""
        return self.split_by is not None or self.shares is not None

    @property
    def rule(self) -> dict[str, Any]:
        """Return ``by`` and ``shares`` for `slatprep.learn.splits.assign_store`."""
        from slatprep.readers.splits import HASH, Shares

        return {
            "by": HASH if self.split_by is None else self.split_by,
            "shares": Shares() if self.shares is None else _shares(self.shares),
        }


@dataclass(frozen=True, kw_only=True)
class StatedOptions:
    """Facts about a dataset that its store does not contain.

    Attributes
    ----------
    name
        Name of the dataset. [default: the store's]
    license : SPDX|URL
        Licence of the dataset, such as CC-BY-4.0.
    url
        Home page of the dataset.
    cite_as : TEXT
        Citation of the dataset.
    version : X.Y.Z
        Version of the dataset.
    date_published : YYYY-MM-DD
        Date of its publication.
    """

    name: str = ""
    license: str = ""
    url: str = ""
    cite_as: str = ""
    version: Annotated[str, Click("--dataset-version", show_default=True)] = "1.0.0"
    date_published: str = ""


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """Options that decide the parameters of a build.

    Attributes
    ----------
    config
        Dataset definition (TOML); options override it.
    pixieverse
        Root of the PixieVerse grids or predictions, a folder or a URL.
    slat
        Root of the TRELLIS latents, or one HDF5 file, or a URL.
    samples
        If an object has several annotations: refuse it, take the first, make an asset of each, or
        merge their labels in one asset. [default: one]
    encoder : NAME|FILE.json
        The encoder of the latents. [default: trellis]
    map
        CSV that joins the ids of the two sides, or TRELLIS's metadata.csv.
    ranges : dataset|pLO-pHI|pixie|FILE
        Source of the normalisation ranges; p1-p99: percentiles. [default: dataset]
    ranges_of
        Objects from which ranges of the dataset are computed. [default: all]
    preset
        Named parameters; 'paper' is the protocol of SLAT-Phys, in Pixie's ranges.
    """

    config: File | None = None
    pixieverse: PathOrUrl | None = None
    slat: PathOrUrl | None = None
    samples: Annotated[str | None, ChoiceOf("slatprep.parameters:Samples")] = None
    encoder: str | None = None
    map: PathOrUrl | None = None
    ranges: str | None = None
    ranges_of: Literal["all", "train"] | None = None
    splits: SplitOptions
    preset: Annotated[str | None, ChoiceOf("slatprep.parameters:PRESETS")] = None

    def parameters(self, **passes: bool) -> BuildParameters:
        """Return the parameters of a build; `passes` switch on ``consensus`` and ``witness``."""
        from slatprep.parameters.files import OPTIONS, load_parameters

        options = vars(self) | vars(self.splits)
        given: dict[str, dict[str, object]] = {}
        for name, flag in OPTIONS.items():
            if (value := options[flag.removeprefix("--").replace("-", "_")]) is None:
                continue
            group, key = name.split(".")
            if key == "shares":
                value = dataclasses.astuple(_shares(value))
            elif is_place(value):
                value = str(value.absolute())
            given.setdefault(group, {})[key] = value
        for name, chosen in passes.items():
            if chosen:
                given[name] = {"settle": True}
        return load_parameters(self.config, given, self.preset)


_FEW_OBJECTS = 100
"""Number of objects below which the shares of a split by hash are far from the given ones."""


def split_of_objects(
    output: Output, store: Store, rule: Mapping[str, Any], how: str
) -> dict[str, Split]:
    """Return the split of each object; print the sizes of splits, and ids without a split."""
    from slatprep.learn.splits import assign_store

    assignment = assign_store(store, **rule)
    counts = ", ".join(f"{len(ids):,} {split}" for split, ids in assignment.lists().items())
    output.note(f"split:   {how}: {counts}")
    if how.endswith("by hash") and len(assignment.splits) < _FEW_OBJECTS:
        output.note(
            "note:    a hash of an object's id decides its split, so the shares are rough in a "
            "small dataset; --split-by FILE takes lists of your own"
        )
    for ids, what in (
        (assignment.unknown, "without an object of the store that has a valid voxel"),
        (assignment.unlisted, "of the store in none of its lists, and left out"),
    ):
        if ids:
            named = first_of(name[:60] for name in ids)
            output.note(f"note:    {amount(len(ids), 'id')} {what}: {named}")
    if torn := _copies_apart(store, assignment.splits):
        output.note(
            f"note:    {amount(len(torn), 'SLAT')} with copies in other splits, under other ids "
            f"({' = '.join(torn[0])}); --split-by FILE can keep copies together"
        )
    return assignment.splits


def _copies_apart(store: Store, splits: Mapping[str, Split]) -> list[list[str]]:
    """Return an object of each split for each SLAT that lies in several."""
    from slatprep.pipeline.rows import slat_contents

    found: dict[bytes, dict[Split, str]] = {}
    for content, name in zip(
        slat_contents(store), map(str, store.column("object_id")), strict=True
    ):
        if content and name in splits:
            found.setdefault(content, {}).setdefault(splits[name], name)
    return [list(own.values()) for own in found.values() if len(own) > 1]


def _shares(text: str) -> Shares:
    from slatprep.readers.splits import Shares

    try:
        train, val, test = (float(part) for part in text.split(","))
    except ValueError as error:
        raise click.BadParameter(
            f"{text!r} is not three numbers such as 0.8,0.1,0.1", param_hint="--shares"
        ) from error
    return Shares(train, val, test)

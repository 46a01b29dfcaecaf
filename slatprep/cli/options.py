"""The options that say where the data are, shared by `build-store` and `align`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from slatprep.cli.output import Output
from slatprep.storage.remote import RemotePath, as_path

if TYPE_CHECKING:
    from slatprep.parameters import BuildParameters

_Command = TypeVar("_Command", bound=Callable[..., object])

_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)


class PlaceType(click.Path):
    """A path as click takes it, or the URL of an object store, of which nothing is asked here."""

    def convert(
        self, value: Any, parameter: click.Parameter | None, context: click.Context | None
    ) -> Any:
        """Return a `Path`."""
        place = as_path(value)
        if isinstance(place, RemotePath):
            return place
        return super().convert(str(place), parameter, context)


PLACE = PlaceType(path_type=Path)
STORE = PlaceType(path_type=Path, exists=True, file_okay=False)


def source_options(command: _Command) -> _Command:
    """Add the options that decide the parameters of a build."""
    options = (
        click.option(
            "--config",
            type=_FILE,
            help="Dataset definition (TOML); options win over it.",
        ),
        click.option(
            "--pixieverse",
            type=PLACE,
            metavar="DIR",
            help="Root of the PixieVerse grids or predictions, a folder or a URL.",
        ),
        click.option(
            "--slat",
            type=PLACE,
            metavar="DIR",
            help="Root of the TRELLIS latents, or one HDF5 file; a path or a URL.",
        ),
        click.option(
            "--map",
            "pairing_map",
            type=PLACE,
            metavar="CSV",
            help="CSV that joins the ids of the two sides, or TRELLIS's metadata.csv.",
        ),
        click.option(
            "--ranges",
            metavar="dataset|pixie|FILE",
            help="Where the normalisation ranges come from.  [default: dataset]",
        ),
        click.option(
            "--preset",
            type=click.Choice(["default", "paper"]),
            help="Named alignment parameters; 'paper' is the protocol of SLAT-Phys.",
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


store_argument = click.argument("store", required=False, type=STORE)

store_option = click.option(
    "--store",
    type=STORE,
    metavar="STORE.zarr",
    help="The store.  [default: the one built last under data/]",
)


def chosen_store(store: Path | None) -> Path:
    """Return the store that was named, else the one that `make align` built last."""
    if store is not None:
        return store
    built = sorted(Path("data").glob("*.zarr"), key=lambda path: path.stat().st_mtime)
    if not built:
        raise click.UsageError("there is no store under data/; name one, or run `make align`")
    return built[-1]


def beside(store: Path, suffix: str) -> Path:
    """Return NAME`suffix` beside NAME.zarr; in the working folder if that is on no local disk."""
    name = f"{store.name.removesuffix('.zarr')}{suffix}"
    return Path(name) if isinstance(store, RemotePath) else store.with_name(name)


jobs_option = click.option(
    "--jobs",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Assets computed at a time, each in a process of one thread.",
)


def workers_options(command: _Command) -> _Command:
    """Add ``--jobs`` and ``--scheduler``, of which the command gets what was chosen as `jobs`.

    It stands below `output_options`, whose `Output` it takes and hands on.
    """

    @jobs_option
    @click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Compute on the Dask cluster of this scheduler, as tcp://host:8786, instead of here.",
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


def parameters_of(
    *,
    config: Path | None,
    pixieverse: Path | None,
    slat: Path | None,
    pairing_map: Path | None,
    ranges: str | None,
    preset: str | None,
    consensus: bool = False,
    **_other: Any,
) -> BuildParameters:
    """Return the parameters that the options of `source_options` ask for."""
    from slatprep.config import load_parameters

    given: dict[str, dict[str, object]] = {}
    for group, key, value in (
        ("pixieverse", "root", pixieverse),
        ("slat", "root", slat),
        ("pairing", "map", pairing_map),
        ("normalize", "ranges", ranges),
    ):
        if value is not None:
            given[group] = {key: str(value.absolute()) if isinstance(value, Path) else value}
    if consensus:
        given["consensus"] = {"settle": True}
    return load_parameters(config, given, preset)

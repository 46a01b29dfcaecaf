"""`slatprep stats`: statistics of a store's voxels."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from slatprep.cli import options
from slatprep.cli.output import Cell, Output, write_csv
from slatprep.cli.signature import Click, command

if TYPE_CHECKING:
    from slatprep.inspect.distributions import Distribution, GroupStatistics, StoreStatistics

_CATEGORIES = 20
"""Most categories in a table; the files have all."""


@command()
def stats(
    output: Output,
    store: options.LastStore,
    *,
    chosen: options.ChosenOptions,
    weight: Annotated[Any, options.ChoiceOf("slatprep.inspect.distributions:Weight")] = "voxel",
    csv_file: Annotated[options.NewFile | None, Click("--csv")] = None,
    picture: options.DrawnFile | None = None,
    jobs: options.Jobs = 1,
) -> None:
    """Show statistics of the voxels of STORE: classes and properties, by category and in total.

    Both before the lookup (the annotated voxels of the PixieVerse fields) and after it
    (the valid SLAT voxels). Without STORE, the one that `make align` built last under
    data/ is taken.

    Parameters
    ----------
    weight
        Give each voxel the same weight, or each asset.
    csv_file
        Also write a table to this file: a line for each group, side, property and scale.
    picture
        Also draw them to this file.

    Example
    -------
    slatprep stats data/demo.zarr
    slatprep stats data/demo.zarr --verdict good --weight asset --picture demo.png --csv demo.csv
    """
    from slatprep.inspect.distributions import COLUMNS, table_of
    from slatprep.inspect.statistics import store_statistics

    opened = options.opened(store)
    with output.progress("stats") as progress:
        found = store_statistics(
            opened, *chosen.of(opened), weight=weight, jobs=jobs, progress=progress
        )
    if csv_file is not None:
        write_csv(csv_file, COLUMNS, table_of(found))
    if picture is not None:
        from slatprep.inspect.pictures.statistics import draw_statistics

        options.draw_to(output, picture, partial(draw_statistics, opened, found))
    output.result(found, lambda: _show(output, found))


def _show(output: Output, found: StoreStatistics) -> None:
    kept = sorted(found.categories, key=lambda group: -group.slat.assets)[:_CATEGORIES]
    groups = [group for group in found.groups if group.by != "category" or group in kept]
    chosen = f"{found.assets_chosen:,} of {found.assets:,} assets"
    output.record(f"{chosen}, weighted by {found.weight}", {**found.total.verdicts})
    output.table(
        "Voxels before and after the lookup, and the share that is not annotated",
        ("group", "assets", "before", "share", "none", "after", "share", "none"),
        [_voxels(group) for group in groups if group.slat.assets or group.field.assets],
    )
    output.table(
        "Properties of all annotated voxels",
        ("property", "lookup", "mean", "std", "5%", "50%", "95%"),
        [
            (f"{name}{_unit(own.unit)}", side, *_spread(own.si))
            for name in found.total.slat.properties
            for side, own in (
                ("before", found.total.field.properties[name]),
                ("after", found.total.slat.properties[name]),
            )
        ],
    )
    for name, whole in found.total.slat.properties.items():
        rows: list[tuple[Cell, ...]] = []
        for group in groups:
            before, after = (
                side.properties[name].log10 or side.properties[name].si
                for side in (group.field, group.slat)
            )
            if group.slat.voxels:
                rows.append((_name(group), *_spread(after), before.quantiles["50%"]))
        output.table(
            f"{'log10 of ' if whole.log10 else ''}{name}{_unit(whole.unit)}, after the lookup",
            ("group", "mean", "std", "5%", "50%", "95%", "50% before"),
            rows,
        )
    if len(kept) < len(found.categories):
        output.note(
            f"note:    {len(kept)} of {len(found.categories):,} categories, those with most "
            "assets; --json and --csv have all"
        )


def _voxels(group: GroupStatistics) -> tuple[Cell, ...]:
    before, after = group.field, group.slat
    cells = ((side.voxels, side.share, side.unannotated) for side in (before, after))
    return (_name(group), after.assets, *(cell for own in cells for cell in own))


def _name(group: GroupStatistics) -> str:
    """Return the label of a group: a category may have the name of a class."""
    return f"class {group.name}" if group.by == "class" else group.name


def _spread(own: Distribution) -> tuple[Cell, ...]:
    return (own.mean, own.std, *(own.quantiles[name] for name in ("5%", "50%", "95%")))


def _unit(unit: str) -> str:
    return "" if unit == "1" else f" [{unit}]"

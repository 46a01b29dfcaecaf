"""`slatprep info`, `list`, `stats` and `report`: show the contents of a store."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any

from slatprep.cli import options
from slatprep.cli.output import Cell, Output, say, write_csv
from slatprep.cli.signature import Click, command
from slatprep.errors import apart_from

if TYPE_CHECKING:
    from slatprep.inspect.overview import StoreOverview
    from slatprep.inspect.statistics import Distribution, GroupStatistics, StoreStatistics
    from slatprep.records import Place


@command()
def info(output: Output, store: options.LastStore) -> None:
    """Show what is in STORE, and how good its alignments are.

    Without STORE, the store that `make align` built last under data/ is used.

    Example
    -------
    slatprep info data/demo.zarr
    """
    from slatprep.inspect.overview import overview_of
    from slatprep.pipeline.measured import told_of
    from slatprep.pipeline.notices import stored_oddities

    opened = options.opened(store)
    overview, errors, unusual = overview_of(opened), told_of(opened), stored_oddities(opened)

    def show() -> None:
        contents: dict[str, Cell] = {
            "assets": overview.total.assets,
            "voxels": overview.total.voxels,
            "valid_share": overview.total.valid_share,
            "unphysical": overview.total.unphysical,
            "files": overview.files,
            "MB": overview.size / 1e6,
            "format": overview.format_version,
            "engine": ", ".join(overview.engines),
            "model": ", ".join(overview.models),
        }
        output.record(f"Store {store}", contents)
        show_quality(output, overview, store)
        show_sentences("wrong pairs", errors)
        show_sentences("unusual", unusual)
        output.table(
            f"Normalisation to [-1, 1] (ranges: {overview.normalization.source})",
            ("property", "scale", "lo", "hi"),
            [
                (entry.name, "log10" if entry.log10 else "linear", entry.lo, entry.hi)
                for entry in overview.normalization.ranges
            ],
        )

    told = {"store": store, "errors": errors, "unusual": unusual}
    output.result(vars(overview) | told, show)


def show_quality(
    output: Output, overview: StoreOverview, store: Place, *, advise: bool = True
) -> None:
    """Print how good a store's alignments are, and commands that show doubtful assets.

    `store` is the place as it was typed, because an object store deletes a version two builds
    later.
    """
    from slatprep.errors import UNKNOWN
    from slatprep.judge import THRESHOLDS

    figures = ("confidence", "expected_accuracy", "fitness", "valid_share")
    total = overview.total
    output.table(
        "Alignments (medians; valid_share of all voxels)",
        ("category", *total.verdicts, *figures),
        [
            (group.name, *group.verdicts.values(), *attrgetter(*figures)(group))
            for group in (*overview.categories, total)
        ],
    )
    unknown = sum(group.assets for group in overview.categories if group.name == UNKNOWN)
    if unknown and advise:
        say(f"unknown: the category of {unknown:,}; {_source_of_categories(overview)}")
    doubted = [name for name, count in total.verdicts.items() if count and name != "good"]
    if doubted:
        options = " ".join(f"--verdict {name}" for name in doubted)
        say(f"why:     slatprep list {store} {options}")
    if total.ambiguous:
        # An open tie makes an asset doubtful at best.
        settled = f"; {total.settled:,} good, settled by consensus or latents" * (total.settled > 0)
        say(
            f"ambiguous: {total.ambiguous:,} of {total.assets:,}: other placements fit about as "
            f"well, and change labels of more than {THRESHOLDS.good_ambiguity:.0%} of the "
            f"voxels{settled}"
        )
        say(f"look:    slatprep check-alignment --ambiguous --store {store}")


def show_sentences(what: str, sentences: Iterable[str]) -> None:
    """Print sentences on a store, each after what they are about."""
    for sentence in sentences:
        say(f"{what}: {sentence}")


def _source_of_categories(overview: StoreOverview) -> str:
    """Return a hint about which file gives a store's assets their categories."""
    from slatprep.errors import StoreError
    from slatprep.storage.place import place_of
    from slatprep.store.records import build_in, found_manifests

    table, form = '"obj_ids_metadata.json"', ""
    try:
        folder = found_manifests(place_of(overview.store), overview.build_id)
        parameters = None if folder is None else build_in(folder).parameters
    except StoreError:
        parameters = None
    if parameters and parameters.pairing.categories:
        return f"{parameters.pairing.categories} does not have their ids"
    if parameters and parameters.pixieverse.adapter != "pixieverse":
        table, form = '"FILE.json"', ': {"ID": {"obj_class": "CATEGORY"}}'
    return f"categories = {table} under [pairing] of a --config FILE gives it{form}"


@command("list")
def list_assets(
    output: Output,
    store: options.LastStore,
    *,
    chosen: options.ChosenOptions,
    max_confidence: Annotated[float | None, options.FiniteRange(0, 1)] = None,
    ids: bool = False,
) -> None:
    """List the assets of STORE, with the reasons of their verdicts.

    On a terminal, ids are shortened to unique prefixes, which all commands accept.
    Without STORE, the store that `make align` built last under data/ is used.

    Parameters
    ----------
    max_confidence
        List only assets with at most this confidence.
    ids
        Print only the full ids, one on each line.

    Example
    -------
    slatprep list data/demo.zarr --verdict doubtful --verdict failed
    slatprep list data/demo.zarr --category tree --ids
    """
    from slatprep.inspect.overview import list_assets as listed_of
    from slatprep.pipeline.measured import errors_of, told_of
    from slatprep.pipeline.notices import stored_oddities

    opened = options.opened(store)
    listed = list(listed_of(opened, **vars(chosen), max_confidence=max_confidence))
    unusual = [] if ids else stored_oddities(opened)

    def show() -> None:
        if ids:
            for asset in listed:
                say(asset.asset_id)
            return
        length = output.id_length(opened.ids)
        columns = ("category", "verdict", "confidence", "fitness")
        why = _in_short if length else "; ".join
        rows = ((a.asset_id[:length], *attrgetter(*columns)(a), why(a.reasons)) for a in listed)
        title = f"{len(listed):,} of {len(opened):,} assets"
        output.table(title, ("id", *columns, "why"), rows)
        if listed and errors_of(opened):
            show_sentences("wrong pairs", told_of(opened))
        show_sentences("unusual", unusual)

    output.result({"store": store, "assets": listed, "unusual": unusual}, show)


def _in_short(reasons: tuple[str, ...]) -> str:
    more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    return f"{reasons[0]}{more}" if reasons else ""


@command()
def report(
    output: Output,
    store: options.LastStore,
    *,
    out: options.NewFile | None = None,
    manifests: options.Folder | None = None,
    jobs: options.Jobs = 1,
) -> None:
    """Write a page about STORE that opens in a browser.

    The page is a single HTML file and needs no network. It has the assets by
    state with reasons, histograms, orientations, classes and properties, and a
    table that shows each asset in 3D. Without STORE, the store that
    `make align` built last under data/ is used.

    Parameters
    ----------
    out : FILE.html
        File of the page. [default: beside the store]
    manifests
        Folder of the build's records. [default: beside the store, or manifests/build/NAME]

    Example
    -------
    slatprep report data/demo.zarr
    slatprep report data/demo.zarr --out demo.html --manifests manifests/build/demo
    """
    from slatprep.inspect.report import write_report
    from slatprep.store.records import found_manifests

    opened = options.opened(store)
    records = manifests or found_manifests(opened.path, opened.about.manifest)
    if records is None:
        output.problem(
            f"no records of {store} found; the page cannot list assets that are not in the store. "
            "Name their folder with --manifests"
        )
    with output.progress("report") as progress:
        summary = write_report(
            opened,
            out or options.beside(store, ".html"),
            manifests=records,
            jobs=jobs,
            progress=progress,
        )

    def show() -> None:
        say(f"page:   {summary.path} ({summary.size / 1e6:,.1f} MB)")
        listed = f"{summary.listed:,} in the table, " if summary.listed < summary.assets else ""
        say(f"assets: {summary.assets:,}, {listed}{summary.in_detail:,} of them with a 3D view")

    output.made(summary, show)


_CATEGORIES = 20
"""Largest number of categories in a printed table; the files have all."""


@command()
def stats(
    output: Output,
    store: options.LastStore,
    *,
    chosen: options.ChosenOptions,
    weight: Annotated[Any, options.ChoiceOf("slatprep.inspect.statistics:Weight")] = "voxel",
    csv_file: Annotated[options.NewFile | None, Click("--csv")] = None,
    picture: options.DrawnFile | None = None,
    jobs: options.Jobs = 1,
) -> None:
    """Show statistics of the voxels of STORE: classes and properties, by category and in total.

    Statistics are given before the lookup (for annotated voxels of the PixieVerse fields)
    and after it (for valid SLAT voxels). Without STORE, the store that `make align` built
    last under data/ is used.

    Parameters
    ----------
    weight
        Give each voxel the same weight, or each asset.
    csv_file
        Also write a table to this file: a line for each group, side, property and scale.
    picture
        Also draw the statistics to this file.

    Example
    -------
    slatprep stats data/demo.zarr
    slatprep stats data/demo.zarr --verdict good --weight asset --picture demo.png --csv demo.csv
    """
    from slatprep.inspect.statistics import COLUMNS, store_statistics, table_of

    opened = options.opened(store)
    with output.progress("stats") as progress:
        found = store_statistics(
            opened, **vars(chosen), weight=weight, jobs=jobs, progress=progress
        )
    if csv_file is not None:
        write_csv(output, csv_file, COLUMNS, table_of(found))
    if picture is not None:
        from slatprep.inspect.pictures.statistics import draw_statistics

        options.draw_to(output, picture, partial(draw_statistics, opened, found))
    output.result(vars(found) | {"store": store}, lambda: _show_statistics(output, found))


def _show_statistics(output: Output, found: StoreStatistics) -> None:
    kept = sorted(found.categories, key=lambda group: -group.slat.assets)[:_CATEGORIES]
    groups = {"all": found.total} | {f"class {group.name}": group for group in found.classes}
    groups |= {apart_from(one.name, groups): one for one in found.categories if one in kept}
    chosen = f"{found.assets_chosen:,} of {found.assets:,} assets"
    output.record(f"{chosen}, weighted by {found.weight}", {**found.total.verdicts})
    output.table(
        "Voxels before and after the lookup",
        ("group", "assets", "before", "share", "unannotated", "after", "share", "not valid"),
        [
            (name, *_voxels(own))
            for name, own in groups.items()
            if own.slat.assets or own.field.assets
        ],
    )
    output.table(
        "Properties of the annotated voxels before the lookup, the valid after",
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
        for label, group in groups.items():
            before, after = (
                side.properties[name].log10 or side.properties[name].si
                for side in (group.field, group.slat)
            )
            if group.slat.voxels:
                rows.append((label, *_spread(after), before.quantiles["50%"]))
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
    return (after.assets, *(cell for own in cells for cell in own))


def _spread(own: Distribution) -> tuple[Cell, ...]:
    return (own.mean, own.std, *(own.quantiles[name] for name in ("5%", "50%", "95%")))


def _unit(unit: str) -> str:
    return "" if unit == "1" else f" [{unit}]"

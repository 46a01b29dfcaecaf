"""`slatprep verify` and `diff`: check whether a store is whole, and compare two stores."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import click

from slatprep.cli import options
from slatprep.cli.output import Cell, Output, say
from slatprep.cli.signature import command
from slatprep.errors import amount

if TYPE_CHECKING:
    from slatprep.inspect.compare import AssetChange, StoreDifference


@command()
def verify(
    output: Output,
    store: options.LastStore,
    *,
    manifests: options.FolderOrUrl | None = None,
    sources: bool = False,
    pixieverse: options.FolderOrUrl | None = None,
    slat: options.FolderOrUrl | None = None,
    also: tuple[options.FolderOrUrl, ...] = (),
    sample: options.Positive | None = None,
    workers: options.WorkersOptions,
) -> None:
    """Check that STORE is whole, unchanged and consistent.

    Compares metadata with the contract, files with their digests, and chunks with
    their checksums. Compares values with their ranges, annotations with the
    stored grid and transform, and records with their schema and the rows. Every
    fault is printed; with any fault, the exit code is 1.

    Parameters
    ----------
    manifests
        Folder of the records. [default: beside the store, or manifests/build/NAME]
    sources
        Also compare the source files with the records.
    pixieverse
        Present root of the PixieVerse files. [default: as at the build]
    slat
        Present folder of the latents, or of their one HDF5 file. [default: as at the build]
    also
        With --pixieverse and --slat: present root of a further source; once for each, in the order
        of [[also]].
    sample : N
        Compare values, records and sources of only N assets, evenly chosen. Files and the columns
        of all assets are still compared whole.

    Example
    -------
    slatprep verify data/demo.zarr --jobs 2
    slatprep verify data/demo.zarr --sources --json
    """
    if (pixieverse is None) != (slat is None) or (also and slat is None):
        raise click.UsageError("--pixieverse and --slat go together: name both, or neither")
    from slatprep.inspect.verify import SourceRoots, verify_store

    roots = []
    if pixieverse and slat:
        roots = [SourceRoots(one, slat, number=k) for k, one in enumerate((pixieverse, *also))]
    with workers.started(output) as jobs, output.progress("verify") as progress:
        result = verify_store(
            store,
            sources=sources or bool(roots),
            roots=roots,
            sample=sample,
            manifests=manifests,
            jobs=jobs,
            progress=progress,
        )

    def show() -> None:
        for finding in result.findings:
            say(finding)
        read = amount(result.sources, "source") if result.sources else "sources not asked for"
        records = result.manifests or "none beside the store"
        output.note(
            f"{amount(result.assets, 'asset')}, {amount(result.files, 'file')}, {read}; "
            f"records: {records}"
        )
        found = amount(len(result.findings), "finding") if result.findings else "nothing is wrong"
        say(f"{store}: {found}")

    # Print the place as it was typed.
    output.result(replace(result, store=store), show, complete=result.ok)


_SHOWN = 20
_NAMED = 3
"""Largest number of columns named in a line; --json names all."""

_VALUE = 20
"""Number of characters of a setting: enough for a number or the start of a digest."""


@command()
def diff(
    output: Output,
    a: options.FolderOrUrl,
    b: options.FolderOrUrl,
    *,
    worst: options.Positive | None = None,
    jobs: options.Jobs = 1,
) -> None:
    """Show what changed from store A to store B, in total and by asset.

    Lists assets in only one of the stores; changed sources, verdicts, placements, labels,
    properties in SI units and latents of assets in both; and different ranges, parameters
    and versions. The exit code is 1 if the stores differ.

    Parameters
    ----------
    worst : N
        Number of changed assets to list, with most changed labels first. [default: 20; with --json
        all]

    Example
    -------
    slatprep diff old.zarr new.zarr
    slatprep diff old.zarr new.zarr --json --worst 100
    """
    from slatprep.inspect.compare import compare_stores

    if worst is None and not output.as_json:
        worst = _SHOWN
    with output.progress("diff") as progress:
        found = compare_stores(a, b, worst=worst, jobs=jobs, progress=progress)
    found = replace(found, a=a, b=b)  # Print the places as they were typed.
    output.result(found, lambda: _show_difference(output, found), complete=found.same)


def _show_difference(output: Output, found: StoreDifference) -> None:
    if found.same:
        say(f"{found.a} and {found.b} hold the same; grids are not compared")
        return
    output.record(
        f"A: {found.a}\nB: {found.b}",
        {
            "assets in both": found.assets,
            "changed": found.changed,
            "only in A": len(found.only_a),
            "only in B": len(found.only_b),
        },
    )
    for store, ids in (("A", found.only_a), ("B", found.only_b)):
        for asset_id in ids[:_SHOWN]:
            say(f"only in {store}: {asset_id}")
        if len(ids) > _SHOWN:
            say(f"only in {store}: {len(ids) - _SHOWN:,} more (--json has all)")
    if found.settings:
        output.table(
            "Settings",
            ("setting", "A", "B"),
            [(one.name, _value(one.a), _value(one.b)) for one in found.settings],
        )
    if found.what:
        output.table(
            "Assets that changed, by what",
            ("what", "assets", "how"),
            [(what, count, _how(found, what)) for what, count in found.what.items()],
        )
    changed = {name: own for name, own in found.properties.items() if own.changed}
    if changed:
        output.table(
            "Properties of voxels that are valid in both: absolute change",
            ("property", "voxels", "changed", "mean", "most", "mean of log10"),
            [(name, *vars(own).values()) for name, own in changed.items()],
        )
    if found.worst:
        length = output.id_length([one.asset_id for one in found.worst])
        output.table(
            f"{len(found.worst):,} of {found.changed:,} assets that changed",
            ("id", "verdict", "moved", "labels", "why"),
            [_line(one, length) for one in found.worst],
        )


def _how(found: StoreDifference, what: str) -> str:
    """Return the extent of a kind of change over all assets, or an empty text."""
    if what == "verdict":
        return ", ".join(f"{count:,} {words}" for words, count in found.verdicts.items())
    if what == "placement":
        return f"by {found.moved:.3g} voxels (median), at most {found.moved_most:.3g}"
    if what == "labels":
        return f"{found.labels:,} of {found.voxels:,} voxels ({found.labels / found.voxels:.2%})"
    return ""


def _line(one: AssetChange, length: int | None) -> tuple[Cell, ...]:
    verdict = one.verdicts[1] if "verdict" not in one.what else " > ".join(one.verdicts)
    more = {"sources": ", ".join(one.sources), "columns": ", ".join(one.columns)}
    if len(one.columns) > _NAMED:
        more["columns"] = f"{len(one.columns)}"
    why = (f"{what} ({more[what]})" if more.get(what) else what for what in one.what)
    labels = one.labels / one.voxels if one.voxels else None
    return (one.asset_id[:length], verdict, one.moved, labels, ", ".join(why))


def _value(value: object) -> str:
    """Return a setting cut to `_VALUE` characters; ``--json`` has all of it."""
    text = "-" if value is None else str(value)
    return text if len(text) <= _VALUE else f"{text[: _VALUE - 3]}..."

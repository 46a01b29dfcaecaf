"""`slatprep report`: write a page about a store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from slatprep.cli.options import Folder, Jobs, LastStore, NewFile, beside
from slatprep.cli.output import Output, say
from slatprep.cli.signature import command

if TYPE_CHECKING:
    from slatprep.records import Place


@command()
def report(
    output: Output,
    store: LastStore,
    *,
    out: NewFile | None = None,
    manifests: Folder | None = None,
    jobs: Jobs = 1,
) -> None:
    """Write a page about STORE that opens in a browser.

    The page is a single HTML file and needs no network. It has the assets by
    state with reasons, histograms, orientations, classes and properties, and a
    table that shows each asset in 3D. Without STORE, it takes the one that
    `make align` built last under data/.

    Parameters
    ----------
    out : FILE.html
        The page. [default: beside the store]
    manifests
        Folder of the build's records. [default: beside the store, or manifests/build/NAME]

    Example
    -------
    slatprep report data/demo.zarr
    slatprep report data/demo.zarr --out demo.html --manifests manifests/build/demo
    """
    from slatprep.inspect.report import write_report
    from slatprep.store import open_store
    from slatprep.store.records import manifests_beside

    opened = open_store(store)
    name = store.name.removesuffix(".zarr")
    records: Place | None = manifests
    if records is None:
        of_make = Path("manifests/build") / name
        records = manifests_beside(opened.path) or (of_make if of_make.is_dir() else None)
    if records is None:
        output.problem(
            f"no records of {store} found; the page cannot list assets that are not in the store. "
            "Name their folder with --manifests"
        )
    with output.progress("report") as progress:
        summary = write_report(
            opened, out or beside(store, ".html"), manifests=records, jobs=jobs, progress=progress
        )

    def show() -> None:
        say(f"page:   {summary.path} ({summary.size / 1e6:,.1f} MB)")
        listed = f"{summary.listed:,} in the table, " if summary.listed < summary.assets else ""
        say(f"assets: {summary.assets:,}, {listed}{summary.in_detail:,} of them with a 3D view")

    output.made(summary, show)

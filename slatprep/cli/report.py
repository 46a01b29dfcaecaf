"""`slatprep report`: write a page about a store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from slatprep.cli.options import (
    FOLDER,
    NEW_FILE,
    beside,
    command,
    jobs_option,
    option,
    store_argument,
)
from slatprep.cli.output import Output, say

if TYPE_CHECKING:
    from slatprep.records import Place


@command()
@store_argument
@option("--out", NEW_FILE, metavar="FILE.html")
@option("--manifests", FOLDER)
@jobs_option
def report(
    output: Output, store: Place, out: Path | None, manifests: Place | None, jobs: int
) -> None:
    """Write a page about STORE that opens in a browser.

    A single HTML file, which needs no network: the number of assets by state
    with reasons, histograms of quality, orientations, classes and properties,
    and a table of all assets that shows each in 3D. Without STORE, the one
    that `make align` built last under data/ is taken.

    Options
    -------
    --out: The page. [default: beside the store]
    --manifests: Folder of the build's records. [default: beside the store, or
        manifests/build/NAME]

    Example
    -------
    slatprep report data/demo.zarr
    slatprep report data/demo.zarr --out demo.html --manifests manifests/build/demo
    """
    from slatprep.inspect.report import write_report
    from slatprep.provenance.places import manifests_of
    from slatprep.store import open_store

    opened = open_store(store)
    name = store.name.removesuffix(".zarr")
    if manifests is None:
        usual = (manifests_of(opened.path), Path("manifests/build") / name)
        manifests = next((folder for folder in usual if folder.is_dir()), None)
    if manifests is None:
        output.problem(
            f"no records of {store} found; the page cannot list assets that are not in the store. "
            "Name their folder with --manifests"
        )
    with output.progress("report") as progress:
        summary = write_report(
            opened, out or beside(store, ".html"), manifests=manifests, jobs=jobs, progress=progress
        )

    def show() -> None:
        say(f"page:   {summary.path} ({summary.size / 1e6:,.1f} MB)")
        listed = f"{summary.listed:,} in the table, " if summary.listed < summary.assets else ""
        say(f"assets: {summary.assets:,}, {listed}{summary.in_detail:,} of them with a 3D view")

    output.made(summary, show)

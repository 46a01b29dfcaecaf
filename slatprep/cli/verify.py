"""`slatprep verify`: verify a store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from slatprep.cli.options import FolderOrUrl, LastStore, Positive, WorkersOptions
from slatprep.cli.output import Output, say
from slatprep.cli.signature import command
from slatprep.errors import StoreError, amount

if TYPE_CHECKING:
    from slatprep.records import Place


@command()
def verify(
    output: Output,
    store: LastStore,
    *,
    manifests: FolderOrUrl | None = None,
    sources: bool = False,
    pixieverse: FolderOrUrl | None = None,
    slat: FolderOrUrl | None = None,
    also: tuple[FolderOrUrl, ...] = (),
    sample: Positive | None = None,
    workers: WorkersOptions,
) -> None:
    """Check that STORE is whole, unchanged and consistent.

    Compares metadata with the contract, files with their digests, and chunks with
    their checksums. Compares values with their ranges, annotations with the
    stored grid and transform, and records with their schema and the rows. Every
    fault is named, and the exit code is then 1.

    Parameters
    ----------
    manifests
        Folder of the records. [default: beside the store, or manifests/build/NAME]
    sources
        Compare the source files with the records, too.
    pixieverse
        Root of the PixieVerse files now. [default: as at the build]
    slat
        Folder of the latents, or of their one HDF5 file, now. [default: as at the build]
    also
        With both: root of a further source now; once for each, in the order of [[also]].
    sample : N
        Compare values, records and sources of N assets, evenly chosen, not of all. Files and the
        columns of all assets are compared whole nevertheless.

    Example
    -------
    slatprep verify data/demo.zarr --jobs 2
    slatprep verify data/demo.zarr --sources --json
    """
    if (pixieverse is None) != (slat is None) or (also and slat is None):
        raise click.UsageError("--pixieverse and --slat go together: name both, or neither")
    from slatprep.inspect.verify import SourceRoots, verify_store
    from slatprep.store.records import manifests_beside

    roots = None
    if pixieverse and slat:
        further = tuple(SourceRoots(one, slat, number=k) for k, one in enumerate(also, 1))
        roots = SourceRoots(pixieverse, slat, also=further)
    if manifests is None and manifests_beside(store) is None:
        manifests = _left_by_make(store)
    with workers.started(output) as jobs, output.progress("verify") as progress:
        result = verify_store(
            store,
            sources=sources or roots is not None,
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

    output.result(result, show, complete=result.ok)


def _left_by_make(store: Place) -> Place | None:
    """Return the folder where `make align` leaves a store's records, if they are of this build."""
    from slatprep.store import open_store
    from slatprep.store.records import build_in

    folder = Path("manifests/build") / store.name.removesuffix(".zarr")
    try:
        own = build_in(folder).id == open_store(store).about.manifest
    except (OSError, StoreError):
        return None
    return folder if own else None

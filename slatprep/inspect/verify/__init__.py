"""Verify a store against its contract, its digests, its records and, on request, its sources.

`verify_store` checks metadata against the contract, files against their digests, then every
asset's values and record, and finally the source files that the records name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from slatprep.errors import StoreError
from slatprep.inspect.verify.assets import asset_findings
from slatprep.inspect.verify.index import index_findings
from slatprep.inspect.verify.manifests import manifest_findings, moved, source_roots
from slatprep.pipeline.previous import SourceStore
from slatprep.records import Place, SourceRoots
from slatprep.storage.place import place_of, storage_of
from slatprep.store.assets import AttributesError
from slatprep.store.contract import Finding, read_metadata
from slatprep.store.integrity import file_findings, metadata_findings
from slatprep.store.reader import Store, open_store
from slatprep.store.records import manifests_beside
from slatprep.workers import Progress
from slatprep.workers.local import Jobs, require_shared, run_unordered

__all__ = ["Finding", "SourceRoots", "Verification", "verify_store"]


@dataclass(frozen=True)
class Verification:
    """The result of a verification.

    Attributes
    ----------
    store : Place
        The store.
    assets : int
        Number of assets whose values were checked.
    files : int
        Number of the store's files; all were compared with their digests.
    sources : int
        Number of source files whose digest was compared.
    manifests : Place or None
        Folder of the records that were compared; None if there are none.
    findings : tuple of Finding
        All faults, sorted by file.
    """

    store: Place
    assets: int
    files: int
    sources: int
    manifests: Place | None
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether there are no findings."""
        return not self.findings


def verify_store(
    path: str | Place,
    *,
    manifests: Place | None = None,
    sources: bool = False,
    roots: SourceRoots | None = None,
    sample: int | None = None,
    jobs: Jobs = 1,
    progress: Progress | None = None,
) -> Verification:
    """Verify a store.

    Parameters
    ----------
    path : Place
        The store; on an object store, its current version.
    manifests : Place, optional
        Folder of the build's records; by default the one beside the store, if it exists.
    sources : bool
        Whether to compare the source files with the records.
    roots : SourceRoots, optional
        Where the sources are now; by default the roots in ``build.json``.
    sample : int, optional
        Compare values, records and sources of only this many assets, evenly chosen.
        Metadata, files and the ``asset/*`` arrays are always compared whole.
    jobs : int or Workers
        Worker processes, or a `slatprep.workers.dask.Cluster`.
    progress : callable, optional
        Called with the number of assets done and the number of those to be compared.

    Returns
    -------
    Verification
        All findings; they do not depend on `jobs`.

    Raises
    ------
    StoreError
        If the store does not exist, or `sources` is set and their roots are not known.
    """
    path = storage_of(place_of(path)).current_version()
    try:
        store = open_store(path.absolute())  # Workers may run in another folder.
    except AttributesError:
        # Without attributes values have no meaning; only metadata and files can be checked.
        document = read_metadata(path / "zarr.json")
        files, found = file_findings(Store(path, document), jobs)
        findings = {*metadata_findings(path), *found}
        return Verification(path, 0, files, 0, None, tuple(sorted(findings)))
    except StoreError as error:
        if not _is_file(path / "zarr.json"):
            raise
        finding = Finding("zarr.json", "", str(error), "the metadata of a slatprep store")
        return Verification(path, 0, 0, 0, None, (finding,))
    folder = manifests or manifests_beside(path)
    if sources:
        roots = source_roots(folder) if roots is None else moved(roots, folder)
    needed = [roots.slat, *(one.pixieverse for one in (roots, *roots.also))] if roots else []
    require_shared(jobs, [store.path / "zarr.json", *needed])
    findings = set(metadata_findings(path))
    files, found = file_findings(store, jobs)
    findings |= found
    try:
        findings |= set(index_findings(store))
        rows = _chosen(len(store), sample)
    except StoreError as error:
        findings.add(Finding("asset", "", str(error), "readable ids and offsets"))
        rows = []
    hashed, total = 0, len(rows)
    source, compared = SourceStore(store.path), roots if sources else None
    tasks = ((source, row, compared) for row in rows)
    for done, (own, count) in enumerate(run_unordered(asset_findings, tasks, jobs), 1):
        findings |= set(own)
        hashed += count
        if progress:
            progress(done, total)
    if folder is not None:
        try:
            findings |= set(manifest_findings(store, folder, None if sample is None else rows))
        except StoreError as error:
            findings.add(Finding(str(folder), "", str(error), "records of a readable store"))
    return Verification(path, total, files, hashed, folder, tuple(sorted(findings)))


def _chosen(total: int, sample: int | None) -> Sequence[int]:
    """Return the rows of the assets to compare: all, or a sample at even steps."""
    if sample is None or sample >= total:
        return range(total)
    return [(2 * number + 1) * total // (2 * sample) for number in range(sample)]


def _is_file(path: Place) -> bool:
    try:
        return path.is_file()
    except OSError:  # An object store that does not answer.
        return False

"""Verify a store against its contract, its digests, its records and, on request, its sources.

`verify_store` checks metadata against the contract, files against their digests, then every
asset's values and record, and finally the source files that the records name.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from slatprep.errors import StoreError
from slatprep.geometry.frames import split_transform
from slatprep.inspect.verify.assets import asset_findings
from slatprep.inspect.verify.manifests import manifest_findings, moved, source_roots
from slatprep.pipeline.rows import SourceStore
from slatprep.readers.patterns import ASSET_ID, NAME
from slatprep.records import RESOLUTION, Engine, Model, Place, Search, SourceRoots, Verdict
from slatprep.storage.place import place_of, storage_of
from slatprep.store.assets import AttributesError, other_store
from slatprep.store.attributes import segments_of
from slatprep.store.contract import MAX_VOXELS, Finding, read_metadata
from slatprep.store.integrity import file_findings, metadata_findings
from slatprep.store.reader import Store, open_store
from slatprep.store.records import found_manifests
from slatprep.store.shard_reader import UnreachableError
from slatprep.workers import Progress, counted
from slatprep.workers.local import Jobs, require_shared, run_unordered

__all__ = ["Finding", "SourceRoots", "Verification", "verify_store"]

WORDS = {
    words.__name__.lower(): tuple(map(str, words)) for words in (Engine, Model, Search, Verdict)
}
"""Allowed words by column."""

_LETTERS = "letters, digits, '.', '_' and '-'"
_TEXTS = {
    "id": (ASSET_ID, _LETTERS),
    "object_id": (NAME, _LETTERS),
    "view": (re.compile(f"({NAME.pattern})?"), _LETTERS),  # Empty for an object with one SLAT.
    **{name: (re.compile("|".join(words)), f"one of {words}") for name, words in WORDS.items()},
}
"""Pattern of the allowed texts of a column, and its description."""

_SHARES = ("fitness", "fitness_backward", "overlap", "ambiguity", "valid_share", "confidence",
           "expected_accuracy")  # fmt: skip

_NUMBERS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(_SHARES, (0.0, 1.0)),
    "inlier_rmse": (0.0, np.inf),
    "inlier_rmse_backward": (0.0, np.inf),
    "margin": (-1.0, np.inf),  # Below 0 if another placement beats a stated frame.
    "unphysical": (0.0, RESOLUTION**3),
}
"""Least and largest allowed number of a column; without a largest, NaN is allowed too."""

_TOLERANCE = 1e-6
"""Largest allowed difference of a rotation's determinant from 1, due to rounding."""


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
        Number of the store's files, all of them compared with their digests.
    sources : int
        Number of source files whose digests were compared.
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
    roots: Sequence[SourceRoots] = (),
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
    roots : sequence of SourceRoots, optional
        Where each source is now, in their order; by default the roots in ``build.json``.
    sample : int, optional
        Compare values, records and sources of only this many assets, evenly chosen.
        Metadata, files and the ``asset/*`` arrays are always compared whole.
    jobs : int or Workers
        Worker processes, or a `slatprep.workers.dask.Cluster`.
    progress : callable, optional
        Called with the number of assets done and the number of assets to compare.

    Returns
    -------
    Verification
        All findings; they do not depend on `jobs`.

    Raises
    ------
    StoreError
        If the store does not exist, another one took its place meanwhile, or `sources` is set and
        their roots are unknown.
    """
    path = storage_of(place_of(path)).current_version()
    try:
        store = open_store(path.absolute())  # Workers may run in another folder.
    except AttributesError:
        # Values have no meaning without attributes: only metadata and files can be checked.
        document = read_metadata(path / "zarr.json")
        files, found = file_findings(Store(path, document), jobs)
        findings = {*metadata_findings(path), *found}
        return Verification(path, 0, files, 0, None, tuple(sorted(findings)))
    except UnreachableError:
        raise
    except StoreError as error:
        if not _is_file(path / "zarr.json"):
            raise
        finding = Finding("zarr.json", "", str(error), "the metadata of a slatprep store")
        return Verification(path, 0, 0, 0, None, (finding,))
    folder = manifests or found_manifests(path, store.about.manifest)
    if sources:
        roots = moved(roots, folder) if roots else source_roots(folder)
    needed = [place for one in roots for place in (one.slat, one.pixieverse)]
    require_shared(jobs, [store.path / "zarr.json", *needed])
    findings = set(metadata_findings(path))
    files, found = file_findings(store, jobs)
    findings |= found
    try:
        findings |= set(index_findings(store))
        rows = _chosen(len(store), sample)
    except UnreachableError:
        raise
    except StoreError as error:
        findings.add(Finding("asset", "", str(error), "readable ids and offsets"))
        rows = []
    hashed, total = 0, len(rows)
    source, compared = SourceStore(store), roots if sources else ()
    tasks = ((source, row, compared) for row in rows)
    for own, count in counted(run_unordered(asset_findings, tasks, jobs), total, progress):
        findings |= set(own)
        hashed += count
    if folder is not None:
        try:
            findings |= set(manifest_findings(store, folder, None if sample is None else rows))
        except StoreError as error:
            findings.add(Finding(str(folder), "", str(error), "records of a readable store"))
    if findings and _was_replaced(store):
        raise other_store(path)
    return Verification(path, total, files, hashed, folder, tuple(sorted(findings)))


def _was_replaced(store: Store) -> bool:
    """Return whether another store lies in its place by now, to which its digests do not apply."""
    try:
        return read_metadata(store.path / "zarr.json").get("attributes") != store.attributes
    except StoreError:
        return False


def _chosen(total: int, sample: int | None) -> Sequence[int]:
    """Return the rows of the assets to compare: all, or a sample at even steps."""
    if sample is None or sample >= total:
        return range(total)
    return [(2 * number + 1) * total // (2 * sample) for number in range(sample)]


def _is_file(path: Place) -> bool:
    try:
        return path.is_file()
    except OSError:  # The object store does not answer.
        return False


def index_findings(store: Store) -> Iterator[Finding]:
    """Yield findings on the ``asset/*`` arrays."""
    ids = store.ids
    begins = store.attributes.get("segments")
    if json.dumps(begins) != json.dumps(segments_of(ids)):  # In Python, True == 1 and 4.0 == 4.
        what = f"attribute segments is {begins!r}"
        yield Finding("zarr.json", "", what, "the rows at which ids begin to ascend")
    known = set(ids[:1])
    for row, (before, after) in enumerate(pairwise(ids), 1):
        stated = not isinstance(begins, list) or row in begins
        if after in known or (before > after and not stated):
            what = "occurs twice" if after in known else f"comes after {before!r}"
            yield Finding("asset/id", after, what, "ids ascending in each segment, each once")
        known.add(after)
    yield from _offset_findings(store)
    for name, (allowed, expected) in _TEXTS.items():
        for asset_id, text in zip(ids, store.column(name), strict=True):
            if not allowed.fullmatch(text):
                yield Finding(f"asset/{name}", asset_id, f"is {text!r}", expected)
    for name, (least, most) in _NUMBERS.items():
        values = store.column(name)
        fine = (values >= least) & (values <= most)
        if most == np.inf:
            fine |= np.isnan(values)
        for wrong in np.flatnonzero(~fine):
            yield Finding(
                f"asset/{name}", ids[wrong], f"is {values[wrong]}", f"{least:g} to {most:g}"
            )
    yield from _transform_findings(store)


def _offset_findings(store: Store) -> Iterator[Finding]:
    where, offsets = "asset/offset", store.offsets
    voxels = store.shape("voxel/coords")[0]
    if offsets[0] != 0 or offsets[-1] != voxels:
        ends = f"runs from {offsets[0]} to {offsets[-1]}"
        yield Finding(where, "", ends, f"0 to {voxels}, the rows of voxel/*")
    sizes = np.diff(offsets)
    for row in np.flatnonzero((sizes < 1) | (sizes > MAX_VOXELS)):
        yield Finding(where, store.ids[row], f"{sizes[row]} rows", f"1 to {MAX_VOXELS} rows")


def _transform_findings(store: Store) -> Iterator[Finding]:
    for asset_id, model, transform in zip(
        store.ids, store.column("model"), store.column("transform"), strict=True
    ):
        kind = "rigid" if model == "rigid" else "similarity"
        try:
            _, _, scale = split_transform(transform)
            fine = (transform[3] == (0, 0, 0, 1)).all()
            fine &= kind != "rigid" or abs(scale**3 - 1) <= _TOLERANCE
        except ValueError:
            fine = False
        if not fine:
            yield Finding(
                "asset/transform",
                asset_id,
                f"{transform.tolist()} is no {kind} transform",
                "a rotation (scaled by one factor unless rigid) and a shift, finite",
            )

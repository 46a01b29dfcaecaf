"""Publish a build: put its store in place, its manifests beside it, and say what it did.

If a build is killed before it writes the manifests, the next build writes them.
"""

from __future__ import annotations

import platform
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.destination import Destination, is_marked
from slatprep.pipeline.notices import moved_ranges
from slatprep.pipeline.plan import why_taken_out
from slatprep.records import Normalization, Place, Status
from slatprep.storage.faults import reached
from slatprep.storage.place import storage_of
from slatprep.store.reader import Store
from slatprep.store.record import BuildCounts, BuildRecord, FailedRecord
from slatprep.store.record_json import to_json
from slatprep.store.records import (
    BUILD,
    MAX_BUILD_BYTES,
    SEVERAL,
    build_in,
    file_names,
    lines_of,
    stale_files,
)

PROBLEMS_LISTED = 100
"""Largest number of problems that a summary lists; the records hold all."""


@dataclass(frozen=True)
class BuildSummary:
    """Summary of a build.

    Attributes
    ----------
    records : Place
        The JSON Lines file of asset records; for more than 1,024 assets the pattern of several
        files, with a ``*``.
    build_id : str
        Id of the build, a hash of the records' content.
    seconds : float
        Wall clock time.
    statuses : dict
        Assets by status: ``ok``, ``failed``, ``skipped``.
    verdicts : dict
        Assets with status ``ok`` by verdict: ``good``, ``doubtful``, ``failed``.
    n_voxels, n_valid : int
        SLAT voxels of assets with status ``ok``, and the number of them with an annotation.
    n_unphysical : int
        PixieVerse voxels of assets with status ``ok`` that were left out, because no
        material has their properties.
    problems : tuple of (str, str)
        Asset id and reason of the first `PROBLEMS_LISTED` assets that are not ``ok``.
    contradicted : tuple of str
        Ids of the first `PROBLEMS_LISTED` assets whose latents contradict their labels.
    store : Place or None
        The store; None if only alignments were written.
    normalization : Normalization or None
        Ranges of the properties.
    clipped : dict
        Number of values of ``voxel/properties`` outside the range, by property.
    warnings : tuple of str
        What a person should know about the dataset as a whole.
    damaged : tuple of str
        Parts of the existing store that were damaged and were made anew, in words.
    rehash_seed : int or None
        Seed of the draw of unchanged sources to hash; None if none was hashed.
    removed : int
        Number of assets of the old store that the new store lacks.
    taken_out : dict of str to str
        Reason, by id, for the first `PROBLEMS_LISTED` removed assets.
    unchanged : bool
        Whether the existing store stayed as it was.
    aligned, taken_over : int
        Assets with status ``ok`` that were aligned; and those that were not, as their alignment is
        in a store, or an interrupted build finished it.
    """

    records: Place
    build_id: str
    seconds: float
    statuses: dict[str, int]
    verdicts: dict[str, int]
    n_voxels: int
    n_valid: int
    n_unphysical: int
    problems: tuple[tuple[str, str], ...]
    contradicted: tuple[str, ...] = ()
    store: Place | None = None
    normalization: Normalization | None = None
    clipped: Mapping[str, int] = field(default_factory=dict)
    damaged: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    rehash_seed: int | None = None
    removed: int = 0
    taken_out: Mapping[str, str] = field(default_factory=dict)
    unchanged: bool = False
    aligned: int = 0
    taken_over: int = 0

    @property
    def complete(self) -> bool:
        """Whether every asset went into the store."""
        return all(count == 0 for status, count in self.statuses.items() if status != Status.OK)


def counts_of(
    ids: Sequence[str], sizes: NDArray[np.int64], column: Callable[[str], NDArray[Any]]
) -> dict[str, Any]:
    """Return counts of the assets that went in, by field of a `BuildSummary`.

    `ids` and `sizes` (A,), the numbers of voxels, are those of the assets. `column` returns their
    ``asset/*`` column by name.
    """
    contradicted = sorted(ids[row] for row in np.flatnonzero(column("contradicted")).tolist())
    return {
        "verdicts": dict(sorted(Counter(map(str, column("verdict"))).items())),
        "n_voxels": int(sizes.sum()),
        "n_valid": int(np.rint(column("valid_share") * sizes).sum()),
        "n_unphysical": int(column("unphysical").sum()),
        "contradicted": tuple(contradicted[:PROBLEMS_LISTED]),
    }


def counts_in(store: Store) -> dict[str, Any]:
    """Return the counts of a store's assets, see `counts_of`, and clipped values by property."""
    clipped = store.column("clipped").sum(axis=0).tolist()
    counts = counts_of(store.ids, np.diff(store.offsets), store.column)
    return counts | {"clipped": dict(zip(store.about.property_columns, clipped, strict=True))}


def summarise(
    counts: Mapping[str, Any], failed: Sequence[FailedRecord], begin: float, **told: Any
) -> BuildSummary:
    """Return a summary from counts of the assets that went in, and the records of the others."""
    statuses = Counter(str(asset.status) for asset in failed)
    statuses[str(Status.OK)] = sum(counts["verdicts"].values())
    return BuildSummary(
        seconds=time.perf_counter() - begin,
        statuses={str(status): statuses[str(status)] for status in Status},
        problems=tuple((asset.asset_id, asset.reason) for asset in failed[:PROBLEMS_LISTED]),
        **counts,
        **told,
    )


def publish_build(
    place: Destination,
    store: Store,
    parameters: BuildParameters,
    begin: float,
    failed: Sequence[FailedRecord] = (),
    standing: Collection[str] = (),
    *,
    aligned: int = 0,
    warnings: Iterable[str] = (),
    **told: Any,
) -> BuildSummary:
    """Publish a store that is in place, with its manifests; return the build's summary.

    `failed` assets could not go in. Files named in `standing` are not checked. `aligned` is the
    number of assets that were not taken over, and `told` are further fields of the summary.
    StoreError if the manifests cannot be written.
    """
    folder, names = place.manifests(store.path), file_names(len(store))
    summary = summarise(
        counts_in(store),
        failed,
        begin,
        records=folder / (names[0] if len(names) == 1 else SEVERAL),
        build_id=store.about.manifest,
        store=place.out,
        normalization=store.normalization,
        removed=len(place.removed),
        taken_out=why_taken_out(place.removed[:PROBLEMS_LISTED], {one.asset_id for one in failed}),
        unchanged=not place.if_stopped,
        aligned=aligned,
        taken_over=len(store) - aligned,
        warnings=(*warnings, *moved_ranges(store.normalization, place.ranges)),
        **told,
    )
    try:
        record = build_record(store, summary, parameters, failed)
        _write_manifests(folder, store, record, standing)
    except OSError as error:
        raise StoreError(
            f"{folder}: the records cannot be written there ({error.strerror or error}); the store "
            "is complete and holds those of its assets. Run again to write them here"
        ) from error
    place.publish()
    return summary


def _write_manifests(
    folder: Place, store: Store, record: BuildRecord, standing: Collection[str]
) -> None:
    """Write the lines of a store's records, and `build.json`; leave files with equal content."""
    names = file_names(len(store))
    looked = [(n, name) for n, name in enumerate(names) if name not in standing]
    written = [_write(folder / name, lines_of(store, n)) for n, name in looked]
    if any(written) or not _is_there(folder, record):
        reached("manifests written", str(folder))
        _write(folder / BUILD, to_json(record, indent=True) + b"\n")
        reached("manifests published", str(folder))
    if (local := storage_of(folder).local) is not None:
        for file in filter(is_marked, stale_files(local, names)):
            file.unlink()


def _write(file: Place, content: bytes) -> bool:
    """Write a file in one step, unless it has this content; return whether it was written."""
    with suppress(OSError):
        if storage_of(file).read(len(content)) == content:
            return False
    with storage_of(file).staged() as partial:
        partial.write_bytes(content)
    return True


def _is_there(folder: Place, wanted: BuildRecord) -> bool:
    """Return whether a folder has the wanted record of a build, except for time and machine."""
    try:
        found = build_in(folder)
    except StoreError:
        return False
    run = {name: getattr(found, name) for name in ("created", "duration_s", "platform")}
    return to_json(found) == to_json(replace(wanted, **run))


def build_record(
    store: Store, summary: BuildSummary, parameters: BuildParameters, failed: Iterable[FailedRecord]
) -> BuildRecord:
    """Return the record of a build that made a store."""
    return BuildRecord(
        id=summary.build_id,
        name=parameters.name,
        created=datetime.now(UTC).replace(microsecond=0),
        duration_s=round(summary.seconds, 3),
        platform=platform.platform(),
        store=(storage_of(store.path).local or summary.store or store.path).name,
        records=summary.records.name,
        parameters=parameters,
        versions=store.about.build.versions,
        normalization=store.normalization,
        statuses=summary.statuses,
        verdicts=summary.verdicts,
        counts=BuildCounts(
            voxels=summary.n_voxels,
            valid=summary.n_valid,
            clipped=dict(summary.clipped),
            unphysical=summary.n_unphysical,
        ),
        failed=tuple(_as_many_as_fit(failed)),
    )


def _as_many_as_fit(failed: Iterable[FailedRecord]) -> Iterator[FailedRecord]:
    left = MAX_BUILD_BYTES // 4  # Indented records, with escapes, take more.
    for record in failed:
        left -= len(to_json(record))
        if left < 0:
            return
        yield record

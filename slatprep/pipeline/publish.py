"""Publish a build: put its store in place, its manifests beside it, and say what it did.

The store and its records are replaced in one step, because the records are an
array of the store. The files beside it are made from them. If a build is killed
before it writes them, the next build writes them.
"""

from __future__ import annotations

import os
import platform
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, SlatprepError, StoreError, in_unicode
from slatprep.parameters import BuildParameters
from slatprep.pipeline.notices import moved_ranges
from slatprep.pipeline.plan import why_taken_out
from slatprep.records import Normalization, Place, Status
from slatprep.storage.atomic import replace_directory
from slatprep.storage.faults import reached
from slatprep.storage.place import place_of, storage_of
from slatprep.storage.upload import PublishedState, Staged, Upload, published_state, upload_store
from slatprep.store.reader import Store, is_store, open_store, require_beside, require_outside
from slatprep.store.record import BuildCounts, BuildRecord, FailedRecord
from slatprep.store.record_json import to_json
from slatprep.store.records import (
    ASSETS,
    BUILD,
    ERRORS,
    MAX_BUILD_BYTES,
    SEVERAL,
    build_in,
    file_names,
    lines_of,
    manifests_of,
    stale_files,
)

_MARKS = {
    BUILD: b'"slatprep-build-record"',
    ASSETS: b'"slatprep-asset-record"',
    ERRORS: b'"refitted"',
}
"""Text near the beginning of each file beside a store, which identifies the file."""

_HEAD_BYTES = 4096


class Destination:
    """Destination of a store and its records.

    `out` is the store as its user names it, and `store` its real place, behind a link. `manifests`
    is the folder of its records, if not beside it. `removed` are those of an existing store's
    assets that the new store lacks, and `ranges` its ranges, if they are known, by words for it.
    ConfigError if there is something other than a store, or it lies in another store. StoreError if
    the folder holds files of other origin or the records of another store.
    """

    def __init__(self, out: str | Place, manifests: str | Place | None = None) -> None:
        self.out = place_of(out)
        if str(self.out) != in_unicode(str(self.out)):
            raise StoreError(f"{self.out}: is no UTF-8; expected a name that records can hold")
        self._manifests = None if manifests is None else storage_of(place_of(manifests)).local
        if manifests is not None and self._manifests is None:
            raise StoreError(f"{manifests}: expected a local folder for the records")
        path, self._remote = storage_of(self.out).local, storage_of(self.out).remote
        self.store: Place = self.out if path is None else _replaceable(path)
        folder = self._manifests
        if folder is None and path is not None:
            require_beside(folder := Path(str(manifests_of(path))))
        if folder is not None:
            _require_records(folder, storage_of(self.store).local)
            if path is not None:
                _require_own(folder, path)
        self._before: PublishedState | None = None
        self._upload: Upload | None = None
        self.replacing = False
        self.removed: list[str] = []
        self.ranges: dict[str, Normalization] = {}

    def look(self) -> None:
        """Read what is published on an object store; StoreError if no store may be there."""
        if self._remote is not None:
            self._before = published_state(self._remote)

    @contextmanager
    def telling_if_stopped(self) -> Iterator[None]:
        """Make a KeyboardInterrupt say that the new store may be in place, if it may be."""
        try:
            yield
        except KeyboardInterrupt:
            if not self.replacing:
                raise
            told = f"{self.out} is the old store or the new one, whole; run it again"
            raise KeyboardInterrupt(told) from None

    def replace(self, new: Path, ids: Iterable[str], staged: Staged | None = None) -> None:
        """Put a finished store with these ids in place; on an object store, do not publish it yet.

        `staged` are its files that are on the object store already.
        """
        self.replacing = True
        self.removed, self.ranges = self.lost(ids, "was")
        if self._before is not None:
            self._upload = upload_store(new, self._before, staged)
        elif (path := storage_of(self.store).local) is not None:
            replace_directory(new, path)
        reached("store replaced", str(self.store))

    def lost(self, ids: Iterable[str], verb: str) -> tuple[list[str], dict[str, Normalization]]:
        """Return ids of the existing store not among `ids`, sorted; its ranges for `moved_ranges`.

        `verb` says in words when it lies there.
        """
        with suppress(StoreError):  # There is no store, or its ids cannot be read.
            there = open_store(self.store)
            ranges = {f"the store that {verb} there": there.normalization}
            return sorted(set(there.ids).difference(ids)), ranges
        return [], {}

    def publish(self) -> None:
        """Make the new version on an object store the current one."""
        if self._upload is not None:
            self._upload.publish()

    def in_place(self) -> Store:
        """Open the new store after it was put in place."""
        return open_store(self.store if self._upload is None else self._upload.version)

    def manifests(self, store: Place | None = None) -> Place:
        """Return the folder of the records of a store that lies here, by default a new store."""
        version = None if self._remote is None else store
        return self._manifests or manifests_of(self.out if version is None else version)


def _replaceable(out: Path) -> Path:
    require_outside(out, to_replace=True)
    try:
        taken = out.exists() and not is_store(out) and not (out.is_dir() and not any(out.iterdir()))
    except OSError as error:
        raise StoreError(
            f"{out}: cannot be looked at ({error.strerror}); expected a path that may be read and "
            "written"
        ) from error
    if taken:
        raise ConfigError(
            f"{out} exists and is not a slatprep store; expected a store to replace, or a new path"
        )
    return out.resolve()


def _require_records(folder: Path, store: Path | None) -> None:
    """Raise if anything but records of builds would be overwritten in a folder."""
    if store is not None and folder.resolve().is_relative_to(store):
        raise StoreError(f"{folder}: lies in the store; expected a folder outside of it")
    require_outside(folder)
    require_free(folder / BUILD, *(stale_files(folder, ()) if folder.is_dir() else ()))


def require_free(*files: Path, mark: str = "", kind: type[SlatprepError] = StoreError) -> None:
    """Raise if any of these files exist and none of them is marked, see `is_marked`.

    If one file is damaged, another identifies their folder.
    """
    there = [file for file in files if os.path.lexists(file)]
    if there and not any(is_marked(file, mark) for file in there):
        raise kind(
            f"{there[0]} exists and is not slatprep's; expected such a file to replace, or none: "
            "move it away, or choose another path"
        )


def _require_own(folder: Path, store: Path) -> None:
    """Raise if a folder holds the records of another store that still exists.

    ``demo`` and ``demo.zarr`` share a folder by default. A store that was renamed with its records
    keeps them, even if a new store has the old name: the new store has another folder.
    """
    try:
        name = build_in(folder).store
        others = store.with_name(name), folder.with_name(name)
    except (StoreError, ValueError):
        return  # Missing or damaged records are written anew.
    for other in others:
        renamed = folder.name == manifests_of(store).name != manifests_of(other).name
        taken = not renamed and name != store.name and is_store(other)
        if taken and other.resolve() != store.resolve():
            raise StoreError(
                f"{folder}: holds the records of {other}; expected --manifests FOLDER, or another "
                f"name for {store}"
            )


def is_marked(file: Path, name: str = "") -> bool:
    """Return whether a file has the mark of a file called `name`, by default its own name."""
    try:
        return _MARKS.get(name or file.name, _MARKS[ASSETS]) in storage_of(file).read(_HEAD_BYTES)
    except OSError:
        return False


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
        unchanged=not place.replacing,
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
    voxels = summary.n_voxels, summary.n_valid, dict(summary.clipped), summary.n_unphysical
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
        counts=BuildCounts(*voxels),
        failed=tuple(_as_many_as_fit(failed)),
    )


def _as_many_as_fit(failed: Iterable[FailedRecord]) -> Iterator[FailedRecord]:
    left = MAX_BUILD_BYTES // 4  # Indented records, with escapes, take more.
    for record in failed:
        left -= len(to_json(record))
        if left < 0:
            return
        yield record

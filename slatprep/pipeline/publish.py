"""Publish a build: put its store in place, its manifests beside it, and say what it did.

The store and its records are replaced in one step, because the records are an
array of it. The files beside it are made from them; a build that was killed before it
could write them is noticed by the next one, which writes them then.
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

from slatprep.errors import ConfigError, StoreError, in_unicode
from slatprep.parameters import BuildParameters
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
"""Files beside a store, and what each says at its beginning."""

_HEAD_BYTES = 4096


class Destination:
    """Where a store and its records go; `store` is where it really lies, behind a link.

    `out` is the store as its user names it, `manifests` the folder of its records, if not beside
    it. `there` is the store that is there, where it is open already; `removed` are those of its
    assets that the new one lacks. StoreError if there is something other than a store, or the
    folder holds files of other origin or the records of another store; ConfigError if it lies in
    another store.
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
        self.there: Store | None = None
        self.replacing = False
        self.removed: list[str] = []

    def look(self) -> None:
        """See, on an object store, what is published; raise `StoreError` if none may be there."""
        if self._remote is not None:
            self._before = published_state(self._remote)

    @contextmanager
    def telling_if_stopped(self) -> Iterator[None]:
        """Have a KeyboardInterrupt say so if the new store may be in place by then."""
        try:
            yield
        except KeyboardInterrupt:
            if not self.replacing:
                raise
            told = f"{self.out} is the old store or the new one, whole; run it again"
            raise KeyboardInterrupt(told) from None

    def replace(self, new: Path, ids: Iterable[str], staged: Staged | None = None) -> None:
        """Put a finished store with these ids in place; on an object store not published yet.

        `staged` is what of it is on the object store already.
        """
        self.replacing = True
        self.removed = self.lost(ids)
        if self._before is not None:
            self._upload = upload_store(new, self._before, staged)
        elif (path := storage_of(self.store).local) is not None:
            replace_directory(new, path)
        reached("store replaced", str(self.store))

    def lost(self, ids: Iterable[str]) -> list[str]:
        """Return which assets of the store that is there are not among these, by id."""
        with suppress(StoreError):  # There is none, or its ids cannot be read.
            return sorted(set((self.there or open_store(self.store)).ids).difference(ids))
        return []

    def publish(self) -> None:
        """Make the new version on an object store the current one."""
        if self._upload is not None:
            self._upload.publish()

    def in_place(self) -> Store:
        """Open the new store, once it is in place."""
        return open_store(self.store if self._upload is None else self._upload.version)

    def manifests(self, store: Place | None = None) -> Place:
        """Return the folder of the records of a store that lies here; by default of a new one."""
        version = None if self._remote is None else store
        return self._manifests or manifests_of(self.out if version is None else version)


def _replaceable(out: Path) -> Path:
    try:
        taken = out.exists() and not is_store(out) and not (out.is_dir() and not any(out.iterdir()))
        target = out.resolve()
    except OSError as error:
        raise StoreError(
            f"{out}: cannot be looked at ({error.strerror}); expected a path that may be read and "
            "written"
        ) from error
    around = next((str(path) for path in target.parents if is_store(path)), "")
    if around:
        raise ConfigError(f"{out} lies inside the store {around}; choose a path outside of it")
    if taken:
        raise ConfigError(
            f"{out} exists and is not a slatprep store; expected a store to replace, or a new path"
        )
    return target


def _require_records(folder: Path, store: Path | None) -> None:
    """Raise unless nothing but records of builds would be overwritten in a folder."""
    if store is not None and folder.resolve().is_relative_to(store):
        raise StoreError(f"{folder}: lies in the store; expected a folder outside of it")
    require_outside(folder)
    there = [folder / BUILD] if os.path.lexists(folder / BUILD) else []
    there += stale_files(folder, ()) if folder.is_dir() else []
    # Where one file is damaged, another identifies the folder.
    if there and not any(is_marked(file) for file in there):
        raise StoreError(
            f"{folder}: holds a {there[0].name} that is not slatprep's; expected the records of a "
            "build: move it away, or name another folder with --manifests"
        )


def require_records_file(file: Path) -> None:
    """Raise ConfigError if a file to write lies in a store, or holds what is no record."""
    require_outside(file)
    if os.path.lexists(file) and not is_marked(file, ASSETS):
        raise ConfigError(
            f"{file} exists and holds no records of slatprep; expected such records to replace, "
            "or a new path"
        )


def _require_own(folder: Path, store: Path) -> None:
    """Raise if a folder holds the records of another store, which is still there.

    ``demo`` and ``demo.zarr`` have one folder, by default. A store that was renamed with its
    records keeps them, also where a new store has the old name: that one's folder is another.
    """
    try:
        name = build_in(folder).store
        others = store.with_name(name), folder.with_name(name)
    except (StoreError, ValueError):
        return  # None, or damaged ones, which are written anew.
    for other in others:
        renamed = folder.name == manifests_of(store).name != manifests_of(other).name
        taken = not renamed and name != store.name and is_store(other)
        if taken and other.resolve() != store.resolve():
            raise StoreError(
                f"{folder}: holds the records of {other}; expected --manifests FOLDER, or another "
                f"name for {store}"
            )


def is_marked(file: Path, name: str = "") -> bool:
    """Whether a file says at its beginning that it is what a name, by default its own, means."""
    try:
        return _MARKS.get(name or file.name, _MARKS[ASSETS]) in storage_of(file).read(_HEAD_BYTES)
    except OSError:
        return False


PROBLEMS_LISTED = 100
"""How many problems a summary lists; the records hold all."""


@dataclass(frozen=True)
class BuildSummary:
    """What a build did.

    Attributes
    ----------
    records : Place
        The JSON Lines file of asset records; of more than 1,024 assets, what their files are
        called, with a ``*``.
    build_id : str
        Id of the build, a hash of the records' content.
    seconds : float
        Wall clock time.
    statuses : dict
        Assets by status: ``ok``, ``failed``, ``skipped``.
    verdicts : dict
        Assets with status ``ok`` by verdict: ``good``, ``doubtful``, ``failed``.
    n_voxels, n_valid : int
        SLAT voxels of those assets, and how many found an annotation.
    n_unphysical : int
        PixieVerse voxels of those assets that no annotation was taken from, as no
        material has their properties.
    problems : tuple of (str, str)
        Asset id and reason of the first `PROBLEMS_LISTED` that are not ``ok``.
    contradicted : tuple of str
        Ids of the first `PROBLEMS_LISTED` whose latents contradict their labels.
    store : Place or None
        The store; None where only alignments were written.
    normalization : Normalization or None
        Ranges of the properties.
    clipped : dict
        By property, values of ``voxel/properties`` that lay outside its range.
    warnings : tuple of str
        What a person should know about the dataset as a whole.
    damaged : tuple of str
        What of the existing store was not as it was written, and was made anew.
    rehash_seed : int or None
        What the share of unchanged sources was drawn with that was hashed; None if none was.
    removed : int
        Assets of the store that was there which the new one lacks.
    taken_out : dict of str to str
        Why, by id, of the first `PROBLEMS_LISTED` of them.
    unchanged : bool
        Whether the store that was there stayed as it was.
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

    @property
    def complete(self) -> bool:
        """Whether every asset went in."""
        return all(count == 0 for status, count in self.statuses.items() if status != Status.OK)


def counts_of(
    ids: Sequence[str], sizes: NDArray[np.int64], column: Callable[[str], NDArray[Any]]
) -> dict[str, Any]:
    """Count what a `BuildSummary` tells of the assets that went in, by its fields.

    Of those there are ids, numbers of voxels (N,), and columns by name.
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
    """Count what became of the assets of a store, see `counts_of`; by property what is clipped."""
    clipped = store.column("clipped").sum(axis=0).tolist()
    counts = counts_of(store.ids, np.diff(store.offsets), store.column)
    return counts | {"clipped": dict(zip(store.about.property_columns, clipped, strict=True))}


def summarise(
    counts: Mapping[str, Any], failed: Sequence[FailedRecord], begin: float, **told: Any
) -> BuildSummary:
    """Say what became of the assets, by counts of those that went in."""
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
    **told: Any,
) -> BuildSummary:
    """Publish a store that is in place, with its manifests; say what it holds, and what is told.

    `failed` could not go in; the files named in `standing` are not looked at. StoreError if the
    disk does not take the manifests.
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
    """Write lines of a store's records, and `build.json`; what says so already stays as it is."""
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
    """Write a file in one step, unless it is there with this content; whether it was written."""
    with suppress(OSError):
        if storage_of(file).read(len(content)) == content:
            return False
    with storage_of(file).staged() as partial:
        partial.write_bytes(content)
    return True


def _is_there(folder: Place, wanted: BuildRecord) -> bool:
    """Whether the record of a build says what it should, but for when and where it ran."""
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
    left = MAX_BUILD_BYTES // 4  # Indented, with escapes, they take more.
    for record in failed:
        left -= len(to_json(record))
        if left < 0:
            return
        yield record

"""Publish a build: put its store in place, with its records within it and beside it.

The store and its records are replaced in one step, because the records are an
array of it. The files beside it are copies; a build that was killed before it
could write them is noticed by the next one, which writes them then.
"""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType

from slatprep.errors import ConfigError, StoreError, in_unicode
from slatprep.parameters import BuildParameters
from slatprep.pipeline.summary import BuildSummary
from slatprep.provenance.files import build_in
from slatprep.provenance.make import build_versions
from slatprep.provenance.places import manifests_of
from slatprep.provenance.record import (
    BuildCounts,
    BuildRecord,
    Record,
    Versions,
)
from slatprep.provenance.record_json import RecordText, content_of, to_json, write_records
from slatprep.records import Place
from slatprep.storage.atomic import append_file, replace_directory
from slatprep.storage.faults import reached
from slatprep.storage.place import place_of, storage_of
from slatprep.storage.upload import PublishedState, Staged, Upload, published_state, upload_store
from slatprep.store.reader import is_store, require_outside
from slatprep.store.records import RecordWriter
from slatprep.store.writer import open_for_writing

_MARKS = {"build.json": b'"slatprep-build-record"', "assets.jsonl": b'"slatprep-asset-record"'}
"""Files beside a store, and what each says at its beginning."""

_HEAD_BYTES = 4096


class Destination:
    """Where a build goes: a folder that is replaced, or a new version on an object store.

    Parameters
    ----------
    out : str or Place
        The store, as its user names it.
    manifests : str or Path, optional
        Folder of its records, if not beside it.

    Attributes
    ----------
    store : Place
        Where the store really lies: what a link points to is replaced, not the link.

    Raises
    ------
    StoreError
        If there is something other than a store, or the folder of records holds
        files of other origin or the records of another store.
    ConfigError
        If the folder of records lies in another store.
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
        if self._manifests is not None:
            _require_records(self._manifests, storage_of(self.store).local)
        if path is not None:
            _require_own(self._manifests or path.parent / manifests_of(path).name, path)
        self._before: PublishedState | None = None
        self._upload: Upload | None = None

    def look(self) -> None:
        """See, on an object store, what is published; raise `StoreError` if none may be there."""
        if self._remote is not None:
            self._before = published_state(self._remote)

    def replace(self, new: Path, staged: Staged | None = None) -> None:
        """Put a finished store in place; on an object store it is not published yet.

        Parameters
        ----------
        new : Path
            The store.
        staged : Staged, optional
            What of it is on the object store already.
        """
        if self._before is not None:
            self._upload = upload_store(new, self._before, staged)
        elif (path := storage_of(self.store).local) is not None:
            replace_directory(new, path)
        reached("store replaced", str(self.store))

    def publish(self) -> None:
        """Make the new version on an object store the current one."""
        if self._upload is not None:
            self._upload.publish()

    def records(self, version: Place | None = None) -> Place:
        """Return the file of asset records, of the new store or of the existing version."""
        if self._upload is not None:
            version = self._upload.version
        beside = self.out if self._remote is None or version is None else version
        return (self._manifests or manifests_of(beside)) / "assets.jsonl"


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
    there = [name for name in _MARKS if os.path.lexists(folder / name)]
    # Where one file is damaged, the other identifies the folder.
    if there and not any(_is_marked(folder / name, _MARKS[name]) for name in there):
        raise StoreError(
            f"{folder}: holds a {there[0]} that is not slatprep's; expected the records of a "
            "build, or another folder"
        )


def require_records_file(file: Path) -> None:
    """Raise ConfigError if a file to write lies in a store, or holds what is no record."""
    require_outside(file)
    if os.path.lexists(file) and not _is_marked(file, _MARKS["assets.jsonl"]):
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


def _is_marked(file: Path, mark: bytes) -> bool:
    try:
        return mark in storage_of(file).read(_HEAD_BYTES)
    except OSError:
        return False


def write_all_records(
    store: Path,
    path: Path,
    records: Iterable[tuple[int, Record | RecordText]],
    taken: frozenset[int] = frozenset(),
    standing: Mapping[str, bytes] = MappingProxyType({}),
) -> dict[str, bytes]:
    """Write records to a file, and those of rows into the new store; return all digests by id.

    Parameters
    ----------
    store : Path
        The new store.
    path : Path
        The file.
    records : iterable of (int, Record or RecordText)
        Rows and records, by asset id; rows of assets that do not go in are negative.
    taken : frozenset of int
        Shards of records that the new store has already.
    standing : mapping of str to bytes
        Digests of records by id that have a line already, so that they are not written to the
        file.
    """
    writer = RecordWriter(open_for_writing(store), taken)

    def lines() -> Iterator[Record | RecordText]:
        for row, record in records:
            if row >= 0:
                writer.add(row, content_of(record))
            if record.asset_id not in standing:
                yield record

    digests = {**standing, **write_records(path, lines())}
    reached("records written", str(path))
    return digests


def publish_manifests(
    records: Path,
    summary: BuildSummary,
    parameters: BuildParameters,
    versions: Versions | None = None,
    behind: int = 0,
) -> None:
    """Move the records of a finished build to where people look for them.

    Parameters
    ----------
    records : Path
        Those of the assets.
    summary : BuildSummary
        What the build did.
    parameters : BuildParameters
        What it was asked for.
    versions : dict of str to str, optional
        Of the libraries that made the numbers, where they are not those of today.
    behind : int
        Put the records behind what is there, a file of so many bytes. Above 0 it must be
        on a disk; what of it a reader has read stays where it is.

    Raises
    ------
    StoreError
        If the disk does not take them.
    """
    folder = summary.records.parent
    try:
        with ExitStack() as stack:
            build_file = stack.enter_context(storage_of(folder / "build.json").staged())
            if behind and (there := storage_of(summary.records).local) is not None:
                append_file(records, there, behind)
            else:
                place = stack.enter_context(storage_of(summary.records).staged())
                try:
                    records.replace(place)
                except OSError:  # on another disk
                    shutil.copyfile(records, place)
            reached("manifests written", str(folder))
            document = to_json(build_record(summary, parameters, versions), indent=True)
            build_file.write_bytes(document + b"\n")
        reached("manifests published", str(folder))
    except OSError as error:
        raise StoreError(
            f"{folder}: the records cannot be written there ({error.strerror or error}); the store "
            "is complete and holds those of its assets. Run again to write them here"
        ) from error


def build_record(
    summary: BuildSummary, parameters: BuildParameters, versions: Versions | None = None
) -> BuildRecord:
    """Return the record of a build that made a store; ValueError where it made none."""
    if summary.store is None or summary.normalization is None:
        raise ValueError("a build without a store has no record")
    return BuildRecord(
        id=summary.build_id,
        name=parameters.name,
        created=datetime.now(UTC).replace(microsecond=0),
        duration_s=round(summary.seconds, 3),
        platform=platform.platform(),
        store=summary.store.name,
        records=summary.records.name,
        parameters=parameters,
        versions=versions or build_versions(parameters),
        normalization=summary.normalization,
        statuses=summary.statuses,
        verdicts=summary.verdicts,
        counts=BuildCounts(
            summary.n_voxels,
            summary.n_valid,
            dict(summary.clipped),
            summary.n_unphysical,
        ),
    )

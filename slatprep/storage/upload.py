"""Put a finished store on an object store: upload all of it, then publish it in one step.

Readers read only what the pointer names, so an upload that ends midway does no harm. The pointer is
replaced only if it is still the one from the beginning of the build: on S3 the server itself
compares them.

A version's name comes from its content and from the pointer that it replaces. A repeated upload
therefore finds what the first one left. A process that removes a version's objects has replaced
that pointer before, so this build's own replacement fails. Readers never see a partial store. If
workers of a cluster upload a version's large files, its content is not known in advance, and its
name is random.
"""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from slatprep.errors import StoreError
from slatprep.storage import versions
from slatprep.storage.atomic import writing
from slatprep.storage.faults import reached
from slatprep.storage.files import file_digest, local_files
from slatprep.storage.remote import (
    PART_BYTES,
    RemotePlace,
    connected,
    copy_objects,
    list_objects,
    put_objects,
    remove_objects,
)

# A small file is held in memory whole while it is uploaded.
_SMALL_BYTES = 8 * 2**20

_MD5 = re.compile(r"[0-9a-f]{32}(-[0-9]+)?")
"""Pattern of S3's tag of an object; after an upload in parts it ends with their number."""


@dataclass(frozen=True)
class Staged:
    """Files of a version that are on the object store already: bytes and SHA-256 in hex by name.

    Workers have put some of them into `version`. The server will copy the others, those in
    `copied`, from the version `before`.
    """

    sizes: Mapping[str, int]
    digests: Mapping[str, str]
    version: RemotePlace | None = None
    before: RemotePlace | None = None
    copied: frozenset[str] = frozenset()


@dataclass(frozen=True)
class PublishedState:
    """The pointer of a store at the beginning of a build, if any, and the server's tag for it."""

    target: RemotePlace
    pointer: versions.Pointer | None
    tag: str = ""


def published_state(target: RemotePlace) -> PublishedState:
    """Return the state that a build would replace.

    Raises StoreError if the place cannot be reached, or holds something other than a store.
    """
    if versions.is_version(target):
        raise StoreError(f"{target} is one version of a store; expected {target.parent.parent}")
    try:
        for above in (target.path, *target.path.parents):
            store = RemotePlace(target.protocol, above.parent)
            if above.name in _OWN and above.parent.name and (store / versions.POINTER).exists():
                raise StoreError(
                    f"{target} lies in the store {store}; expected a URL outside of it"
                )
        # Read the tag first: if the pointer moves in between, the old tag will not match.
        tag = str((target / versions.POINTER).entry().get("ETag", ""))
        pointer = versions.read_pointer(target)
        others = [] if pointer else [name for name in list_objects(target) if not _is_ours(name)]
    except OSError as error:
        raise StoreError(
            f"{target}: cannot be reached ({error.strerror}); expected a URL in a bucket that "
            "exists and may be written to"
        ) from None
    if others:
        raise StoreError(
            f"{target} holds {others[0]} and is not a slatprep store with versions; expected one "
            "to replace, or a new URL"
        )
    return PublishedState(target, pointer, tag)


@dataclass(frozen=True)
class Upload:
    """A new version that is complete and not yet published; `upload_store` makes one.

    `before` is the state at the beginning of the build, `pointer` the new pointer.
    """

    before: PublishedState
    pointer: versions.Pointer

    @property
    def target(self) -> RemotePlace:
        """The store."""
        return self.before.target

    @property
    def version(self) -> RemotePlace:
        """The place of its files."""
        return self.target / versions.VERSIONS / self.pointer.version

    def publish(self) -> None:
        """Replace the pointer, and remove the versions that nobody needs any more.

        Raises StoreError if another build has replaced it meanwhile, or it cannot be written.
        """
        if self.pointer == self.before.pointer:
            return
        keep = {self.pointer.version, self.pointer.previous}
        with writing(str(self.target), self.target):
            # List them before the pointer moves, so that later builds are not in the list.
            old = [name for name in list_objects(self.target) if _is_of_version(name, but=keep)]
            self._replace_pointer()
        reached("pointer replaced", str(self.target))
        try:
            remove_objects(self.target, old)
        except OSError as error:
            # The new store is complete all the same, and the next build will try again.
            warnings.warn(
                f"{self.target}: older versions could not be removed ({error.strerror})",
                stacklevel=2,
            )

    def _replace_pointer(self) -> None:
        try:
            if versions.read_pointer(self.target) == self.before.pointer:
                with connected(self.target / versions.POINTER) as (system, name):
                    condition: dict[str, Any] = {}
                    if self.before.pointer is None:
                        condition["mode"] = "create"
                    elif "s3" in system.protocol:
                        condition["IfMatch"] = self.before.tag
                    system.pipe_file(name, self.pointer.encode(), **condition)
                    return
        except OSError as error:
            try:
                now = versions.read_pointer(self.target)
            except OSError:
                raise StoreError(
                    f"{self.target}: no answer came when its pointer was written "
                    f"({error.strerror}); the store is the old one or the new one, whole. Run again"
                ) from None
            if now == self.before.pointer:
                raise
        now = versions.read_pointer(self.target)
        # It is ours if the server's answer was lost, or if another build has the same content.
        if now is None or now.version != self.pointer.version:
            raise StoreError(
                f"{self.target}: another build replaced it while this one ran (at "
                f"{now.published if now else 'an unknown time'}); nothing was changed. Run again "
                "to bring it up to date"
            )


def upload_store(new: Path, before: PublishedState, staged: Staged | None = None) -> Upload:
    """Upload all files of a finished local store as a new version, and check that they are there.

    `staged` are the files that `new` lacks; those that workers uploaded are removed if not needed.
    Nothing is uploaded if `before`, the state at the beginning of the build, has the same content.
    StoreError if a file cannot be uploaded.
    """
    staged = staged or Staged({}, {})
    files, place = local_files(new), staged.version
    unknown = sorted(files.keys() - staged.digests.keys())
    digests = {**{name: file_digest(new / name) for name in unknown}, **staged.digests}
    sizes, content = {**files, **staged.sizes}, versions.content_of(digests)
    if before.pointer is not None and before.pointer.content == content:
        current = Upload(before, before.pointer)
        with writing(str(before.target), before.target):
            # A version that somebody damaged is no reason to upload nothing.
            if _holds(current.version, new, files, sizes):
                if place is not None:
                    remove_objects(place, list_objects(place))
                return current
    previous = before.pointer.version if before.pointer else ""
    own = hashlib.sha256(f"{previous}{content}".encode()).hexdigest()[:16]
    now = datetime.now(UTC).isoformat(timespec="seconds")
    version = place.name if place else own
    upload = Upload(before, versions.Pointer(version, previous, content, now))
    with writing(str(before.target), before.target):
        there = list_objects(upload.version)
        missing = {
            name
            for name, size in files.items()
            if there.get(name, {}).get("size") != size or not _is_tagged(there[name], new / name)
        }
        small = [name for name in sorted(missing) if files[name] <= _SMALL_BYTES]
        large = [name for name in sorted(missing) if files[name] > _SMALL_BYTES]
        put_objects(new, upload.version, small)
        for name in large:
            (upload.version / name).upload(new / name)
        if staged.before is not None:
            # An earlier upload may have left some: a version's name implies its content.
            others = [n for n in staged.copied if there.get(n, {}).get("size") != sizes[n]]
            copy_objects(staged.before, upload.version, sorted(others))
        there = list_objects(upload.version)
        for name, size in sizes.items():
            arrived = there.get(name, {}).get("size") == size
            if arrived and name in missing and _is_tagged(there[name], new / name) is False:
                arrived = file_digest(upload.version / name) == digests[name]
            if not arrived:
                raise StoreError(
                    f"{upload.version / name}: is not there as it was uploaded; nothing was "
                    "replaced. If another build has just replaced the store, run again"
                )
    return upload


def _holds(version: RemotePlace, new: Path, files: Iterable[str], sizes: Mapping[str, int]) -> bool:
    """Return whether a version has all files by their sizes, and the local ones by their tags."""
    there = list_objects(version)
    return all(there.get(name, {}).get("size") == size for name, size in sizes.items()) and all(
        _is_tagged(there[name], new / name) is not False for name in files
    )


def _is_tagged(entry: Mapping[str, Any], file: Path) -> bool | None:
    """Return whether an object's tag is the MD5 of a file, as on S3; None if the tag is no MD5.

    The object may equal the file even if the tag differs: S3 tags encrypted objects otherwise.
    """
    tag = str(entry.get("ETag", "")).strip('"')
    if not _MD5.fullmatch(tag):
        return None
    with file.open("rb") as content:
        if "-" not in tag:
            return tag == hashlib.file_digest(content, "md5").hexdigest()
        # After an upload in parts, the tag is the MD5 of the parts' MD5 digests.
        parts = [hashlib.md5(part) for part in iter(partial(content.read, PART_BYTES), b"")]
    whole = hashlib.md5(b"".join(part.digest() for part in parts))
    return tag == f"{whole.hexdigest()}-{len(parts)}"


_OWN = (versions.VERSIONS, versions.MANIFESTS, versions.SPOOL)
"""Folders below a store."""


def _is_ours(name: str) -> bool:
    """Return whether an object below a store is part of a version, its records or the spool."""
    kind, _, rest = name.partition("/")
    return _is_of_version(name) or (kind == versions.SPOOL and versions.is_spooled(rest))


def _is_of_version(name: str, but: Iterable[str] = ()) -> bool:
    """Return whether an object below a store is part of a version or its records."""
    kind, _, rest = name.partition("/")
    own, kinds = rest.partition("/")[0], (versions.VERSIONS, versions.MANIFESTS)
    return kind in kinds and versions.is_version_name(own) and own not in but

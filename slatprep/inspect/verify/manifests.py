"""Verify the manifests beside a store, ``assets.jsonl`` and ``build.json``, against it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace

import orjson

from slatprep.errors import StoreError
from slatprep.inspect.verify.assets import fault_findings
from slatprep.pipeline.rewrite import APART, NO_ROOT
from slatprep.provenance.files import ASSETS, BUILD, build_in, build_text, lines_in
from slatprep.provenance.record import AssetRecord
from slatprep.provenance.record_json import (
    RecordError,
    RecordText,
    build_id_of,
    counting,
    digest_of,
    read_build_record,
    read_record,
    to_json,
)
from slatprep.provenance.stored import StoredRecords
from slatprep.readers.published import locate_grids
from slatprep.records import Place, SourceRoots, Status
from slatprep.storage.documents import parse_document
from slatprep.store.contract import Finding
from slatprep.store.reader import Store


def source_roots(manifests: Place | None) -> SourceRoots:
    """Return the roots of the sources when the store was built.

    Raises StoreError if no record names them, or they do not exist any more.
    """
    advice = "name the roots with --pixieverse and --slat"
    if manifests is None:
        raise StoreError(f"no records beside the store say where its sources lie; {advice}")
    try:
        build = build_in(manifests)
        slat = build.parameters.slat.root
        slat = slat.parent if slat.is_file() else slat
        sources = build.parameters.pixieverse, *build.parameters.also
        roots = *(source.root for source in sources), slat
        gone = [root for root in roots if not root.exists()]
    except (OSError, StoreError) as error:
        raise StoreError(f"{manifests / BUILD}: names no sources ({error}); {advice}") from None
    if not gone:
        first, *also = [
            SourceRoots(locate_grids(source), slat, adapter=source.adapter, number=number)
            for number, source in enumerate(sources)
        ]
        return replace(first, also=tuple(also))
    text = str(build.parameters.pixieverse.root)
    if APART in text:
        raise StoreError(
            f"{manifests / BUILD}: the store was joined of others, whose sources lie apart "
            f"({text}); verify those, or {advice} of one folder with all sources"
        )
    if text == NO_ROOT:
        raise StoreError(f"{manifests / BUILD}: does not say where its sources are; {advice}")
    raise StoreError(f"{manifests / BUILD}: its sources are not at {gone[0]} any more; {advice}")


def moved(roots: SourceRoots, manifests: Place | None) -> SourceRoots:
    """Return roots that were moved since the build, with the adapters that its record names."""
    try:
        build = None if manifests is None else build_in(manifests).parameters
    except StoreError:
        build = None  # It is named with the records.
    if build is None:
        return roots
    sources = zip((roots, *roots.also), (build.pixieverse, *build.also), strict=False)
    first, *also = [
        replace(
            one,
            adapter=source.adapter,
            pixieverse=locate_grids(replace(source, root=one.pixieverse)),
        )
        for one, source in sources
    ]
    return replace(first, also=tuple(also))


def manifest_findings(
    store: Store, folder: Place, only: Collection[str] | None = None
) -> Iterator[Finding]:
    """Yield findings where the records break their schemas or disagree with the store.

    With a sample of ids, `only`, records of other assets are not read, and the records' id and
    statuses are not compared.
    """
    build_file, assets_file = str(folder / BUILD), str(folder / ASSETS)
    manifest, build = store.attributes.get("manifest"), None
    try:
        text = build_text(folder)
        build = read_build_record(text, build_file)
        build_id: object = build.id
    except RecordError as error:
        yield from fault_findings(build_file, "", error)
        build_id = _stated_id(text)
    except StoreError as error:
        yield Finding(build_file, "", str(error), "the record of the build")
        build_id = manifest
    if build_id != manifest:
        yield Finding(build_file, "", f"id is {build_id!r}", f"{manifest!r}, the store's")
        return
    seen: Counter[str] = Counter({str(status): 0 for status in Status})
    faults: list[Finding] = []
    try:
        found: object = build_id_of(list(_checked(store, folder, seen, faults, only)))
        if only is not None:
            found = manifest
    except StoreError as error:
        yield Finding(assets_file, "", str(error), "a JSON record a line")
        return
    yield from faults
    if found != manifest:
        yield Finding(assets_file, "", f"its content has the id {found}", f"{manifest}")
    if only is not None and not faults and seen[Status.OK] != len(only):
        what = f"has {seen[Status.OK]} records of {len(only)} assets"
        yield Finding(assets_file, "", what, "one of each")
    if only is None and build and build.statuses != dict(seen):
        yield Finding(build_file, "", f"statuses are {build.statuses}", f"{dict(seen)}")
    if build and build.counts.voxels != store.shape("voxel/coords")[0]:
        yield Finding(build_file, "", "counts other voxels", f"{store.shape('voxel/coords')[0]}")


def _stated_id(text: bytes) -> object:
    """Return the id in a faulty build record, if it can be parsed."""
    try:
        document = orjson.loads(text)
    except ValueError:
        return None
    return document.get("id") if isinstance(document, dict) else None


def _checked(
    store: Store,
    folder: Place,
    seen: Counter[str],
    faults: list[Finding],
    only: Collection[str] | None,
) -> Iterator[tuple[str, bytes]]:
    """Yield the ids and digests of ``assets.jsonl``; count statuses and collect faults.

    A record that agrees with the store's copy in its row is skipped: verifying the row covers it.
    """
    rows = {asset_id: row for row, asset_id in enumerate(store.ids)}
    stored = StoredRecords(store)
    file = str(folder / ASSETS)
    for where, line in lines_in(folder):
        if only is not None and _id_in(line) not in only:
            continue
        if (text := _as_stored(line, rows, stored)) is not None:
            seen[str(Status.OK)] += 1
            yield text.asset_id, digest_of(text)
            continue
        try:
            record = read_record(line, where)
        except RecordError as error:
            faults += fault_findings(file, where.removeprefix(f"{file}, "), error)
            continue
        seen[str(record.status)] += 1
        if isinstance(record, AssetRecord):
            row = rows.get(record.asset_id)
            if row is None or not _same(record, stored, row):
                what = "differs from asset/record"
                faults.append(Finding(file, record.asset_id, what, "the same record"))
        yield record.asset_id, digest_of(record)


def _as_stored(line: bytes, rows: Mapping[str, int], stored: StoredRecords) -> RecordText | None:
    """Return a line if it equals the store's record of its row, else None."""
    try:
        document = orjson.loads(line)
        content, asset_id = counting(document), str(document.get("asset_id"))
        row = rows.get(asset_id)
        same = row is not None and stored.text(row).encode() == content
        return RecordText(asset_id, line, content) if same else None
    except (TypeError, ValueError, StoreError):  # No JSON object, or no text that can be read.
        return None


def _id_in(line: bytes | str) -> object:
    try:
        return parse_document(line).get("asset_id")
    except ValueError:
        return None


def _same(record: AssetRecord, stored: StoredRecords, row: int) -> bool:
    try:
        return to_json(record.without_duration()) == to_json(stored.read(row))
    except StoreError:
        return False

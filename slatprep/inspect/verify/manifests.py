"""Verify the manifests beside a store, ``assets.jsonl`` and ``build.json``, against it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest

import orjson

from slatprep.errors import StoreError
from slatprep.inspect.verify.assets import fault_findings
from slatprep.pipeline.join import APART, NO_ROOT
from slatprep.pipeline.publish import counts_in
from slatprep.pipeline.recipe import origin
from slatprep.readers.published import locate_grids
from slatprep.records import Place, SourceRoots, Status
from slatprep.storage.place import storage_of
from slatprep.store.contract import Finding
from slatprep.store.layout import RECORDS_IN_SHARD
from slatprep.store.reader import Store
from slatprep.store.record import BuildRecord
from slatprep.store.record_json import RecordError, read_record
from slatprep.store.records import BUILD, build_in, build_text, file_names, lines_of
from slatprep.store.shard_reader import UnreachableError

_MOST_LINES = 8

_OWN = "the store's: name the folder of its records with --manifests, or build again"


def source_roots(manifests: Place | None) -> Sequence[SourceRoots]:
    """Return the roots of each source at the time of the build.

    Raises StoreError if no record names them, or they no longer exist.
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
        named = [SourceRoots(one.root, slat, number=k) for k, one in enumerate(sources)]
        return moved(named, manifests)
    text = str(build.parameters.pixieverse.root)
    if APART in text:
        raise StoreError(
            f"{manifests / BUILD}: the store was joined of others, whose sources lie apart "
            f"({text}); verify those, or {advice} of one folder with all sources"
        )
    if text == NO_ROOT:
        raise StoreError(f"{manifests / BUILD}: does not say where its sources are; {advice}")
    raise StoreError(f"{manifests / BUILD}: its sources are not at {gone[0]} any more; {advice}")


def moved(roots: Sequence[SourceRoots], manifests: Place | None) -> Sequence[SourceRoots]:
    """Return moved roots, with adapters, units and plausibility as the build's record says."""
    try:
        build = None if manifests is None else build_in(manifests).parameters
    except StoreError:
        build = None  # `manifest_findings` reports the fault.
    if build is None:
        return roots
    sources = zip(roots, (build.pixieverse, *build.also), strict=False)
    return [
        replace(
            one,
            adapter=source.adapter,
            units=source.units,
            plausibility=source.plausibility,
            pixieverse=locate_grids(replace(source, root=one.pixieverse)),
        )
        for one, source in sources
    ]


def manifest_findings(
    store: Store, folder: Place, rows: Sequence[int] | None = None
) -> Iterator[Finding]:
    """Yield findings where the manifests differ from the store's records.

    With a sample of rows, files of lines without any of these rows are not read.
    """
    names = file_names(len(store))
    shards: Sequence[int] = range(len(names))
    if rows is not None:
        shards = sorted({row // RECORDS_IN_SHARD for row in rows})
    file, manifest = str(folder / BUILD), store.attributes.get("manifest")
    try:
        text = build_text(folder)
        build = read_record(BuildRecord, text, file)
    except RecordError as error:
        yield from fault_findings(file, "", error)
        build_id = _stated_id(text)
        if build_id != manifest:
            yield Finding(file, "", f"id is {build_id!r}", f"{manifest!r}, {_OWN}")
            return
    except StoreError as error:
        yield Finding(file, "", str(error), "the record of the build")
    else:
        if build.id != manifest:
            yield Finding(file, "", f"id is {build.id!r}", f"{manifest!r}, {_OWN}")
            return
        try:
            claims = [claim for claim in _claims(build, store) if claim[1] != claim[2]]
        except UnreachableError:
            raise
        except StoreError:
            claims = []  # A column is damaged; a finding on its file reports it.
        for name, said, held in claims:
            yield Finding(file, "", f"{name} is {said!r}", f"{held!r}, as the store has")
    for shard in shards:
        yield from _line_findings(store, folder / names[shard], shard)


def _claims(build: BuildRecord, store: Store) -> Iterator[tuple[str, object, object]]:
    """Yield name, value in the record and value in the store of each entry that both have."""
    counts = counts_in(store)
    yield "verdicts", build.verdicts, counts["verdicts"]
    ok = build.statuses.get(str(Status.OK))
    yield "statuses/ok", ok, len(store)
    yield "counts/voxels", build.counts.voxels, store.shape("voxel/coords")[0]
    yield "counts/valid", build.counts.valid, counts["n_valid"]
    yield "counts/unphysical", build.counts.unphysical, counts["n_unphysical"]
    yield "counts/clipped", build.counts.clipped, counts["clipped"]
    yield "normalization", build.normalization, store.normalization
    said = {**origin(build.parameters, build.versions), "name": build.name}
    for name, value in store.attributes["build"].items():
        yield name, said.get(name), value


def _line_findings(store: Store, file: Place, shard: int) -> Iterator[Finding]:
    """Yield findings on the first lines of a file that differ from its shard of records."""
    try:
        expected = lines_of(store, shard)
        found = storage_of(file).read(len(expected))
    except UnreachableError:
        raise
    except StoreError:
        return  # The shard of records is damaged; a finding on its file reports it.
    except OSError as error:
        yield Finding(str(file), "", f"cannot be read ({error.strerror})", "records, a line each")
        return
    if found == expected:
        return
    lines = zip_longest(found.split(b"\n"), expected.split(b"\n")[:-1])
    wrong = [number for number, (one, other) in enumerate(lines, 1) if other not in (one, None)]
    for number in wrong[:_MOST_LINES]:
        row = shard * RECORDS_IN_SHARD + number - 1
        what = f"line {number} differs from asset/record"
        yield Finding(str(file), store.ids[row], what, "the same record")
    if not wrong:
        yield Finding(str(file), "", "goes on behind the last record", f"{len(expected)} bytes")


def _stated_id(text: bytes) -> object:
    """Return the id in a faulty build record, if it can be parsed."""
    try:
        document = orjson.loads(text)
    except ValueError:
        return None
    return document.get("id") if isinstance(document, dict) else None

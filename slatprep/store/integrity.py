"""The files of a store: their metadata against the contract, their bytes against the digests."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from slatprep.errors import StoreError
from slatprep.records import Place
from slatprep.storage.files import LINK, file_digest
from slatprep.storage.place import storage_of
from slatprep.store.attributes import read_attributes, width_findings
from slatprep.store.contract import Finding, array_findings, dimension_sizes, read_metadata
from slatprep.store.digests import ATTRIBUTES, attributes_digest
from slatprep.store.gate import GROUPS, form_findings, gate_findings
from slatprep.store.layout import ARRAYS, FILE, MERGED
from slatprep.store.reader import Store
from slatprep.workers.local import Jobs, run_unordered


def metadata_findings(path: Place) -> Iterator[Finding]:
    """Yield where the metadata differ from the contract, or their two copies from each other."""
    root = read_metadata(path / "zarr.json")
    said = read_attributes(root["attributes"])
    yield from said if isinstance(said, tuple) else ()
    extra = {key: root.get(key) for key in ("zarr_format", "node_type")}
    if extra != {"zarr_format": 3, "node_type": "group"}:
        yield Finding("zarr.json", "", f"says {extra}", "a group of Zarr format 3")
    gathered = root.get("consolidated_metadata")
    copies = gathered.get("metadata") if isinstance(gathered, dict) else None
    frame = {**gathered, "metadata": 0} if isinstance(gathered, dict) else None
    if not isinstance(copies, dict) or frame != _CONSOLIDATED:
        yield Finding("zarr.json", "", "has no consolidated metadata", "those of every array")
        copies = {}
    if not isinstance(said, tuple):
        yield from width_findings(said, copies)
    arrays: dict[str, Any] = {}
    files = storage_of(path).files()
    present = {name.removesuffix("/zarr.json") for name in files if name.endswith("/zarr.json")}
    for name, copy in copies.items():
        yield from gate_findings(name, copy)
    for name in sorted({*present, *copies, *(layout.name for layout in ARRAYS), *GROUPS}):
        where = f"{name}/zarr.json"
        if name not in present:
            yield Finding(where, "", "is missing", "the metadata of an array or group")
            continue
        try:
            arrays[name] = read_metadata(path / where)
        except StoreError as error:
            yield Finding(where, "", str(error), "readable metadata")
            continue
        yield from gate_findings(name, arrays[name])
        yield from form_findings(name, arrays[name])
        if not _same(arrays[name], copies.get(name)):
            yield Finding(where, "", "differs from its copy in zarr.json", "the same metadata")
    try:
        sizes = dimension_sizes(arrays)
    except StoreError as error:
        yield Finding("zarr.json", "", str(error), "shapes of the arrays")
        return
    merged = [layout.name for layout in MERGED if layout.name in arrays]
    if len(merged) == 1:
        both = " and ".join(layout.name for layout in MERGED)
        yield Finding("zarr.json", "", f"has {merged[0]} alone", f"{both}, or neither")
    for layout in (*ARRAYS, *MERGED):
        if layout.name in arrays:
            yield from array_findings(layout.name, arrays[layout.name], sizes)


def file_findings(store: Store, jobs: Jobs, below: str = "") -> tuple[int, set[Finding]]:
    """Compare every file of a store, or those whose names begin with `below`, with its digest.

    Of the others the sizes are compared. Returns how many files the store has, those of the digests
    themselves included, and what is missing, additional or changed.
    """
    try:
        names, sizes, digests = (
            store.read_rows(f"file/{name}", 0, store.shape("file/name")[0])
            for name in ("name", "size", "sha256")
        )
    except StoreError as error:
        return 0, {Finding("file", "", str(error), "a digest of every file")}
    expected = {str(n): (int(s), str(d)) for n, s, d in zip(names, sizes, digests, strict=True)}
    findings = set()
    attributes = expected.pop(ATTRIBUTES, (0, ""))
    if attributes_digest(store.attributes) != attributes[1]:
        findings.add(Finding("zarr.json", "", "the attributes changed", f"SHA-256 {attributes[1]}"))
    files = storage_of(store.path).files()
    # The root's metadata and the arrays of digests have no digest themselves.
    present = {name for name in files if name != "zarr.json" and not name.startswith(f"{FILE}/")}
    for name in present - expected.keys():
        findings.add(Finding(name, "", "belongs to no array", "no such file"))
    for name in expected.keys() - present:
        findings.add(Finding(name, "", "is missing", f"a file of {expected[name][0]} bytes"))
    places = {digest: name for name, (_, digest) in expected.items()}
    both = sorted(present & expected.keys())
    common = [name for name in both if name.startswith(below) or files[name] != expected[name][0]]
    tasks = ((store.path, name, files[name], *expected[name]) for name in common)
    for name, what, digest in _compared(tasks, jobs):
        if what:
            if digest in places:
                what = f"holds what belongs in {places[digest]}"
            findings.add(Finding(name, "", what, f"SHA-256 {expected[name][1]}"))
    return len(files), findings


def _compared(
    tasks: Iterable[tuple[Place, str, int, int, str]], jobs: Jobs
) -> Iterator[tuple[str, str, str]]:
    if not isinstance(jobs, int):
        yield from run_unordered(_compare, tasks, jobs)
        return
    # Hashing releases the interpreter lock, and a process would take longer to start.
    with ThreadPoolExecutor(jobs) as pool:
        yield from pool.map(lambda task: _compare(*task), tasks)


def _compare(path: Place, name: str, found: int, size: int, digest: str) -> tuple[str, str, str]:
    """Return a file's name, what is wrong with it, and its digest."""
    if found < 0:
        return name, "is a link" if found == LINK else "is no regular file", ""
    if found != size:
        how = "was cut short" if found < size else "was extended"
        return name, f"{how}: it has {found} of {size} bytes", ""
    try:
        actual = file_digest(path / name)
    except OSError as error:
        return name, f"cannot be read ({error.strerror})", ""
    return name, "" if actual == digest else "its bytes changed", actual


_CONSOLIDATED = {"kind": "inline", "must_understand": False, "metadata": 0}


def _same(own: Mapping[str, Any], copy: object) -> bool:
    """Whether metadata equal their consolidated copy; groups may repeat an empty consolidation."""
    if not isinstance(copy, dict):
        return False
    left, right = ({**one, "consolidated_metadata": None} for one in (own, copy))
    nested = [one.get("consolidated_metadata") for one in (own, copy)]
    if any(one not in (None, {**_CONSOLIDATED, "metadata": {}}) for one in nested):
        return False
    # A fill value of NaN does not equal its copy, but is written like it.
    return left == right or repr(left) == repr(right)

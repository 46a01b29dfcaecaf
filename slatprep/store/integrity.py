"""Check the files of a store: their metadata by the contract, their bytes by the store's digests.

``file/name``, ``file/size`` and ``file/sha256`` describe each file as it was when the store was
finished. They leave out the root's ``zarr.json``, and themselves, as they carry checksums of their
own. From the root's ``zarr.json`` they hold the digest of the attributes, under `ATTRIBUTES`; the
rest of it repeats the ``zarr.json`` of the arrays.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.records import Place
from slatprep.storage.files import LINK, file_digest, local_files
from slatprep.storage.place import storage_of
from slatprep.store.attributes import read_attributes, width_findings
from slatprep.store.contract import (
    GROUPS,
    Finding,
    array_findings,
    dimension_sizes,
    form_findings,
    gate_findings,
    read_metadata,
)
from slatprep.store.layout import ARRAYS, FILE, FILES, MERGED
from slatprep.store.reader import Store
from slatprep.store.shard_reader import UnreachableError, is_out_of_reach
from slatprep.store.shard_writer import Written
from slatprep.workers.local import Jobs, run_unordered

ATTRIBUTES = "zarr.json#attributes"
"""Name under which the digest of the root's attributes is kept."""


def write_digests(
    path: Path,
    known: Mapping[str, str] = MappingProxyType({}),
    elsewhere: Mapping[str, int] = MappingProxyType({}),
) -> None:
    """Add the digests of all files to a store that is otherwise complete.

    Files that belong to no array are removed first. The root's attributes must be written, and the
    metadata must not be consolidated yet. `known` has digests of files that need not be read again.
    `elsewhere` has the sizes [byte] of files that already lie at the final place. StoreError if a
    file of an array is missing.
    """
    root = open_for_writing(path)
    meant = dict(_files_of(root))
    for name in local_files(path).keys() - meant.keys() - {"zarr.json"}:
        (path / name).unlink()
    there = {name: (path / name).stat().st_size for name in meant if (path / name).exists()}
    there |= {name: size for name, size in elsewhere.items() if name in meant}
    for name in meant.keys() - there.keys():
        if meant[name]:
            raise StoreError(f"{path / name}: was not written; nothing was replaced. Run again")
    names = sorted(there)
    sizes = [there[name] for name in names]
    digests = [known.get(name) or file_digest(path / name) for name in names]
    attributes = dict(root.attrs)
    names.append(ATTRIBUTES)
    sizes.append(len(_canonical(attributes)))
    digests.append(attributes_digest(attributes))
    # The rows are small: one chunk holds even those of a large store.
    columns = (np.array(names, object), np.array(sizes, np.int64), np.array(digests, object))
    for layout, values in zip(FILES, columns, strict=True):
        add_array(root, layout.name, values, "file", layout.description, level=1)


def open_for_writing(path: Path) -> Any:
    """Open a new store's root, without its consolidated metadata."""
    import zarr

    return zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)


def attributes_digest(attributes: Mapping[str, Any]) -> str:
    """Return the SHA-256 of attributes, in hex; the layout of their JSON has no effect."""
    return hashlib.sha256(_canonical(attributes)).hexdigest()


def _files_of(root: Any) -> Iterator[tuple[str, bool]]:
    """Yield each file that a store may have by its metadata, and whether it must exist."""
    for path, node in root.members(max_depth=None):
        yield f"{path}/zarr.json", True
        if hasattr(node, "chunks"):  # not a group
            rows = (node.shards or node.chunks)[0]
            for number in range(-(-node.shape[0] // rows)):
                key = node.metadata.encode_chunk_key((number,) + (0,) * (node.ndim - 1))
                # Zarr writes no file for fill values alone, such as a column of empty strings.
                yield f"{path}/{key}", not path.startswith("asset/")


def _canonical(attributes: Mapping[str, Any]) -> bytes:
    return json.dumps(attributes, sort_keys=True, ensure_ascii=False).encode()


def add_array(
    group: Any, name: str, values: NDArray[Any], dimension: str, description: str, level: int = 0
) -> None:
    """Add a small array (N,) of numbers, or of strings (dtype object), in one chunk."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    array = group.create_array(
        name,
        shape=values.shape,
        dtype=str if values.dtype == object else values.dtype.name,
        compressors=(ZstdCodec(level=level), Crc32cCodec()),
        chunks=values.shape,
        dimension_names=(dimension,),
        attributes={"description": description},
    )
    array[:] = values


def metadata_findings(path: Place) -> Iterator[Finding]:
    """Yield differences of the metadata from the contract, and between their two copies."""
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
        except UnreachableError:
            raise
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
            yield from array_findings(layout, arrays[layout.name], sizes)


def digests_in(store: Store) -> dict[str, Written]:
    """Return the size and SHA-256 that a store holds of each of its files, by name."""
    files = store.shape(f"{FILE}/name")[0]
    columns = (store.read_rows(layout.name, 0, files).tolist() for layout in FILES)
    return {name: Written(*told) for name, *told in zip(*columns, strict=True)}


def file_findings(store: Store, jobs: Jobs, below: str = "") -> tuple[int, set[Finding]]:
    """Compare every file of a store, or each whose name begins with `below`, with its digest.

    Other files are compared by size. Return the number of files of the store, including those of
    the digests, and findings on missing, additional and changed files.
    """
    try:
        expected = digests_in(store)
    except UnreachableError:
        raise
    except StoreError as error:
        return 0, {Finding("file", "", str(error), "a digest of every file")}
    findings = set()
    attributes = expected.pop(ATTRIBUTES, Written(0, "")).sha256
    if attributes_digest(store.attributes) != attributes:
        findings.add(Finding("zarr.json", "", "the attributes changed", f"SHA-256 {attributes}"))
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
    """Return a file's name, its fault (empty if there is none), and its digest."""
    if found < 0:
        return name, "is a link" if found == LINK else "is no regular file", ""
    if found != size:
        how = "was cut short" if found < size else "was extended"
        return name, f"{how}: it has {found} of {size} bytes", ""
    try:
        actual = file_digest(path / name)
    except OSError as error:
        if is_out_of_reach(path, error):
            raise UnreachableError(path, name, str(error.strerror)) from None
        return name, f"cannot be read ({error.strerror})", ""
    return name, "" if actual == digest else "its bytes changed", actual


_CONSOLIDATED = {"kind": "inline", "must_understand": False, "metadata": 0}


def _same(own: Mapping[str, Any], copy: object) -> bool:
    """Return whether metadata equal their copy; groups may have an empty consolidation."""
    if not isinstance(copy, dict):
        return False
    left, right = ({**one, "consolidated_metadata": None} for one in (own, copy))
    nested = [one.get("consolidated_metadata") for one in (own, copy)]
    if any(one not in (None, {**_CONSOLIDATED, "metadata": {}}) for one in nested):
        return False
    # A fill value of NaN does not equal its copy, but has the same repr.
    return left == right or repr(left) == repr(right)

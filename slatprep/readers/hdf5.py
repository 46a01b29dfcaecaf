"""Safe reading of HDF5: nothing outside the file, nothing before its size is known.

An HDF5 file can point elsewhere in several ways: soft and external links,
virtual datasets, external raw storage. All are refused, as are filters that
would inflate without bound.
"""

from __future__ import annotations

import hashlib
import math
import zlib
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.readers.files import ArraySpec, load_source, resolve_inside
from slatprep.readers.patterns import component_regex
from slatprep.records import SourceFile

if TYPE_CHECKING:
    import h5py

SUFFIXES = (".h5", ".hdf5")

_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF = 1, 2, 3, 32000
_MAX_CHUNKS = 65_536
_MAX_CHUNK_BYTES = 2**26
_MAX_LZF_CHUNK_BYTES = 2**21  # LZF inflates 90 times at most

# What h5py raises for files that are damaged.
HDF5_ERRORS = (
    OSError,
    RuntimeError,
    KeyError,
    ValueError,
    TypeError,
    AttributeError,
    OverflowError,
    MemoryError,
)


def load_datasets(
    path: Path, root: Path, group: str, specs: Mapping[str, ArraySpec]
) -> tuple[dict[str, NDArray[Any]], SourceFile]:
    """Read the named datasets of a group, and hash the file.

    Parameters
    ----------
    path, root : Path
        The file, and the folder that it must not leave.
    group : str
        Group with the datasets; empty for a file that holds one asset.
    specs : mapping of str to ArraySpec
        The datasets wanted and what they may look like.

    Raises
    ------
    InputError
        If the file cannot be read or a dataset is missing or not as wanted.
    """
    import h5py

    try:
        if group:
            source = _hash_shared(path, root)
            file = h5py.File(path, "r", locking=False)
        else:
            data, source = load_source(path, root, "slat")
            file = h5py.File(h5py.h5f.open_file_image(data))
        with file:
            holder = file
            for name in filter(None, group.split("/")):
                holder = _child(holder, name, f"{path} [{group}]", h5py.Group, "group")
            arrays = {}
            for name, spec in specs.items():
                where = f"{path} [{'/'.join(filter(None, (group, name)))}]"
                dataset = _child(holder, name, where, h5py.Dataset, "dataset")
                arrays[name] = _read_dataset(dataset, where, spec)
    except HDF5_ERRORS as error:
        raise InputError(
            f"{path} [{group}]" if group else path,
            f"is no readable HDF5 file ({_reason(error)})",
            f"an intact HDF5 file with datasets {', '.join(specs)}; copy or make it again",
        ) from None
    return arrays, source


def find_groups(
    path: Path, root: Path, pattern: str, known: Mapping[str, str]
) -> Iterator[tuple[dict[str, str], str]]:
    """Find the groups of a file whose names match a pattern such as ``{id}/{view}``.

    Parameters
    ----------
    path, root : Path
        The file, and the folder that it must not leave.
    pattern : str
        Group names by levels; see `slatprep.readers.patterns`.
    known : mapping of str to str
        Fields that are settled already.

    Yields
    ------
    tuple of dict and str
        The fields of a match, and the group's name.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    import h5py

    resolved, _ = resolve_inside(path, root)
    try:
        with h5py.File(resolved, "r", locking=False) as file:
            yield from _walk_groups(file, pattern.strip("/").split("/"), dict(known), "")
    except HDF5_ERRORS as error:
        raise InputError(
            path, f"is no readable HDF5 file ({_reason(error)})", "groups named by asset"
        ) from None


def _walk_groups(
    group: h5py.Group, components: list[str], known: dict[str, str], prefix: str
) -> Iterator[tuple[dict[str, str], str]]:
    import h5py

    regex = component_regex(components[0], known)
    for name in group:
        match = regex.fullmatch(name)
        if (
            match
            and group.id.links.get_info(name.encode()).type == h5py.h5l.TYPE_HARD
            and isinstance(group[name], h5py.Group)
        ):
            fields = known | match.groupdict()
            if len(components) == 1:
                yield fields, prefix + name
            else:
                yield from _walk_groups(group[name], components[1:], fields, f"{prefix}{name}/")


def _child(parent: h5py.Group, name: str, where: str, kind: type, kind_name: str) -> Any:
    import h5py

    key = name.encode()
    # Asking h5py itself whether a name exists would follow an external link.
    if not parent.id.links.exists(key):
        raise InputError(where, f"has no {kind_name} {name!r}", "coords and feats of one asset")
    if parent.id.links.get_info(key).type != h5py.h5l.TYPE_HARD:
        raise InputError(
            where, f"{name!r} is a soft or external link", f"the {kind_name} itself in the file"
        )
    child = parent[name]
    if not isinstance(child, kind):
        raise InputError(where, f"{name!r} is no {kind_name}", f"a {kind_name}")
    return child


def _read_dataset(dataset: h5py.Dataset, where: str, spec: ArraySpec) -> NDArray[Any]:
    expected = "a dataset whose values lie in the file"
    if dataset.shape is None:
        raise InputError(where, "has no values", expected)
    spec.check(where, dataset.shape, dataset.dtype)
    if dataset.is_virtual:
        raise InputError(where, "is a virtual dataset, which reads other files", expected)
    if dataset.id.get_create_plist().get_external_count():
        raise InputError(where, "keeps its values in another file", expected)
    if dataset.chunks is None:
        stored = dataset.id.get_storage_size()
        wanted = math.prod(dataset.shape) * dataset.dtype.itemsize
        if stored != wanted:
            raise InputError(
                where,
                f"holds {stored} of {wanted} bytes",
                "a completely written dataset; make it again",
            )
    else:
        _check_chunks(dataset, where)
    array: NDArray[Any] = dataset[()]
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _check_chunks(dataset: h5py.Dataset, where: str) -> None:
    """Raise InputError unless every chunk is there and inflates to a chunk's size."""
    properties = dataset.id.get_create_plist()
    filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
    packing = [code for code in filters if code in (_DEFLATE, _LZF)]
    if set(filters) - {_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF} or len(packing) > 1:
        raise InputError(
            where,
            f"uses HDF5 filters {filters}",
            "gzip or lzf, with or without shuffle and fletcher32",
        )
    chunk_bytes = math.prod(dataset.chunks) * dataset.dtype.itemsize
    wanted = math.prod(-(-n // c) for n, c in zip(dataset.shape, dataset.chunks, strict=True))
    if chunk_bytes > _MAX_CHUNK_BYTES or wanted > _MAX_CHUNKS:
        raise InputError(
            where,
            f"has {wanted} chunks of {chunk_bytes} bytes",
            f"at most {_MAX_CHUNKS} chunks of at most {_MAX_CHUNK_BYTES} bytes",
        )
    chunks: list[Any] = []
    dataset.id.chunk_iter(lambda info: chunks.append(info) if len(chunks) <= wanted else True)
    if len(chunks) != wanted:
        raise InputError(
            where,
            f"holds {len(chunks)} of {wanted} chunks",
            "a completely written dataset; make it again",
        )
    # A chunk that did not shrink is at most a little larger than its values.
    for chunk in chunks:
        inflated = chunk.size
        if packing == [_DEFLATE] and chunk.size <= chunk_bytes + 65_536:
            skipped, raw = dataset.id.read_direct_chunk(chunk.chunk_offset)
            if not skipped & (1 << filters.index(_DEFLATE)):
                inflated = len(zlib.decompressobj().decompress(raw, chunk_bytes + 5))
        if inflated > chunk_bytes + 4 or (packing == [_LZF] and chunk.size > _MAX_LZF_CHUNK_BYTES):
            raise InputError(
                where,
                f"the chunk at {chunk.chunk_offset} inflates beyond its {chunk_bytes} bytes",
                "chunks of the size that the dataset states",
            )


def _reason(error: BaseException) -> str:
    return str(error).splitlines()[0][:160] if str(error) else type(error).__name__


def _hash_shared(path: Path, root: Path) -> SourceFile:
    """Describe a file that many assets share; it is hashed once a process, not once an asset."""
    resolved, name = resolve_inside(path, root)
    state = resolved.stat()
    return SourceFile(
        "slat", name, state.st_size, _sha256(resolved, state.st_size, state.st_mtime_ns)
    )


@lru_cache(maxsize=64)
def _sha256(path: Path, size: int, mtime_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

"""Safe reading of HDF5: no link out of the file is followed, and every size is checked.

An HDF5 file can point elsewhere by soft and external links, virtual datasets and external raw
storage. This module refuses all of them. It also refuses filters that it cannot undo itself
within a bound.
"""

from __future__ import annotations

import hashlib
import math
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.readers.files import ArraySpec, refusing
from slatprep.readers.patterns import ASSET_ID, components_of, match
from slatprep.records import Place, SourceFile
from slatprep.storage.chunks import place_chunk
from slatprep.storage.files import file_name
from slatprep.storage.place import storage_of
from slatprep.storage.states import reading

if TYPE_CHECKING:
    import h5py

SUFFIXES = (".h5", ".hdf5")

_DEFLATE, _SHUFFLE, _FLETCHER32 = 1, 2, 3
_FILTER_NAMES = {_DEFLATE: "gzip", _SHUFFLE: "shuffle", _FLETCHER32: "fletcher32"}
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_UNREADABLE = "is no readable HDF5 file"
_EXPECTED = "an intact HDF5 file with datasets {}; copy or make it again"
_WRITTEN = "a completely written dataset; make it again"
_MAX_CHUNKS = 65_536
_MAX_CHUNK_BYTES = 2**26


def hdf5_arrays(
    data: bytes, where: Place, specs: Mapping[str, ArraySpec]
) -> dict[str, NDArray[Any]]:
    """Read the named datasets of an HDF5 file; errors call it `where`, see `group_arrays`."""
    import h5py

    begins = ": it begins as one, and may be cut off" if data.startswith(_SIGNATURE) else ""
    with (
        refusing(where, f"{_UNREADABLE}{begins}", _EXPECTED.format(", ".join(specs))),
        h5py.File(h5py.h5f.open_file_image(data)) as file,
    ):
        return group_arrays(file, where, "", specs)


def load_group(
    path: Place, root: Place, group: str, specs: Mapping[str, ArraySpec]
) -> tuple[dict[str, NDArray[Any]], SourceFile]:
    """Read the named datasets of a group of a file that many assets share, and hash the file.

    InputError if the file lies outside `root` or cannot be read, and as in `group_arrays`.
    """
    import h5py

    located, name = storage_of(root).locate(path)
    with (
        refusing(f"{path} [{group}]", _UNREADABLE, _EXPECTED.format(", ".join(specs))),
        h5py.File(storage_of(located).on_disk(), "r", locking=False) as file,
        reading(file.id.get_vfd_handle(), str(path)),
    ):
        source = _hash_shared(file.id.get_vfd_handle(), name)
        return group_arrays(file, path, group, specs), source


def group_name(asset_id: str) -> str:
    """Return the name of an asset's group: its id, encoded only if it is no plain name."""
    # Readers of latents take the name as the id. Other ids, such as "..", have a meaning in paths.
    return asset_id if ASSET_ID.fullmatch(asset_id) else file_name(asset_id)


def group_arrays(
    file: h5py.File,
    path: Place,
    group: str,
    specs: Mapping[str, ArraySpec],
    *,
    partial: bool = False,
) -> dict[str, NDArray[Any]]:
    """Read the named datasets of a group of an open file; errors call the file `path`.

    An empty `group` is the file's root. With `partial`, any dataset may be missing.
    InputError if a required dataset is missing, or a dataset is not as specified.
    """
    import h5py

    holder = file
    for name in filter(None, group.split("/")):
        holder = _child(holder, name, f"{path} [{group}]", h5py.Group, specs)
    arrays = {}
    for name, spec in specs.items():
        if partial and not holder.id.links.exists(name.encode()):
            continue
        where = f"{path} [{'/'.join(filter(None, (group, name)))}]"
        arrays[name] = _read_dataset(_child(holder, name, where, h5py.Dataset, specs), where, spec)
    return arrays


def find_groups(
    path: Place, root: Place, pattern: str, known: Mapping[str, str]
) -> Iterator[tuple[dict[str, str], str]]:
    """Yield fields and name of each group that matches a pattern such as ``{id}/{view}``.

    `known` holds fields that are fixed already. InputError if the file cannot be read.
    """
    import h5py

    file, _ = storage_of(root).locate(path)
    with (
        refusing(path, _UNREADABLE, "groups named by asset"),
        h5py.File(storage_of(file).on_disk(), "r", locking=False) as groups,
    ):
        yield from _walk_groups(groups, components_of(pattern.strip("/")), dict(known), "")


def _walk_groups(
    group: h5py.Group, components: tuple[str, ...], known: dict[str, str], prefix: str
) -> Iterator[tuple[dict[str, str], str]]:
    import h5py

    for key in group:
        # h5py gives bytes for a name that is not UTF-8.
        raw = key if isinstance(key, bytes) else key.encode()
        name = raw.decode(errors="surrogateescape")
        fields = match(components[0], known, name)
        if fields is None or group.id.links.get_info(raw).type != h5py.h5l.TYPE_HARD:
            continue
        if isinstance(inner := group[key], h5py.Group):
            if len(components) == 1:
                yield known | fields, prefix + name
            else:
                further = known | fields, f"{prefix}{name}/"
                yield from _walk_groups(inner, components[1:], *further)


def _child(parent: h5py.Group, name: str, where: str, kind: type, names: Iterable[str]) -> Any:
    import h5py

    word, links = kind.__name__.lower(), parent.id.links
    # Asking h5py itself whether a name exists would follow an external link.
    if not links.exists(name.encode()):
        raise InputError(where, f"has no {word} {name!r}", _EXPECTED.format(", ".join(names)))
    if links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        fault = f"{name!r} is a soft or external link"
        raise InputError(where, fault, f"the {word} itself in the file")
    child = parent[name]
    if not isinstance(child, kind):
        raise InputError(where, f"{name!r} is no {word}", f"a {word}")
    return child


def _read_dataset(dataset: h5py.Dataset, where: str, spec: ArraySpec) -> NDArray[Any]:
    import h5py

    expected = "a dataset whose values lie in the file"
    if dataset.shape is None:
        raise InputError(where, "has no values", expected)
    if dataset.dtype.hasobject:
        raise InputError(where, "is text, or has rows of several lengths", "numbers")
    spec.check(where, dataset.shape, dataset.dtype)
    if h5py.check_enum_dtype(dataset.dtype) is not None:
        raise InputError(where, "is an enumeration, with names of its own", "plain integers")
    if not dataset.id.get_type().equal(h5py.h5t.py_create(dataset.dtype)):
        raise InputError(where, "stores a number format of its own", "IEEE floats or integers")
    if dataset.is_virtual:
        raise InputError(where, "is a virtual dataset, which reads other files", expected)
    if dataset.id.get_create_plist().get_external_count():
        raise InputError(where, "keeps its values in another file", expected)
    if dataset.chunks is not None:
        array = _read_chunks(dataset, where)
    else:
        stored = dataset.id.get_storage_size()
        wanted = math.prod(dataset.shape) * dataset.dtype.itemsize
        if stored != wanted:
            # HDF5 reads missing chunks as zeros, which would pass as values.
            raise InputError(where, f"holds {stored} of {wanted} bytes", _WRITTEN)
        array = dataset[()].astype(dataset.dtype.newbyteorder("="), copy=False)
    spec.check_attributes(where, dataset.attrs, array)
    return array


def _read_chunks(dataset: h5py.Dataset, where: str) -> NDArray[Any]:
    """Read a chunked dataset chunk by chunk.

    This module undoes the filters: HDF5's own pipeline inflates without bound, and some damaged
    chunks crash it.
    """
    properties = dataset.id.get_create_plist()
    filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
    if set(filters) - _FILTER_NAMES.keys() or len(set(filters)) < len(filters):
        known = f"each at most once of {', '.join(_FILTER_NAMES.values())}"
        way = "h5repack -f GZIP=1 rewrites a file"
        raise InputError(where, f"uses HDF5 filters {filters}", f"{known}; {way}")
    dtype, steps = dataset.dtype, dataset.chunks
    chunk_bytes = math.prod(steps) * dtype.itemsize
    offsets = [range(0, n, step) for n, step in zip(dataset.shape, steps, strict=True)]
    wanted = math.prod(map(len, offsets))
    if chunk_bytes > _MAX_CHUNK_BYTES or wanted > _MAX_CHUNKS:
        most = f"at most {_MAX_CHUNKS} chunks of at most {_MAX_CHUNK_BYTES} bytes"
        raise InputError(where, f"has {wanted} chunks of {chunk_bytes} bytes", most)
    chunks: dict[tuple[int, ...], Any] = {}
    dataset.id.chunk_iter(lambda info: chunks.update({info.chunk_offset: info}))
    if chunks.keys() != set(product(*offsets)):
        fault = f"its {len(chunks)} chunks are not the {wanted} that cover it"
        raise InputError(where, fault, _WRITTEN)

    array = np.empty(dataset.shape, dtype.newbyteorder("="))
    for corner, chunk in chunks.items():
        # A chunk that did not shrink is only a little larger than its values.
        data = b""
        if chunk.size <= chunk_bytes + 65_536:
            skipped, raw = dataset.id.read_direct_chunk(corner)
            applied = [code for bit, code in enumerate(filters) if not skipped >> bit & 1]
            data = _undo(applied, raw, chunk_bytes, dtype.itemsize)
        if len(data) != chunk_bytes:
            fault = f"the chunk at {corner} is damaged: it does not unpack to {chunk_bytes} bytes"
            expected = "chunks of the size that the dataset states; copy or make the file again"
            raise InputError(where, fault, expected)
        place_chunk(array, corner, np.frombuffer(data, dtype).reshape(steps))
    return array


def _undo(filters: list[int], data: bytes, chunk_bytes: int, itemsize: int) -> bytes:
    """Undo HDF5 filters, last first, without inflating beyond a chunk; empty if that fails."""
    from numcodecs import Fletcher32, Shuffle

    for code in reversed(filters):
        if code == _DEFLATE:
            try:
                data = zlib.decompressobj().decompress(data, chunk_bytes + 5)
            except zlib.error:
                return b""
        elif code == _FLETCHER32 and len(data) > 4:
            data = bytes(Fletcher32().decode(data))
        elif code == _SHUFFLE and len(data) % itemsize == 0:
            data = bytes(Shuffle(itemsize).decode(data))
        else:
            return b""
    return data


def _hash_shared(descriptor: int, name: str) -> SourceFile:
    """Describe an open file that many assets share; its hash is computed once a process."""
    state = os.fstat(descriptor)
    known = state.st_dev, state.st_ino, state.st_mtime_ns, state.st_ctime_ns, state.st_size
    if known not in _DIGESTS:
        _DIGESTS[known] = _sha256(descriptor)
    return SourceFile("slat", name, state.st_size, _DIGESTS[known])


_DIGESTS: dict[tuple[int, ...], str] = {}
"""SHA-256 by state of each shared file that this process has hashed."""


def _sha256(descriptor: int) -> str:
    digest, at = hashlib.sha256(), 0
    while block := os.pread(descriptor, 2**20, at):  # pread leaves HDF5's position alone
        digest.update(block)
        at += len(block)
    return digest.hexdigest()

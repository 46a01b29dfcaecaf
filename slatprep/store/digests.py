"""Digests of a store's files, kept in the store.

``file/name``, ``file/size`` and ``file/sha256`` say what every file held when
the store was finished: all but the root's ``zarr.json`` and the three arrays
themselves, which carry checksums of their own. Of the root's ``zarr.json``
they hold the attributes' digest, under `ATTRIBUTES`; the rest of it repeats
the ``zarr.json`` of the arrays.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.storage.files import file_digest, local_files
from slatprep.store.layout import FILES

ATTRIBUTES = "zarr.json#attributes"
"""Name under which the digest of the root's attributes is kept."""


def write_digests(
    path: Path,
    known: Mapping[str, str] = MappingProxyType({}),
    elsewhere: Mapping[str, int] = MappingProxyType({}),
) -> None:
    """Add the digests of all files to a store that is otherwise complete.

    What no array accounts for is removed first. Root attributes are written, metadata not yet
    consolidated. `known` has digests of files that need not be read again, `elsewhere` the bytes of
    files that are not here, but where the store will lie. StoreError if a file of an array is
    missing.
    """
    import zarr

    root = zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
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
    # Row by row these are small; one chunk holds all of a large store's.
    columns = (np.array(names, object), np.array(sizes, np.int64), np.array(digests, object))
    for layout, values in zip(FILES, columns, strict=True):
        add_array(root, layout.name, values, "file", layout.description, level=1)


def attributes_digest(attributes: Mapping[str, Any]) -> str:
    """Return the SHA-256 of attributes, in hex, however their JSON is laid out."""
    return hashlib.sha256(_canonical(attributes)).hexdigest()


def _files_of(root: Any) -> Iterator[tuple[str, bool]]:
    """Yield the files of a store by its metadata, and whether each must be there."""
    for path, node in root.members(max_depth=None):
        yield f"{path}/zarr.json", True
        if hasattr(node, "chunks"):  # an array, no group
            rows = (node.shards or node.chunks)[0]
            for number in range(-(-node.shape[0] // rows)):
                key = node.metadata.encode_chunk_key((number,) + (0,) * (node.ndim - 1))
                # Zarr leaves out files of fill values alone, as a column of empty strings is.
                yield f"{path}/{key}", not path.startswith("asset/")


def _canonical(attributes: Mapping[str, Any]) -> bytes:
    return json.dumps(attributes, sort_keys=True, ensure_ascii=False).encode()


def add_array(
    group: Any, name: str, values: NDArray[Any], dimension: str, description: str, level: int = 0
) -> None:
    """Add a small array (N,) of numbers, or texts as objects, in one chunk."""
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

"""Read an array of an untrusted Zarr hierarchy without zarr-python.

zarr-python runs any codec that the metadata name, and allocates as much memory as a chunk claims
to hold. Here codecs are slatprep's own, and memory is bounded by the shape that is allowed.
"""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError, StoreError
from slatprep.readers.files import ArraySpec
from slatprep.storage.documents import read_document
from slatprep.storage.files import LINK, LocalFolder, local_files
from slatprep.store.codecs import ChunkDecoder
from slatprep.store.contract import MAX_METADATA_BYTES
from slatprep.store.shard_reader import BAD_METADATA, RowReader, whole_sizes

_DTYPES = (
    *(f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)),
    *(f"float{bits}" for bits in (16, 32, 64)),
)
_MAX_CHUNK_BYTES = 2**26
_MAX_CHUNKS = 4096


def read_array(path: Path, root: Path, spec: ArraySpec) -> NDArray[Any]:
    """Read a whole array of Zarr format 3.

    Parameters
    ----------
    path : Path
        Folder with its ``zarr.json``.
    root : Path
        The root of the hierarchy; no link may lead out of it.
    spec : ArraySpec
        Its allowed types and shapes.

    Returns
    -------
    ndarray
        All values.

    Raises
    ------
    StoreError
        If it is not such an array, is compressed with another codec than zstd or blosc, or is
        damaged.
    InputError
        If its type or shape are not those of `spec`, or a link leads out of `root`.
    """
    _refuse_links_out(path, root)
    try:
        metadata = read_document(path / "zarr.json", MAX_METADATA_BYTES)
        if metadata["zarr_format"] != 3 or metadata["node_type"] != "array":
            raise ValueError("no array of Zarr format 3")
        if metadata["data_type"] not in _DTYPES:
            raise ValueError(f"data_type is {metadata['data_type']!r}")
        dtype = np.dtype(metadata["data_type"])
        if metadata.get("storage_transformers"):
            raise ValueError(f"storage_transformers are {metadata['storage_transformers']!r}")
        shape = whole_sizes(metadata["shape"])
        spec.check(path, shape, dtype)
        if metadata["codecs"][0]["name"] == "sharding_indexed":
            return RowReader.of(LocalFolder(path.parent), path.name, metadata).read(0, shape[0])
        return _read_chunks(path, metadata, shape, dtype.newbyteorder("<"))
    except (*BAD_METADATA, OSError) as error:
        raise StoreError(f"{path}: {error!r}") from None


def _refuse_links_out(path: Path, root: Path) -> None:
    """Raise InputError if an array's folder, or anything in it, is a link out of the root."""
    whole = root.resolve()
    links = (path / name for name, size in local_files(path).items() if size == LINK)
    for place in (path, *links):
        if not place.resolve().is_relative_to(whole):
            raise InputError(place, f"leads to {place.resolve()}, out of its root", "a file in it")


def _read_chunks(
    path: Path, metadata: dict[str, Any], shape: tuple[int, ...], dtype: np.dtype[Any]
) -> NDArray[Any]:
    steps = whole_sizes(metadata["chunk_grid"]["configuration"]["chunk_shape"])
    decoder = ChunkDecoder.of(dtype, steps, metadata["codecs"], 0)
    corners = [range(0, n, step) for n, step in zip(shape, steps, strict=True)]
    chunks = math.prod(map(len, corners))
    # Chunks may have more rows than a short array, but no other axis longer than the array's.
    wide = any(step > n for step, n in zip(steps[1:], shape[1:], strict=True))
    if wide or chunks > _MAX_CHUNKS or not 0 < decoder.nbytes <= _MAX_CHUNK_BYTES:
        raise ValueError(f"{chunks} chunks of {steps}")
    keys = metadata["chunk_key_encoding"]
    separator = keys.get("configuration", {}).get("separator", "/")
    if keys["name"] != "default" or separator not in ("/", "."):
        raise ValueError(f"chunks named by {keys!r}")
    folder = LocalFolder(path)
    array = np.full(shape, metadata["fill_value"], dtype.newbyteorder("="))
    block = np.empty(steps, dtype)
    for corner in product(*corners):
        places = (start // step for start, step in zip(corner, steps, strict=True))
        try:
            file = folder.open(separator.join(["c", *map(str, places)]))
        except FileNotFoundError:
            continue  # Zarr omits chunks that hold only fill values.
        with file:
            # An incompressible chunk is only a little larger than its values.
            if file.size() > decoder.nbytes + 65_536:
                raise ValueError(f"a chunk of {file.size()} bytes")
            decoder.decode(file.pread(file.size(), 0), block)
        region = tuple(
            slice(start, min(start + step, n))
            for start, step, n in zip(corner, steps, shape, strict=True)
        )
        array[region] = block[tuple(slice(part.stop - part.start) for part in region)]
    return array

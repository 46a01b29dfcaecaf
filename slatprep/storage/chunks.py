"""Read a whole Zarr array of format 3 with one file per chunk.

zarr-python runs whatever codec the metadata name, and unpacks as much as a chunk claims to hold.
This module allows only the codecs of `slatprep.storage.codecs`, and allocates only what the array's
shape allows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.storage.codecs import ChunkDecoder

_DTYPES = (
    *(f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)),
    *(f"float{bits}" for bits in (16, 32, 64)),
)
MAX_CHUNK_BYTES = 2**26
_MAX_CHUNKS = 4096


def whole_sizes(sizes: object) -> tuple[int, ...]:
    """Return the sizes that metadata list; ValueError if one is negative or no integer."""
    if not isinstance(sizes, list) or not all(type(n) is int and n >= 0 for n in sizes):
        raise ValueError(f"sizes are {sizes!r}, not integers of at least 0")
    return tuple(sizes)


def array_form(metadata: Mapping[str, Any]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and dtype of an array by its ``zarr.json``.

    Raises ValueError or KeyError if it is not an array of numbers of Zarr format 3.
    """
    if metadata["zarr_format"] != 3 or metadata["node_type"] != "array":
        raise ValueError("no array of Zarr format 3")
    if metadata["data_type"] not in _DTYPES:
        raise ValueError(f"data_type is {metadata['data_type']!r}")
    if metadata.get("storage_transformers"):
        raise ValueError(f"storage_transformers are {metadata['storage_transformers']!r}")
    return whole_sizes(metadata["shape"]), np.dtype(metadata["data_type"])


def read_chunks(
    metadata: Mapping[str, Any], fetch: Callable[[str, int], bytes | None]
) -> NDArray[Any]:
    """Read an array of which each chunk is one file.

    `metadata` is its ``zarr.json``, whose shape the caller has checked. `fetch` returns the bytes
    of a chunk by its name, such as ``c/0/1``, and by their largest number; None without such a
    chunk. StoreError, ValueError or KeyError if the metadata make no sense, or a chunk contradicts
    them.
    """
    shape, native = array_form(metadata)
    dtype = native.newbyteorder("<")
    steps = whole_sizes(metadata["chunk_grid"]["configuration"]["chunk_shape"])
    decoder = ChunkDecoder.of(dtype, steps, metadata["codecs"], 0)
    corners = [range(0, n, step) for n, step in zip(shape, steps, strict=True)]
    chunks = math.prod(map(len, corners))
    # A writer may cut short arrays by the rows of long ones, but not rows wider than they are.
    wide = any(step > n for step, n in zip(steps[1:], shape[1:], strict=True))
    if wide or chunks > _MAX_CHUNKS or not 0 < decoder.nbytes <= MAX_CHUNK_BYTES:
        raise ValueError(f"{chunks} chunks of {steps}")
    keys = metadata["chunk_key_encoding"]
    separator = keys.get("configuration", {}).get("separator", "/")
    if keys["name"] != "default" or separator not in ("/", "."):
        raise ValueError(f"chunks named by {keys!r}")
    array = np.full(shape, metadata["fill_value"], native)
    block = np.empty(steps, dtype)
    for corner in product(*corners):
        places = (start // step for start, step in zip(corner, steps, strict=True))
        # A chunk that did not shrink is only a little larger than its values.
        data = fetch(separator.join(["c", *map(str, places)]), decoder.nbytes + 65_536)
        if data is None:
            continue  # Zarr leaves out chunks of fill values alone.
        decoder.decode(data, block)
        region = tuple(
            slice(start, min(start + step, n))
            for start, step, n in zip(corner, steps, shape, strict=True)
        )
        array[region] = block[tuple(slice(part.stop - part.start) for part in region)]
    return array

"""Undo the codecs of Zarr's chunks, and read whole arrays of format 3.

zarr-python runs whatever codec the metadata name, and unpacks as much as a chunk claims to hold.
This module allows a few codecs, and allocates what the array's shape allows. A chunk that claims to
hold more, or less, is refused before it is inflated.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from operator import add, lt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError

# CRC32C of any bytes followed by their own CRC32C, little-endian.
_CRC32C_RESIDUE = 0x48674BC7

_ZSTD_MAGIC = 0xFD2FB528
_BLOSC_HEADER = 16

MAX_TEXT_BYTES = 64 * 2**20
"""Largest unpacked chunk of strings [byte]; 65,536 ids take 3 MiB."""


@dataclass(frozen=True)
class ChunkDecoder:
    """The codecs of an array's chunks, if this module allows them.

    `dtype` is little-endian, as stored, and object for text; `shape` is that of a chunk. The
    `compressor` is ``blosc``, ``zstd`` or empty. A checksum ends each chunk if `crc32c`. The
    strings (``vlen-utf8``) of a chunk may have `text` bytes on average; it is 0 for numbers.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    compressor: str
    crc32c: bool
    text: int = 0

    @classmethod
    def of(
        cls,
        dtype: np.dtype[Any],
        shape: tuple[int, ...],
        codecs: Sequence[Mapping[str, Any]],
        max_text: int,
    ) -> ChunkDecoder:
        """Return the decoder for the codecs in a ``zarr.json``.

        Raises ValueError if the codecs, or their order, are not slatprep's.
        """
        text = max_text if dtype.hasobject else 0
        first, rest = codecs[0], [codec["name"] for codec in codecs[1:]]
        if first.get("configuration", {}).get("endian", "little") != "little":
            raise ValueError("it is big-endian")
        if first["name"] == ("vlen-utf8" if text else "bytes"):
            crc32c = rest[-1:] == ["crc32c"]
            compressors = rest[:-1] if crc32c else rest
            if compressors in ([], ["blosc"], ["zstd"]):
                return cls(dtype, shape, "".join(compressors), crc32c, text)
        raise ValueError(f"codecs {[first['name'], *rest]}")

    @cached_property
    def nbytes(self) -> int:
        """Size of a decoded chunk [byte]."""
        return math.prod(self.shape) * self.dtype.itemsize

    def decode(self, data: bytes, out: NDArray[Any]) -> None:
        """Decode a stored chunk into `out`, a C-order array of the chunk's shape and dtype.

        Raises StoreError if the checksum is wrong or the content contradicts the metadata.
        """
        payload = memoryview(data)
        if self.crc32c:
            if not crc32c_holds(data):
                raise StoreError("its checksum (CRC32C) is wrong")
            payload = payload[:-4]
        held = content_size(payload, self.compressor)
        try:
            if self.text:
                out[...] = self._strings(payload, held)
            elif held != out.nbytes:
                raise StoreError(f"it holds {held} bytes; expected {out.nbytes}")
            else:
                _unpack(payload, self.compressor, out)
        except (RuntimeError, ValueError, TypeError) as error:
            raise StoreError(f"it cannot be unpacked ({error})") from None

    def _strings(self, payload: memoryview, held: int) -> NDArray[Any]:
        from numcodecs import VLenUTF8

        limit = min(MAX_TEXT_BYTES, 4 + self.shape[0] * (4 + self.text))
        if not 4 <= held <= limit:
            raise StoreError(f"it holds {held} bytes; expected at most {limit}")
        text = np.empty(held, np.uint8)
        _unpack(payload, self.compressor, text)
        count = int(text[:4].view("<u4")[0])
        if count != self.shape[0]:
            raise StoreError(f"it holds {count} strings; expected {self.shape[0]}")
        return np.asarray(VLenUTF8().decode(text))


def crc32c(data: bytes | NDArray[np.uint8]) -> int:
    """Return the CRC32C of bytes (RFC 3720, section 12.1)."""
    import google_crc32c

    return int(google_crc32c.value(data))


def crc32c_holds(data: bytes) -> bool:
    """Return whether bytes end with the CRC32C of the bytes before."""
    return len(data) >= 4 and crc32c(data) == _CRC32C_RESIDUE


def content_size(data: memoryview | bytes, compressor: str) -> int:
    """Return how many bytes a compressed chunk claims to hold; -1 if it does not say.

    Zstandard's frame header is RFC 8878, section 3.1.1.1; blosc's has 16 bytes with the content's
    size in bytes 4 to 7.
    """
    try:
        if compressor == "blosc":
            nbytes, _, nbytes_packed = struct.unpack_from("<III", data, 4)
            # blosc trusts the size in its header, not the size of the data.
            return int(nbytes) if _BLOSC_HEADER <= nbytes_packed <= len(data) else -1
        if compressor == "zstd":
            magic, descriptor = struct.unpack_from("<IB", data)
            single, flag = bool(descriptor & 0x20), descriptor >> 6
            if magic != _ZSTD_MAGIC or (flag == 0 and not single):
                return -1
            at = 5 + (not single) + (0, 1, 2, 4)[descriptor & 3]
            size = int(struct.unpack_from("<" + "BHIQ"[flag], data, at)[0])
            return size + 256 if flag == 1 else size
    except struct.error:
        return -1
    return len(data)


def _unpack(payload: memoryview, compressor: str, out: NDArray[Any]) -> None:
    """Unpack into memory of the size that `content_size` gave."""
    if compressor == "blosc":
        single_threaded_blosc().decompress(payload, out)
    elif compressor == "zstd":
        from numcodecs import zstd

        zstd.decompress(payload, out)
    else:
        out.reshape(-1).view(np.uint8)[:] = np.frombuffer(payload, np.uint8)


@cache
def single_threaded_blosc() -> Any:
    """Return numcodecs' blosc, with its own threads turned off."""
    from numcodecs import blosc

    # Workers and training loaders are many processes already; a pool of threads in
    # each would slow them down, and does not survive a fork.
    blosc.use_threads = False
    return blosc


_DTYPES = (
    "bool",
    *(f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)),
    *(f"float{bits}" for bits in (16, 32, 64)),
)
MAX_CHUNK_BYTES = 2**26
_MAX_CHUNKS = 2**16

MISSING = 2**64 - 1
"""Offset and length, in a shard, of a chunk that was never written: it holds the fill value."""


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


def inner_chunks(
    codecs: Sequence[Mapping[str, Any]], outer: tuple[int, ...]
) -> tuple[tuple[int, ...], Sequence[Mapping[str, Any]], bool]:
    """Return shape and codecs of the chunks in a file, and whether it is a shard with an index.

    `outer` is the shape of what a file holds. ValueError if slatprep does not read such shards.
    """
    if codecs[0]["name"] != "sharding_indexed":
        return outer, codecs, False
    sharding = codecs[0]["configuration"]
    index_codecs = [codec["name"] for codec in sharding["index_codecs"]]
    at_end = sharding.get("index_location", "end") == "end"
    if index_codecs != ["bytes", "crc32c"] or not at_end or codecs[1:]:
        raise ValueError("shards with another index")
    return whole_sizes(sharding["chunk_shape"]), sharding["codecs"], True


def read_chunks(
    metadata: Mapping[str, Any],
    fetch: Callable[[str, int], bytes | None],
    missing: Callable[[str], None],
) -> NDArray[Any]:
    """Read an array of chunks, each in a file of its own or in a shard.

    `metadata` is its ``zarr.json``, whose shape the caller has checked. `fetch` takes the name of a
    file, such as ``c/0/1``, and the largest number of bytes; it returns the bytes, or None without
    such a file. `missing` is told each chunk that was never written, and may refuse it.
    StoreError, ValueError or KeyError if the metadata are invalid, or a chunk contradicts them.
    """
    shape, native = array_form(metadata)
    steps = whole_sizes(metadata["chunk_grid"]["configuration"]["chunk_shape"])
    inner, codecs, sharded = inner_chunks(metadata["codecs"], steps)
    decoder = ChunkDecoder.of(native.newbyteorder("<"), inner, codecs, 0)
    corners = [range(0, n, step) for n, step in zip(shape, steps, strict=True)]
    parts = [range(0, step, one) for step, one in zip(steps, inner, strict=True)]
    each = math.prod(map(len, parts))
    chunks = math.prod(map(len, corners)) * each
    # A writer may give a short array the chunk rows of long arrays, but no chunk may be wider.
    wide = any(step > n for step, n in zip(inner[1:], shape[1:], strict=True))
    uneven = any(step % one for step, one in zip(steps, inner, strict=True))
    if wide or uneven or chunks > _MAX_CHUNKS or not 0 < decoder.nbytes <= MAX_CHUNK_BYTES:
        raise ValueError(f"{chunks} chunks of {inner} in files of {steps}")
    keys = metadata["chunk_key_encoding"]
    separator = keys.get("configuration", {}).get("separator", "/")
    if keys["name"] != "default" or separator not in ("/", "."):
        raise ValueError(f"chunks named by {keys!r}")
    array = np.full(shape, metadata["fill_value"], native)
    block = np.empty(inner, decoder.dtype)
    # A chunk that did not shrink is only a little larger than its values.
    most = min(each * (decoder.nbytes + 65_536), 2 * MAX_CHUNK_BYTES)
    for corner in product(*corners):
        places = (start // step for start, step in zip(corner, steps, strict=True))
        key = separator.join(["c", *map(str, places)])
        if (data := fetch(key, most)) is None:
            missing(key)  # Zarr writes no file of fill values alone.
            continue
        for part, packed in zip(product(*parts), _packed(data, each, sharded), strict=True):
            start = tuple(map(add, corner, part))
            if not all(map(lt, start, shape)):
                continue
            if packed is None:
                missing(f"{key} from {list(start)}")
            else:
                decoder.decode(packed, block)
                place_chunk(array, start, block)
    return array


def _packed(data: bytes, count: int, sharded: bool) -> Iterator[bytes | None]:
    """Yield the packed chunks of a file, in C order; None for one that was never written."""
    if not sharded:
        yield data
        return
    index = data[-16 * count - 4 :]
    if len(index) != 16 * count + 4 or not crc32c_holds(index):
        raise StoreError("its shard has no sound index; it is damaged or cut short")
    for offset, length in np.frombuffer(index, "<u8", 2 * count).reshape(-1, 2).tolist():
        yield None if offset == length == MISSING else data[offset : offset + length]


def place_chunk(array: NDArray[Any], corner: Sequence[int], block: NDArray[Any]) -> None:
    """Write a chunk into an array at a corner, without the part that lies beyond the array."""
    where: Any = map(slice, corner, map(add, corner, block.shape))
    there = array[(*where, ...)]  # With the ellipsis a single number is a view, too.
    there[...] = block[tuple(map(slice, there.shape))]

"""Undo the codecs of a chunk, into memory that is allocated already.

Nothing is written beyond what the metadata promise: a chunk that claims to hold more, or less, is
refused before it is inflated.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError

# CRC32C of any bytes followed by their own CRC32C, little-endian.
_CRC32C_RESIDUE = 0x48674BC7

_ZSTD_MAGIC = 0xFD2FB528
_BLOSC_HEADER = 16

MAX_TEXT_BYTES = 64 * 2**20
"""Most bytes of an unpacked chunk of strings; 65,536 ids take 3 MiB."""


@dataclass(frozen=True)
class ChunkDecoder:
    """The codecs of an array's chunks, as far as this module knows them.

    Attributes
    ----------
    dtype : numpy.dtype
        Little-endian, as stored; object for text.
    shape : tuple of int
        Shape of a chunk.
    compressor : str
        ``blosc``, ``zstd`` or empty.
    crc32c : bool
        Whether a checksum ends each chunk.
    text : int
        Mean bytes that the strings (``vlen-utf8``) of a chunk may have; 0 for numbers.
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
        little = first.get("configuration", {}).get("endian", "little") == "little"
        if first["name"] == ("vlen-utf8" if text else "bytes") and little:
            crc32c = rest[-1:] == ["crc32c"]
            compressors = rest[:-1] if crc32c else rest
            if compressors in ([], ["blosc"], ["zstd"]):
                return cls(dtype, shape, "".join(compressors), crc32c, text)
        raise ValueError(f"codecs {[first['name'], *rest]}")

    @cached_property
    def nbytes(self) -> int:
        """Bytes of a decoded chunk."""
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
        strings: NDArray[Any] = VLenUTF8().decode(text)
        return strings


def crc32c_holds(data: bytes) -> bool:
    """Whether bytes end with the CRC32C of the bytes before."""
    import google_crc32c

    return len(data) >= 4 and int(google_crc32c.value(data)) == _CRC32C_RESIDUE


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

    # Workers and training loaders are processes enough; a pool of threads in
    # each would only get in their way, and does not survive a fork.
    blosc.use_threads = False
    return blosc

"""Arrays of a Zarr group of foreign origin; see `slatprep.storage.chunks`."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Collection, Mapping
from typing import Any

from numpy.typing import NDArray

from slatprep.errors import InputError, StoreError
from slatprep.readers.files import ArraySpec, refusing
from slatprep.records import Place
from slatprep.storage.chunks import array_form, read_chunks

_MAX_METADATA = 2**16
_EXPECTED = (
    "a Zarr group of format 3 with an array for each of {}, not in shards, packed with zstd, "
    "blosc or nothing; or npz, HDF5 or PLY"
)

_WHOLE = (
    'all chunks, as zarr writes them with config={{"write_empty_chunks": True}}; where those left '
    'out hold the fill value, say "empty_chunks": ["{}"] in source.json'
)


def group_arrays(
    data: bytes, where: str | Place, specs: Mapping[str, ArraySpec], empty: Collection[str] = ()
) -> dict[str, NDArray[Any]]:
    """Read the named arrays of a group from the archive of `slatprep.readers.files.load_source`.

    Errors call it `where`. Of the arrays in `empty` chunks may be missing, which then hold the fill
    value. InputError if an array is missing, not as specified, lacks a chunk, or uses another
    compression.
    """
    expected = _EXPECTED.format(", ".join(specs))
    with zipfile.ZipFile(io.BytesIO(data)) as files:
        return {
            name: _array(files, f"{where} [{name}]", name, spec, expected, name in empty)
            for name, spec in specs.items()
        }


def _array(
    files: zipfile.ZipFile, where: str, name: str, spec: ArraySpec, expected: str, empty: bool
) -> NDArray[Any]:
    def fetch(key: str, most: int) -> bytes | None:
        try:
            chunk = files.getinfo(f"{name}/{key}")
        except KeyError:
            if empty or key == "zarr.json":
                return None
            raise InputError(
                where, f"its chunk {name}/{key} is missing", _WHOLE.format(name)
            ) from None
        if chunk.file_size > most:
            raise ValueError(f"{key} has {chunk.file_size} bytes")
        return files.read(chunk)

    with refusing(where, "is no readable array", expected):
        text = fetch("zarr.json", _MAX_METADATA)
        if text is None:
            raise InputError(where, "is not in it", expected)
        metadata = json.loads(text)
        spec.check(where, *array_form(metadata))
        try:
            return read_chunks(metadata, fetch)
        except StoreError as error:
            raise ValueError(str(error)) from None

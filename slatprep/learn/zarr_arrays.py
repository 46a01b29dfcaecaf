"""Read an array of an untrusted Zarr hierarchy without zarr-python.

Plain arrays are read by `slatprep.storage.chunks`, arrays in shards like those of a store.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from slatprep.errors import InputError, StoreError
from slatprep.readers.files import ArraySpec
from slatprep.storage.chunks import MAX_CHUNK_BYTES, array_form, read_chunks
from slatprep.storage.documents import read_document
from slatprep.storage.files import LINK, LocalFolder, local_files
from slatprep.store.contract import MAX_METADATA_BYTES
from slatprep.store.shard_reader import BAD_METADATA, RowReader

_WHOLE = 'all chunks, as zarr writes them with config={"write_empty_chunks": True}'


def read_array(path: Path, root: Path, spec: ArraySpec) -> NDArray[Any]:
    """Read a whole array of Zarr format 3 from the folder `path`; no link may lead out of `root`.

    Raises StoreError if it is not such an array, is damaged, or compressed with another codec than
    zstd or blosc. InputError if its type or shape is not in `spec`, or a link leads out of `root`.
    """
    _refuse_links_out(path, root)
    try:
        metadata = read_document(path / "zarr.json", MAX_METADATA_BYTES)
        shape, dtype = array_form(metadata)
        spec.check(path, shape, dtype)
        if metadata["codecs"][0]["name"] == "sharding_indexed":
            reader = RowReader.of(LocalFolder(path.parent), path.name, metadata)
            if reader.decoder.nbytes > MAX_CHUNK_BYTES:
                raise ValueError(f"chunks of {reader.decoder.shape}")
            for number in range(-(-shape[0] // reader.shard_rows)):
                if not (path.parent / (name := reader.key(number))).exists():
                    raise InputError(path, f"its shard {name} is missing", _WHOLE)
            return reader.read(0, shape[0])
        folder = LocalFolder(path)

        def fetch(name: str, most: int) -> bytes | None:
            try:
                file = folder.open(name)
            except FileNotFoundError:
                # zarr leaves out chunks of fill values, and what was lost must not pass as one.
                what = f"its chunk {name} is missing"
                raise InputError(path, what, _WHOLE) from None
            with file:
                if file.size() > most:
                    raise ValueError(f"a chunk of {file.size()} bytes")
                return file.pread(file.size(), 0)

        return read_chunks(metadata, fetch)
    except (*BAD_METADATA, OSError) as error:
        raise StoreError(f"{path}: {error!r}") from None


def _refuse_links_out(path: Path, root: Path) -> None:
    """Raise InputError if an array's folder, or anything in it, is a link out of the root."""
    whole = root.resolve()
    links = (path / name for name, size in local_files(path).items() if size == LINK)
    for place in (path, *links):
        if not place.resolve().is_relative_to(whole):
            raise InputError(place, f"leads to {place.resolve()}, out of its root", "a file in it")

"""Safe reading of source files: one read gives an array, its size and its hash.

Source files come from strangers. Nothing here unpickles, follows a path out of its root, or
allocates what a header merely claims. Before an array is made, its shape and dtype are compared
with the expected ones, and its size with the bytes that are there.
"""

from __future__ import annotations

import base64
import hashlib
import io
import math
import re
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError, MissingPartnerError, SlatprepError, StoreError, first_of
from slatprep.records import RESOLUTION, AssetPair, Place, SourceFile
from slatprep.storage.chunks import array_form, read_chunks
from slatprep.storage.documents import parse_document
from slatprep.storage.place import storage_of

MAX_FILE_BYTES = 128 * 2**20
"""Largest file of one asset; the largest form, an 11-channel float64 grid, takes 22 MiB."""

MAX_MEMBERS = 256
"""Largest number of members of an npz: each costs memory before it can be checked."""

MAX_FILES = 4096
"""Largest number of files of one asset's Zarr hierarchy."""

_MAX_HEADER_BYTES, _MAX_METADATA_BYTES = 4096, 2**16

_MAX_ITEMS = 64
"""Largest number of values of an array that may have any shape."""

_KIND_NAMES = {
    "b": "booleans",
    "i": "integers",
    "u": "unsigned integers",
    "f": "floating-point numbers",
    "S": "byte text",
    "U": "text",
    "V": "records",
}

_COMPLETE = "a complete file; copy or make it again"
_INTACT_NPZ = "an intact npz archive, as numpy.savez writes it; copy or make it again"
_BEGIN = {
    b"PK\x03\x04": "it begins as one, and may be cut off",
    b"\x93NUMPY": "it is one array, as numpy.save writes it",
    b"\x89HDF": "it is an HDF5 file",
    b"\x80": "it looks like a pickle",
}
"""Explanations why a file named npz cannot be read, by its first bytes."""

# Exceptions that numpy, zipfile, zlib and h5py raise for damaged bytes or another format.
_DAMAGE = (
    ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError,
    SyntaxError, TypeError, ValueError, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


@contextmanager
def refusing(
    where: str | Place, fault: str, expected: str, kind: type[SlatprepError] = InputError
) -> Iterator[None]:
    """Turn exceptions of libraries about damaged bytes into an error that gives their reason.

    The error is an `InputError`, or one of another `kind` with the same text.
    """
    try:
        yield
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        refused = InputError(where, f"{fault} ({reason})", expected)
        raise (refused if kind is InputError else kind(str(refused))) from None


@dataclass(frozen=True)
class ArraySpec:
    """Shapes and numpy dtype kinds that an array in a source file may have.

    In a shape, None stands for 0 to `max_rows` rows, and a range for any size in it. Without
    `shapes`, any shape of 1 to `_MAX_ITEMS` values is allowed. An error adds `note` to the allowed
    shapes. A file may state the `unit` of the values; an empty one allows any.
    """

    shapes: tuple[tuple[int | range | None, ...], ...]
    kinds: str
    note: str = ""
    max_rows: int = RESOLUTION**3
    unit: str = ""

    def check(self, where: str | Place, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        """Raise InputError, naming `where`, unless shape and dtype are allowed."""
        if dtype.hasobject:
            fault = "holds Python objects, which only pickle could read, and pickle can run code"
            way = "a plain numeric array; save it again with allow_pickle=False"
            raise InputError(where, fault, way)
        if dtype.kind not in self.kinds or not 0 < dtype.itemsize <= 512:
            kinds = " or ".join(_KIND_NAMES[kind] for kind in self.kinds)
            raise InputError(where, f"has dtype {dtype.str}", f"an array of {kinds}")
        if self.shapes and not any(self._fits(shape, allowed) for allowed in self.shapes):
            texts = " or ".join(_shape_text(allowed, self.max_rows) for allowed in self.shapes)
            raise InputError(where, f"has shape {_shape_text(shape)}", f"shape {texts}{self.note}")
        if not self.shapes and (len(shape) > 8 or not 0 < math.prod(shape) <= _MAX_ITEMS):
            fault = f"has shape {_shape_text(shape)}"
            raise InputError(where, fault, f"1 to {_MAX_ITEMS} values")

    def check_attributes(
        self, where: str | Place, attributes: Mapping[str, Any], values: NDArray[Any]
    ) -> None:
        """Raise InputError if attributes of the CF conventions give the values another meaning."""
        for name, plain in (("scale_factor", 1), ("add_offset", 0)):
            if np.any(np.asarray(attributes.get(name, plain)) != plain):
                fault = f"its values are packed, by {name} {attributes[name]}"
                raise InputError(where, fault, "the values themselves, and no such attribute")
        for name in ("_FillValue", "missing_value"):
            fill = attributes.get(name, np.nan)
            with suppress(TypeError, ValueError, struct.error):  # xarray packs floats in JSON.
                (fill,) = struct.unpack("<d", base64.b64decode(fill, validate=True))
            if np.asarray(fill).dtype.kind in "fiu" and np.isin(values, fill).any():
                fault = f"{name} {fill} marks values as missing"
                raise InputError(where, fault, "rows of voxels that have all values")
        said = str(np.atleast_1d(np.asarray(attributes.get("units", "")).astype(str))[0])
        if self.unit and _factors(said) not in ({}, _factors(self.unit)):
            fault = f"its attribute units says {said!r}"
            raise InputError(where, fault, f"values in {self.unit}, and no other unit")

    def _fits(self, shape: tuple[int, ...], allowed: tuple[int | range | None, ...]) -> bool:
        return len(shape) == len(allowed) and all(
            0 <= n <= self.max_rows if m is None else n in m if isinstance(m, range) else n == m
            for n, m in zip(shape, allowed, strict=True)
        )


def _factors(unit: str) -> dict[str, int]:
    """Return the exponent of each part of a unit, however it is written: ``kg/m^3``, ``kg m-3``."""
    plain = unit.translate(str.maketrans("²³⁻", "23-"))
    form = r"(/?)\s*([^\W\d_]+)\s*(?:\^|\*\*)?\s*((?:-?\d+)?)"
    parts = re.findall(form, plain)
    if re.sub(form, "", plain).strip(" .·*()[]'") not in ("", "1"):
        return {unit: 1}  # It has a factor, or what is no unit.
    return {
        name: int(power or 1) * (-1 if over else 1)
        for over, name, power in parts
        if name not in ("dimensionless", "none")
    }


def _shape_text(shape: tuple[int | range | None, ...], most: int = 0) -> str:
    sizes = (f"{n[0]} to {n[-1]}" if isinstance(n, range) else n for n in shape)
    text = ", ".join(f"N <= {most}" if n is None else str(n) for n in sizes)
    return f"({text},)" if len(shape) == 1 else f"({text})"


NO_SLAT = "no SLAT for id"
"""Words in the problem of a pair whose SLAT is missing; else its grid has a problem."""


def require_complete(pair: AssetPair) -> tuple[Place, Place]:
    """Return the paths of grid and SLAT.

    Raises MissingPartnerError if a side is missing, and InputError if the pair has another problem.
    """
    if pair.grid is None or pair.slat is None:
        of_slat = pair.grid is not None and NO_SLAT in (pair.problem or NO_SLAT)
        root = pair.roots.slat if of_slat else pair.roots.pixieverse
        fault = pair.problem or f"nothing for id {pair.asset_id!r}"
        raise MissingPartnerError(root, fault, "a grid and a SLAT per id")
    if pair.problem:
        # The error names the asset and no file: the problem says which side is at fault.
        fault, _, expected = pair.problem.rpartition("; expected ")
        expected = expected if fault else "one grid and one SLAT per id"
        raise InputError(f"asset {pair.asset_id!r}", fault or pair.problem, expected)
    return pair.grid, pair.slat


def is_hierarchy(path: Place) -> bool:
    """Return whether a source is named as a Zarr hierarchy, which is a folder."""
    return path.suffix.lower() == ".zarr"


def load_source(path: Place, root: Place, role: str) -> tuple[bytes, SourceFile]:
    """Read a whole file once; return its bytes and its entry in the provenance.

    A Zarr hierarchy is a folder named ``*.zarr``. It is read as an archive of its files, so that
    it too has a size and a hash. InputError if the file leaves `root`, is empty, is larger than
    `MAX_FILE_BYTES` or cannot be read.
    """
    if is_hierarchy(path):
        return _load_hierarchy(path, root, role)
    file, name = storage_of(root).locate(path)
    try:
        data = storage_of(file).read(MAX_FILE_BYTES, path)
    except FileNotFoundError:
        raise InputError(path, "does not exist", "a readable file") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "a readable file") from None
    if len(data) > MAX_FILE_BYTES:
        fault = f"is larger than {MAX_FILE_BYTES >> 20} MiB"
        raise InputError(path, fault, "the files of one asset, which are smaller")
    if not data:
        raise InputError(path, "has zero bytes", _COMPLETE)
    return data, SourceFile(role, name, len(data), hashlib.sha256(data).hexdigest())


def _load_hierarchy(path: Place, root: Place, role: str) -> tuple[bytes, SourceFile]:
    """Load a Zarr hierarchy as `load_source` does; the same files give the same bytes."""
    try:
        names = sorted(storage_of(path).files())
    except StoreError as error:
        fault = str(error).removeprefix(f"{path}: ")
        raise InputError(path, fault, "a Zarr group that can be listed") from None
    if not 0 < len(names) <= MAX_FILES:
        raise InputError(path, f"has {len(names)} files", f"a Zarr group of at most {MAX_FILES}")
    packed, size = io.BytesIO(), 0
    with zipfile.ZipFile(packed, "w") as archive:
        for name in names:
            data, source = load_source(path / name, root, role)
            size += len(data)
            if size > MAX_FILE_BYTES:
                raise InputError(path, f"is larger than {MAX_FILE_BYTES >> 20} MiB", "one asset")
            member = zipfile.ZipInfo(name)
            member.create_system = 3  # The default depends on the machine, and so would the hash.
            archive.writestr(member, data)
    whole = packed.getvalue()
    below = source.path.removesuffix(f"/{name}")
    return whole, SourceFile(role, below, size, hashlib.sha256(whole).hexdigest())


def npy_array(data: bytes, where: str | Place, spec: ArraySpec) -> NDArray[Any]:
    """Read the bytes of an npy file as a read-only array in native byte order.

    Errors call the file `where`. InputError unless the bytes are an array that `spec` allows.
    """
    shape, fortran, dtype, offset = _header(data, len(data), where, spec)
    values = np.frombuffer(data, dtype, math.prod(shape), offset)
    array = values.reshape(shape, order="F" if fortran else "C")
    return array.astype(dtype.newbyteorder("="), copy=False)


def is_text(value: NDArray[Any]) -> bool:
    """Return whether an array of text has only valid code points, which exclude surrogates."""
    codes = np.ascontiguousarray(value).view(np.uint32)
    return not ((codes > sys.maxunicode) | (codes >> 11 == 0xD800 >> 11)).any()


def npz_arrays(
    data: bytes, where: str | Place, specs: Mapping[str, ArraySpec], *, partial: bool = False
) -> dict[str, NDArray[Any]]:
    """Read the named arrays of an npz file, each in native byte order.

    With `partial`, any of them may be missing. No more is decompressed than `specs` allow.
    InputError if the archive is damaged, or an array is missing or not as specified.
    """
    with _open_zip(data, where) as archive:
        infos = archive.infolist()
        present = [info.filename.removesuffix(".npy") for info in infos]
        wanted = [name for name in specs if not partial or name in present]
        for name in wanted:
            if (count := present.count(name)) != 1:
                found = first_of(sorted(present), 8) or "nothing"
                own = f"{count} arrays named" if count else "no array"
                fault = f"has {own} {name!r} (it holds {found})"
                raise InputError(where, fault, f"one array each of {', '.join(specs)}")
        return {
            name: _read_member(archive, infos[present.index(name)], where, specs[name])
            for name in wanted
        }


def zarr_array(
    fetch: Callable[[str, int], bytes | None],
    where: str | Place,
    spec: ArraySpec,
    expected: str,
    missing: Callable[[str], None] = lambda _: None,
) -> NDArray[Any]:
    """Read an array of Zarr format 3; see `slatprep.storage.chunks.read_chunks`.

    InputError, naming `where` and what is expected, if it is damaged or not as specified.
    """
    with refusing(where, "is no readable array", expected):
        metadata = parse_document(fetch("zarr.json", _MAX_METADATA_BYTES) or b"")
        spec.check(where, *array_form(metadata))
        try:
            array = read_chunks(metadata, fetch, missing)
        except StoreError as error:
            raise ValueError(str(error)) from None
        spec.check_attributes(where, metadata.get("attributes") or {}, array)
    return array


def npz_small_arrays(
    data: bytes, where: str | Place, spec: ArraySpec
) -> tuple[dict[str, NDArray[Any]], list[InputError]]:
    """Read the arrays of an npz file that fit `spec`; return them by name, and the others' faults.

    Raises InputError if the archive itself cannot be read.
    """
    arrays, faults = {}, []
    with _open_zip(data, where) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            try:
                arrays[name] = _read_member(archive, info, where, spec)
            except InputError as error:
                faults.append(error)
    return arrays, faults


def _open_zip(data: bytes, where: str | Place) -> zipfile.ZipFile:
    # zipfile makes an object for every directory entry before their number can be checked.
    if data.count(b"PK\x01\x02") > MAX_MEMBERS:
        raise InputError(where, f"has more than {MAX_MEMBERS} members", _INTACT_NPZ)
    kind = next((f": {words}" for start, words in _BEGIN.items() if data.startswith(start)), "")
    with refusing(where, f"is no readable npz archive{kind}", _INTACT_NPZ):
        return zipfile.ZipFile(io.BytesIO(data))


def _read_member(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, where: str | Place, spec: ArraySpec
) -> NDArray[Any]:
    member = f"{where} [{info.filename.removesuffix('.npy')}]"
    # zipfile bounds its output only for these two compressions.
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        expected = "stored or deflated members, as numpy.savez and numpy.savez_compressed write"
        raise InputError(member, f"uses zip compression {info.compress_type}", expected)
    with refusing(member, "is damaged", _INTACT_NPZ), archive.open(info) as stream:
        prefix = stream.read(_MAX_HEADER_BYTES)
        _header(prefix, info.file_size, member, spec)
        # The header states a size that spec allows, so the rest may be inflated.
        data = prefix + stream.read(max(0, info.file_size - len(prefix)))
    return npy_array(data, member, spec)


def _header(
    prefix: bytes, size: int, where: str | Place, spec: ArraySpec
) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Check an npy header before its data is read; return shape, order, dtype and header length.

    `prefix` contains the header; `size` counts header and data [bytes].
    """
    with refusing(where, "is no readable npy array", "an array as numpy.save writes it"):
        # No more than a bounded prefix is parsed: the header's length field may claim 4 GB.
        length = prefix[8 : 10 if prefix[6:7] == b"\x01" else 12]
        end = 8 + len(length) + int.from_bytes(length, "little")
        shape, fortran, dtype, offset = _parsed(prefix[: min(end, _MAX_HEADER_BYTES)])
    if any(type(size) is not int for size in shape):  # True is an int, too
        raise InputError(where, f"has shape {shape}", "whole numbers for a shape")
    spec.check(where, shape, dtype)
    wanted = math.prod(shape) * dtype.itemsize
    held = size - offset
    if held != wanted:
        raise InputError(
            where,
            f"is truncated or damaged: its header announces {wanted} bytes of data, it has {held}",
            _COMPLETE,
        )
    return shape, fortran, dtype, offset


@lru_cache(maxsize=64)
def _parsed(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Parse an npy header; the cache helps, as most assets have equal headers."""
    start = io.BytesIO(header)
    version = np.lib.format.read_magic(start)
    if version == (1, 0):
        return *np.lib.format.read_array_header_1_0(start), start.tell()
    if version == (2, 0):
        return *np.lib.format.read_array_header_2_0(start), start.tell()
    raise ValueError(f"format version {version}")  # 3.0 is for field names, not plain arrays

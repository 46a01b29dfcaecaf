"""Read predictions by asset: npz files, Zarr or HDF5.

The files are not trusted. Nothing is unpickled. Links that lead out of them and arrays of another
type or shape than a prediction's are refused. Zarr is read without zarr-python: plain arrays by
`slatprep.storage.chunks`, arrays in shards like those of a store.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError, StoreError
from slatprep.geometry.voxels import flat_index
from slatprep.normalize import change_ranges
from slatprep.readers.files import ArraySpec, load_source, npz_arrays, refusing
from slatprep.readers.hdf5 import group_arrays
from slatprep.readers.splits import HASH, Shares
from slatprep.records import (
    MANY_BACKGROUND,
    MAX_PROPERTIES,
    PIXIEVERSE,
    Contents,
    Normalization,
    Place,
    Share,
    Verdict,
)
from slatprep.storage.chunks import MAX_CHUNK_BYTES, array_form, read_chunks
from slatprep.storage.documents import adapter_of, read_document
from slatprep.storage.files import LINK, LocalFolder, file_name, local_files
from slatprep.storage.place import storage_of
from slatprep.store.contract import MAX_METADATA_BYTES
from slatprep.store.shard_reader import BAD_METADATA, RowReader

RUN_FILE = "run.json"
"""The parameters of a training run, beside its predictions."""

SPLITS_FILE = "splits.json"
"""The objects of each split, beside `RUN_FILE`."""

PREDICTIONS = "predictions"
"""The folder of the predictions of a training run, beside `RUN_FILE`."""

RUN_BYTES = 2**20
"""Most bytes of a `RUN_FILE`."""

_FARTHEST = 100.0
"""Largest normalised value that is accepted; SI values, given by mistake, exceed it."""

_MIDDLE = 2.5
"""Largest median magnitude that is accepted; log10 of Young's modulus, 3 to 12, exceeds it."""

_FORMS = "a directory of <asset id>.npz, a Zarr group or an HDF5 file with a group an asset"

_NUMBERS = "iuf"

_SPECS = {
    "properties": ArraySpec(((None, range(1, MAX_PROPERTIES + 1)),), _NUMBERS),
    "material": ArraySpec(((None,),), _NUMBERS),
    "logits": ArraySpec(((None, range(1, MANY_BACKGROUND + 1)),), _NUMBERS),
    "coords": ArraySpec(((None, 3),), _NUMBERS),
    "ranges": ArraySpec(tuple((n + 1, 2) for n in range(MAX_PROPERTIES)), _NUMBERS),
}
"""The arrays of a prediction; others are not read."""


@dataclass(frozen=True)
class VoxelPrediction:
    """The prediction for one asset, with voxels in the order of the store.

    Attributes
    ----------
    properties : ndarray of float64, shape (N, P)
        The store's properties in normalised space.
    material : ndarray of int64, shape (N,), optional
        Class, below `Contents.n_classes`.
    converted : bool
        Whether it was normalised by other ranges and converted to the store's.
    """

    properties: NDArray[np.float64]
    material: NDArray[np.int64] | None
    converted: bool = False


@dataclass(frozen=True)
class _Selection:
    """The entries of ``run.json`` that `select_assets` takes."""

    shares: Shares
    verdicts: tuple[Verdict, ...]
    max_ambiguity: Share | None


def predictions_of(path: Path) -> Path:
    """Return the predictions in the folder of a training run; any other path as it is."""
    inside = path / PREDICTIONS
    return inside if (path / RUN_FILE).exists() and inside.is_dir() else path


def selection_of_run(predictions: Path) -> tuple[Path, dict[str, Any], dict[str, Any]] | None:
    """Return the choice of assets of the training run beside the predictions, None without a run.

    The choice is the run's file, the rule of the split as arguments of
    `slatprep.learn.splits.assign_store`, and the filters of `slatprep.learn.splits.select_assets`.
    InputError if the file lacks one of them.
    """
    file = predictions.absolute().parent / RUN_FILE
    if not file.exists():
        return None
    try:
        run = read_document(file, RUN_BYTES)
        named = {name: run[name] for name in ("shares", "verdicts", "max_ambiguity")}
        filters = dict(vars(adapter_of(_Selection).validate_python(named)))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            file,
            f"does not say which assets the run chose ({error!r})",
            "what `slatprep train` wrote; or give --split-by or --shares",
        ) from error
    lists = file.with_name(SPLITS_FILE)
    by = str(lists) if lists.exists() else HASH
    return file, {"by": by, "shares": filters.pop("shares")}, filters


ReadAsset = Callable[[str], Mapping[str, NDArray[Any]] | None]
"""Returns the arrays of an asset by name; None if it has no prediction."""


@contextmanager
def open_predictions(path: Path) -> Iterator[ReadAsset]:
    """Open predictions of any form; yield a function that reads the arrays of an asset.

    They are a folder of ``<asset_id>.npz``, a Zarr group of format 3, or an HDF5 file, with ids
    encoded by `slatprep.storage.files.file_name`. InputError if they are none of these.
    """
    if path.is_dir():
        zarr = any((path / name).exists() for name in ("zarr.json", ".zgroup"))
        yield partial(_zarr if zarr else _npz, path)
        return
    import h5py

    try:
        storage_of(path).open().close()  # Refuses a pipe, at which HDF5 would wait.
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", _FORMS) from None
    if not h5py.is_hdf5(path):
        raise InputError(path, "is not in a form that is known", _FORMS)
    with refusing(path, "is no readable HDF5 file", _FORMS):
        file = h5py.File(path, "r", locking=False)
    with file:
        yield partial(_hdf5, file, path)


def require_normalised(source: str | Place, properties: NDArray[np.float64]) -> None:
    """Raise InputError, naming `source`, if properties (N, P) are far out of the ranges."""
    largest = np.abs(properties).max(initial=0)
    if largest > _FARTHEST:
        expected = "normalised properties, which are -1 to 1 within the ranges, not SI values"
        raise InputError(source, f"properties reach {largest:.4g}", expected)


def check_prediction(
    source: str,
    arrays: Mapping[str, NDArray[Any]],
    coords: NDArray[np.uint8],
    normalization: Normalization,
    contents: Contents = PIXIEVERSE,
) -> VoxelPrediction:
    """Check a prediction; return it in the order and ranges of the store.

    `arrays` has ``properties`` (N, P); optionally ``material`` (N,) or ``logits`` (N, classes),
    ``coords`` (N, 3) and ``ranges`` (P, 2). By default coordinates and ranges are the store's,
    `coords` (N, 3) and `normalization`. InputError, naming `source`, if an array is missing, has
    another type or shape, is not finite or not normalised, or the voxels differ from the store's.
    """
    count = len(coords)
    if "properties" not in arrays:
        raise InputError(source, f"has {', '.join(sorted(arrays)) or 'nothing'}", "properties")
    columns = len(normalization.ranges)
    properties = _shaped(source, "properties", arrays, (count, columns)).astype(np.float64)
    if not np.isfinite(properties).all():
        raise InputError(source, "properties are not all finite", "numbers in normalised space")
    require_normalised(source, properties)
    middle = np.median(np.abs(properties), axis=0).max() if count else 0.0
    if middle > _MIDDLE:
        what = f"half of the values of a property are beyond {middle:.4g}"
        raise InputError(source, what, "normalised properties, -1 to 1 within the ranges")
    converted = False
    if "ranges" in arrays:
        spans = _shaped(source, "ranges", arrays, (columns, 2)).astype(np.float64)
        if not (np.isfinite(spans).all() and (spans[:, 0] < spans[:, 1]).all()):
            what = f"ranges are {spans.tolist()}"
            raise InputError(source, what, "lo below hi, a row a property")
        pairs = zip(normalization.ranges, spans.tolist(), strict=True)
        own = tuple(replace(one, lo=lo, hi=hi) for one, (lo, hi) in pairs)
        ranges = Normalization(own, "prediction")
        converted = ranges.ranges != normalization.ranges
        if converted:
            properties = change_ranges(properties, ranges, normalization)
    material = None
    if "material" in arrays:
        material = _shaped(source, "material", arrays, (count,))
        material = _whole(source, "class", material, contents.n_classes)
    elif "logits" in arrays:
        logits = _shaped(source, "logits", arrays, (count, contents.n_classes))
        if np.isnan(logits).any():
            raise InputError(source, "logits are not all numbers", "a score for each class")
        material = logits.argmax(axis=1)
    if "coords" in arrays:
        ours = _shaped(source, "coords", arrays, (count, 3))
        order = _order(source, ours, coords, contents.latents.resolution)
        properties = properties[order]
        material = None if material is None else material[order]
    return VoxelPrediction(properties, material, converted)


def _order(
    source: str, ours: NDArray[Any], theirs: NDArray[np.uint8], side: int
) -> NDArray[np.int64]:
    keys = (flat_index(_whole(source, "coordinate", ours, side), side), flat_index(theirs, side))
    mine, stored = (np.argsort(key, kind="stable") for key in keys)
    if not np.array_equal(keys[0][mine], keys[1][stored]):
        raise InputError(source, "has other voxels than the store", "the store's voxel/coords")
    return mine[np.argsort(stored)]


def _shaped(
    source: str, name: str, arrays: Mapping[str, NDArray[Any]], shape: tuple[int, ...]
) -> NDArray[Any]:
    array = np.asarray(arrays[name])
    if array.dtype.kind not in _NUMBERS:
        raise InputError(source, f"{name} has dtype {array.dtype.str}", "plain numbers")
    if array.shape != shape:
        raise InputError(source, f"{name} has shape {array.shape}", f"{shape}")
    return array


def _whole(source: str, what: str, values: NDArray[Any], stop: int) -> NDArray[np.int64]:
    """Return numbers of any type as integers, if they are whole and in 0..stop-1."""
    wrong = values[~((values >= 0) & (values < stop) & (values == np.floor(values)))]
    if wrong.size:
        raise InputError(source, f"has {what} {wrong.flat[0]:g}", f"0 to {stop - 1}")
    return values.astype(np.int64)


def _npz(folder: Path, asset_id: str) -> Mapping[str, NDArray[Any]] | None:
    path = folder / f"{file_name(asset_id)}.npz"
    if not path.exists():
        return None
    data, _ = load_source(path, folder, "prediction")
    return npz_arrays(data, path, _SPECS, partial=True)


def _hdf5(file: Any, path: Path, asset_id: str) -> Mapping[str, NDArray[Any]] | None:
    group = file_name(asset_id)
    with refusing(f"{path} [{group}]", "is damaged", _FORMS):
        there = file.id.links.exists(group.encode())
        return group_arrays(file, path, group, _SPECS, partial=True) if there else None


def _zarr(root: Path, asset_id: str) -> Mapping[str, NDArray[Any]] | None:
    group = root / file_name(asset_id)
    if not group.is_dir():
        return None
    try:
        return {
            name: read_array(group / name, root, spec)
            for name, spec in _SPECS.items()
            if (group / name).is_dir()
        }
    except StoreError as error:
        raise InputError(group, f"cannot be read ({error})", _FORMS) from None


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
                # zarr leaves out chunks of fill values, and a lost chunk must not pass as one.
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

"""Read predictions by asset: npz files, Zarr or HDF5.

The files are not trusted. Nothing is unpickled. Links that lead out of them and arrays of another
type or shape than a prediction's are refused. Zarr is read by `slatprep.storage.chunks`, without
zarr-python.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.geometry.voxels import flat_index
from slatprep.normalize import change_ranges
from slatprep.readers.files import ArraySpec, load_source, npz_arrays, refusing, zarr_array
from slatprep.readers.hdf5 import group_arrays, group_name
from slatprep.readers.pixieverse import UNLABELLED
from slatprep.readers.ranges import largest_bound
from slatprep.readers.slat import check_coords
from slatprep.readers.splits import HASH, Shares
from slatprep.records import (
    MANY_BACKGROUND,
    MAX_PROPERTIES,
    PIXIEVERSE,
    Contents,
    Normalization,
    Place,
    PropertyRange,
    Share,
    Verdict,
)
from slatprep.storage.documents import adapter_of, parse_document, read_bounded, read_document
from slatprep.storage.files import file_name
from slatprep.storage.place import storage_of

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

_PROPERTIES = ArraySpec(((None, range(1, MAX_PROPERTIES + 1)),), _NUMBERS)

_SPECS = {
    "properties": _PROPERTIES,
    "properties_si": _PROPERTIES,
    "material": ArraySpec(((None,),), _NUMBERS),
    "logits": ArraySpec(((None, range(1, MANY_BACKGROUND + 1)),), _NUMBERS),
    "coords": ArraySpec(((None, 3), (None, 4)), _NUMBERS),
    "valid": ArraySpec(((None,),), "b" + _NUMBERS),
    "resolution": ArraySpec(((),), "iu"),
    "ranges": ArraySpec(tuple((n + 1, 2) for n in range(MAX_PROPERTIES)), _NUMBERS),
}
"""The arrays of a prediction; others are not read."""

_NAMES = {
    "columns": ArraySpec(((range(1, MAX_PROPERTIES + 1),),), "U"),
    "classes": ArraySpec(((range(1, MANY_BACKGROUND + 1),),), "U"),
}
"""Names of properties and classes in npz files; in others ``columns`` is an attribute."""


@dataclass(frozen=True)
class VoxelPrediction:
    """The prediction for one asset, with voxels in the order of the store.

    Attributes
    ----------
    properties : ndarray of float64, shape (N, P)
        The store's properties in normalised space.
    material : ndarray of int64, shape (N,), optional
        Class, below `Contents.n_classes`; -1 where it is not known.
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
    """Return the predictions in the folder of a training run; any other path as it is.

    InputError if the run has none yet.
    """
    if not (path / RUN_FILE).exists():
        return path
    if not (path / PREDICTIONS).is_dir():
        raise InputError(path, "is a training without predictions", "one that has ended")
    return path / PREDICTIONS


def selection_of_run(predictions: Path) -> tuple[Path, dict[str, Any], dict[str, Any]] | None:
    """Return the choice of assets of the training run beside the predictions, None without a run.

    The choice is the run's file, the rule of the split as arguments of
    `slatprep.learn.splits.assign_store`, and the filters of `slatprep.learn.splits.select_assets`.
    InputError if the file lacks one of them.
    """
    file = predictions.absolute().parent / RUN_FILE
    if predictions.is_symlink() and not file.exists():
        file = predictions.resolve().parent / RUN_FILE
    if not file.exists():
        return None
    expected = "what `slatprep train` wrote; or give --split-by or --shares"
    with refusing(file, "does not say which assets the run chose", expected):
        run = read_document(file, RUN_BYTES)
        named = {name: run[name] for name in ("shares", "verdicts", "max_ambiguity")}
        filters = dict(vars(adapter_of(_Selection).validate_python(named)))
    lists = file.with_name(SPLITS_FILE)
    by = str(lists) if lists.exists() else HASH
    return file, {"by": by, "shares": filters.pop("shares")}, filters


ReadAsset = Callable[[str], Mapping[str, NDArray[Any]] | None]
"""Returns the arrays of an asset by name; None if it has no prediction."""


@contextmanager
def open_predictions(path: Path) -> Iterator[ReadAsset]:
    """Open predictions of any form; yield a function that reads the arrays of an asset.

    They are a folder of ``<asset_id>.npz``, a Zarr group of format 3, or an HDF5 file. Ids are
    encoded by `slatprep.storage.files.file_name`, in HDF5 by `slatprep.readers.hdf5.group_name`.
    InputError if they are none of these.
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
    source: str | Place,
    arrays: Mapping[str, NDArray[Any]],
    coords: NDArray[np.uint8],
    normalization: Normalization,
    contents: Contents = PIXIEVERSE,
    labelled: NDArray[np.bool_] | None = None,
) -> VoxelPrediction:
    """Check a prediction; return it in the order and ranges of the store.

    `arrays` has ``properties`` (N, P), and optionally the other arrays of `GivenPrediction`. By
    default coordinates and ranges are the store's, `coords` (N, 3) and `normalization`. Values are
    only checked in the voxels that are `labelled` (N,), by default all. InputError, naming
    `source`, if an array is missing, has another type or shape, is not finite or not normalised,
    leaves out a labelled voxel, or the voxels differ from the store's.
    """
    given, count, columns = GivenPrediction(source, arrays), len(coords), normalization.ranges
    if "properties" not in arrays:
        raise InputError(source, f"has {', '.join(sorted(arrays)) or 'nothing'}", "properties")
    given.require_names(contents)
    side = given.side(contents.latents.resolution)
    if side != contents.latents.resolution:
        raise InputError(source, f"has a grid of {side}^3", f"{contents.latents.resolution}^3")
    order = np.arange(count)
    if "coords" in arrays:
        order = _order(source, given.voxels(side), coords, side)
    used = np.ones(count, dtype=bool)
    if labelled is not None:
        used[order] = labelled
    if (without := used & ~given.valid(count)).any():
        row = int(np.argmax(without))
        raise InputError(
            source, f"row {row} is not valid", "a prediction of each voxel that the store labels"
        )
    properties, ranges = given.normalised(used, columns), given.ranges(columns)
    converted = ranges is not None and ranges.ranges != columns
    if ranges is not None and converted:
        properties = change_ranges(properties, ranges, normalization)
    material = given.classes(used, contents.n_classes)
    material = None if material is None else material[order]
    return VoxelPrediction(properties[order], material, converted)


@dataclass(frozen=True)
class GivenPrediction:
    """The arrays of a prediction as its file gives them; each method checks those it returns.

    Attributes
    ----------
    source : str or Place
        What errors name.
    arrays : mapping of str to ndarray
        ``coords`` (N, 3) or (N, 4), ``properties`` or ``properties_si`` (N, P), ``ranges`` (P, 2),
        ``columns`` (P,), ``classes``, ``material`` (N,) or ``logits`` (N, classes), ``valid`` (N,),
        ``resolution``; any may be missing.
    """

    source: str | Place
    arrays: Mapping[str, NDArray[Any]]

    def require_names(self, contents: Contents) -> None:
        """Raise InputError if the file names other properties or classes, or in other order."""
        for kind, names in contents.beside_labels.items():
            named = self.arrays.get(kind, names)
            if not np.array_equal(named, names):
                what = f"predicts {', '.join(map(str, named.ravel()))}"
                raise InputError(self.source, what, f"the {kind} {', '.join(names)}")

    def side(self, usual: int) -> int:
        """Return the voxels along an axis, `usual` ones unless the file has another number."""
        return int(self._shaped("resolution", ())) if "resolution" in self.arrays else usual

    def voxels(self, side: int) -> NDArray[np.uint8]:
        """Return the coordinates (N, 3), each once, without a batch column."""
        coords = np.asarray(self.arrays["coords"])
        coords = self._shaped("coords", (len(coords), 4 if coords.shape[1:] == (4,) else 3))
        return check_coords(_whole(self.source, "coordinate", coords, side), self.source, side)

    def valid(self, count: int) -> NDArray[np.bool_]:
        """Return which voxels (N,) are predicted, by default all."""
        if "valid" not in self.arrays:
            return np.ones(count, dtype=bool)
        return _whole(self.source, "valid", self._shaped("valid", (count,)), 2).astype(bool)

    def finite(self, name: str, used: NDArray[np.bool_], columns: int) -> NDArray[np.float64]:
        """Return properties (N, P), finite in the used rows (N,)."""
        values = self._shaped(name, (len(used), columns)).astype(np.float64)
        if (wrong := used & ~np.isfinite(values).all(axis=1)).any():
            row = int(np.argmax(wrong))
            what = f"{name} are not all finite: row {row} has {values[row].tolist()}"
            raise InputError(self.source, what, "numbers in each valid row")
        return values

    def normalised(
        self, used: NDArray[np.bool_], table: Sequence[PropertyRange]
    ) -> NDArray[np.float64]:
        """Return normalised properties (N, P), of which most used ones are near the ranges."""
        properties = self.finite("properties", used, len(table))
        require_normalised(self.source, properties[used])
        middle = np.median(np.abs(properties[used]), axis=0).max() if used.any() else 0.0
        if middle > _MIDDLE:
            what = f"half of the values of a property are beyond {middle:.4g}"
            raise InputError(self.source, what, "normalised properties, -1 to 1 within the ranges")
        return properties

    def ranges(self, table: Sequence[PropertyRange]) -> Normalization | None:
        """Return the ranges that the file gives for the properties of a table, None if none."""
        if "ranges" not in self.arrays:
            return None
        spans = self._shaped("ranges", (len(table), 2)).astype(np.float64)
        most = np.array([largest_bound(one) for one in table])[:, None]
        if not ((np.abs(spans) <= most).all() and (spans[:, 0] < spans[:, 1]).all()):
            what = f"ranges are {spans.tolist()}"
            expected = f"lo below hi, a row a property, within {most.ravel().tolist()}"
            raise InputError(self.source, what, expected)
        pairs = zip(table, spans.tolist(), strict=True)
        return Normalization(tuple(replace(one, lo=lo, hi=hi) for one, (lo, hi) in pairs), "file")

    def classes(self, used: NDArray[np.bool_], count: int) -> NDArray[np.int64] | None:
        """Return the class (N,) of each used row, None without classes.

        It is `UNLABELLED` in other rows, and where all `count` classes have the same score. Of
        several highest scores the first counts: rounded ones are now and then equal.
        """
        material = np.full(len(used), UNLABELLED, dtype=np.int64)
        if "material" in self.arrays:
            given = self._shaped("material", used.shape)[used]
            material[used] = _whole(self.source, "class", given, count)
        elif "logits" in self.arrays:
            scores = self._shaped("logits", (len(used), count))[used]
            if np.isnan(scores).any():
                raise InputError(self.source, "logits are not all numbers", "a score a class")
            equal = (count > 1) & (scores.max(axis=1) == scores.min(axis=1))
            material[used] = np.where(equal, UNLABELLED, scores.argmax(axis=1))
        else:
            return None
        return material

    def _shaped(self, name: str, shape: tuple[int, ...]) -> NDArray[Any]:
        array = np.asarray(self.arrays[name])
        if array.dtype.kind not in _SPECS[name].kinds:
            raise InputError(self.source, f"{name} has dtype {array.dtype.str}", "plain numbers")
        if array.shape != shape:
            raise InputError(self.source, f"{name} has shape {array.shape}", f"{shape}")
        return array


def _order(
    source: str | Place, ours: NDArray[np.uint8], theirs: NDArray[np.uint8], side: int
) -> NDArray[np.int64]:
    keys = (flat_index(ours, side), flat_index(theirs, side))
    mine, stored = (np.argsort(key, kind="stable") for key in keys)
    if not np.array_equal(keys[0][mine], keys[1][stored]):
        raise InputError(source, "has other voxels than the store", "the store's voxel/coords")
    return mine[np.argsort(stored)]


def _whole(source: str | Place, what: str, values: NDArray[Any], stop: int) -> NDArray[np.int64]:
    """Return numbers of any type as integers, if they are whole and in 0..stop-1."""
    wrong = values[~((values >= 0) & (values < stop) & (values == np.floor(values)))]
    if wrong.size:
        raise InputError(source, f"has {what} {wrong.flat[0]:g}", f"0 to {stop - 1}")
    return values.astype(np.int64)


def _npz(folder: Path, asset_id: str) -> Mapping[str, NDArray[Any]] | None:
    path = folder / f"{file_name(asset_id)}.npz"
    return read_npz(path) if path.exists() else None


def read_npz(path: Path) -> Mapping[str, NDArray[Any]]:
    """Read the arrays of a prediction from an npz file."""
    data, _ = load_source(path, path.parent, "prediction")
    return npz_arrays(data, path, _SPECS | _NAMES, partial=True)


def _hdf5(file: Any, path: Path, asset_id: str) -> Mapping[str, NDArray[Any]] | None:
    group = group_name(asset_id)
    with refusing(where := f"{path} [{group}]", "is damaged", _FORMS):
        if not file.id.links.exists(group.encode()):
            return None
        arrays = group_arrays(file, path, group, _SPECS, partial=True)
        attributes = file[f"{group}/properties"].attrs if "properties" in arrays else {}
        elsewhere = file.id.links.exists(f"{group}/columns".encode())
        return _named(where, arrays, attributes, elsewhere)


def _zarr(root: Path, asset_id: str) -> Mapping[str, NDArray[Any]] | None:
    group = root / file_name(asset_id)
    if not group.is_dir():
        return None

    def fetch(name: str, key: str, most: int) -> bytes:
        if not (path := group / name / key).exists():
            missing(name, key)
        return read_bounded(storage_of(root).locate(path)[0], most)

    def missing(name: str, key: str) -> None:
        # zarr leaves out chunks of fill values, and a lost chunk must not pass as one.
        raise InputError(f"{group} [{name}]", f"its file {name}/{key} is missing", _WHOLE)

    arrays = {
        name: zarr_array(
            partial(fetch, name), f"{group} [{name}]", spec, _WHOLE, partial(missing, name)
        )
        for name, spec in _SPECS.items()
        if (group / name).is_dir()
    }
    with refusing(group, "has damaged attributes", _WHOLE):
        about = fetch("properties", "zarr.json", RUN_BYTES) if "properties" in arrays else b"{}"
        attributes = parse_document(about).get("attributes") or {}
        return _named(group, arrays, attributes, (group / "columns").exists())


def _named(
    source: str | Place,
    arrays: dict[str, NDArray[Any]],
    attributes: Mapping[str, Any],
    elsewhere: bool,
) -> Mapping[str, NDArray[Any]]:
    """Add the names in the attribute ``columns`` of the properties.

    ValueError if they are no text, InputError if an array ``columns`` has them (`elsewhere`).
    """
    if elsewhere:
        raise InputError(source, "has an array columns", "the attribute columns of properties")
    if (columns := attributes.get("columns")) is None:
        return arrays
    names = np.array(columns, dtype=str).ravel()[: MAX_PROPERTIES + 1]
    "".join(names).encode()  # Messages show them: ValueError if they are not Unicode.
    return arrays | {"columns": names}


_WHOLE = (
    "an array of Zarr format 3 packed with zstd, blosc or nothing, with all chunks, as zarr writes "
    'them with config={"write_empty_chunks": True}'
)

"""Read predictions: npz files, Zarr or HDF5, by asset."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.geometry.voxels import flat_index
from slatprep.learn.splits import Shares
from slatprep.records import MATERIAL_CLASSES, RESOLUTION

CLASSES = len(MATERIAL_CLASSES)
"""Classes that a decoder scores; background is one of them, though no voxel has it."""

RUN_FILE = "run.json"
"""What `slatprep train` writes beside the predictions: the parameters of the run."""

_FORMS = "a directory of <asset id>.npz, a Zarr group or an HDF5 file with a group an asset"


@dataclass(frozen=True)
class VoxelPrediction:
    """What was predicted of one asset, voxels in the order of the store.

    Attributes
    ----------
    properties : ndarray of float64, shape (N, 3)
        Young's modulus, density, Poisson's ratio in normalised space.
    material : ndarray of int64, shape (N,), optional
        Class 0..7.
    """

    properties: NDArray[np.float64]
    material: NDArray[np.int64] | None


def selection_of_run(predictions: Path) -> dict[str, Any] | None:
    """Return which assets a training run chose, as `slatprep.learn.splits.select_assets` takes it.

    Parameters
    ----------
    predictions : Path
        The folder of its predictions.

    Returns
    -------
    dict or None
        ``shares``, ``verdicts`` and ``max_ambiguity``; None where no run lies there.

    Raises
    ------
    InputError
        If the run's file does not say them.
    """
    file = predictions.absolute().parent / RUN_FILE
    if not file.exists():
        return None
    try:
        run = json.loads(file.read_text(encoding="utf-8"))
        shares, verdicts = Shares(**run["shares"]), tuple(run["verdicts"])
        return {"shares": shares, "verdicts": verdicts, "max_ambiguity": run["max_ambiguity"]}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            file,
            f"does not say which assets the run chose ({error!r})",
            "what `slatprep train` wrote; or give --shares",
        ) from error


ReadAsset = Callable[[str], Mapping[str, NDArray[Any]] | None]
"""Arrays of an asset by name; None where there is no such asset."""


@contextmanager
def open_predictions(path: Path) -> Iterator[ReadAsset]:
    """Open predictions of any form.

    Parameters
    ----------
    path : Path
        A directory of ``<asset_id>.npz``, a Zarr group, or an HDF5 file.

    Raises
    ------
    InputError
        If it is none of these.
    """
    if path.is_dir() and any((path / name).exists() for name in ("zarr.json", ".zgroup")):
        import zarr

        yield _grouped(zarr.open_group(path, mode="r"))
    elif path.is_dir():
        yield lambda asset_id: _npz(path / f"{asset_id}.npz")
    else:
        import h5py

        if not h5py.is_hdf5(path):
            raise InputError(path, "is not in a form that is known", _FORMS)
        with h5py.File(path, "r") as file:
            yield _grouped(file)


def check_prediction(
    source: str, arrays: Mapping[str, NDArray[Any]], coords: NDArray[np.uint8]
) -> VoxelPrediction:
    """Check a prediction and put its voxels in the order of the store.

    Parameters
    ----------
    source : str
        Where it comes from, for messages.
    arrays : mapping of str to ndarray
        ``properties`` (N, 3); optionally ``material`` (N,) or ``logits``
        (N, 8), and ``coords`` (N, 3), without which the order is taken to be
        the store's.
    coords : ndarray of uint8, shape (N, 3)
        Voxels of the store.

    Raises
    ------
    InputError
        If an array is missing, has another shape, is not finite, or the voxels are others.
    """
    count = len(coords)
    if "properties" not in arrays:
        raise InputError(source, f"has {', '.join(sorted(arrays)) or 'nothing'}", "properties")
    properties = _shaped(source, "properties", arrays, (count, 3)).astype(np.float64)
    if not np.isfinite(properties).all():
        raise InputError(source, "properties are not all finite", "numbers in normalised space")
    material = None
    if "material" in arrays:
        material = _shaped(source, "material", arrays, (count,)).astype(np.int64)
        if material.size and not 0 <= material.min() <= material.max() < CLASSES:
            raise InputError(source, f"has class {material.max()}", f"0 to {CLASSES - 1}")
    elif "logits" in arrays:
        material = _shaped(source, "logits", arrays, (count, CLASSES)).argmax(axis=1)
    if "coords" in arrays:
        order = _order(source, _shaped(source, "coords", arrays, (count, 3)), coords)
        properties = properties[order]
        material = None if material is None else material[order]
    return VoxelPrediction(properties, material)


def _order(source: str, ours: NDArray[Any], theirs: NDArray[np.uint8]) -> NDArray[np.int64]:
    if ours.size and not 0 <= ours.min() <= ours.max() < RESOLUTION:
        raise InputError(source, f"has a coordinate {ours.max()}", f"0 to {RESOLUTION - 1}")
    keys = flat_index(ours), flat_index(theirs)
    mine, stored = (np.argsort(key, kind="stable") for key in keys)
    if not np.array_equal(keys[0][mine], keys[1][stored]):
        raise InputError(source, "has other voxels than the store", "the store's voxel/coords")
    order = np.empty_like(mine)
    order[stored] = mine
    return order


def _shaped(
    source: str, name: str, arrays: Mapping[str, NDArray[Any]], shape: tuple[int, ...]
) -> NDArray[Any]:
    array = np.asarray(arrays[name])
    if array.shape != shape:
        raise InputError(source, f"{name} has shape {array.shape}", f"{shape}")
    return array


def _npz(path: Path) -> Mapping[str, NDArray[Any]] | None:
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError) as error:
        raise InputError(path, f"cannot be read ({error})", "a file of numpy.savez") from error


def _grouped(root: Any) -> ReadAsset:
    def read(asset_id: str) -> Mapping[str, NDArray[Any]] | None:
        if asset_id not in root:
            return None
        group = root[asset_id]
        return {name: np.asarray(group[name][...]) for name in group}

    return read

"""Predictions in each form, of every asset of a store."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import zarr

from slatprep import open_store

Predict = Callable[[dict[str, np.ndarray]], Mapping[str, Any]]
"""Gives the arrays of a prediction for the coords, properties and material of an asset."""


def zeros(truth: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Predict the middle of each range."""
    return {"properties": np.zeros((len(truth["coords"]), 3))}


def right(truth: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Predict the labels."""
    material = np.where(truth["material"] == 255, 0, truth["material"])
    return {"properties": np.nan_to_num(truth["properties"]), "material": material}


def write_predictions(folder: Path, store: Path, predict: Predict = zeros) -> Path:
    """Write an npz for each asset of a store into a folder, and return the folder."""
    folder.mkdir(exist_ok=True)
    opened = open_store(store)
    for row, asset_id in enumerate(opened.ids):
        truth = opened.read(row, ("coords", "properties", "material"))
        np.savez(folder / f"{asset_id}.npz", **predict(truth))
    return folder


def write_one(path: Path, form: str, asset_id: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Add the prediction of an asset to a folder of npz, an HDF5 file or a Zarr group."""
    if form == "npz":
        path.mkdir(exist_ok=True)
        np.savez(path / f"{asset_id}.npz", **arrays)
    elif form == "hdf5":
        with h5py.File(path, "a") as file:
            for name, values in arrays.items():
                text = values.astype("S") if values.dtype.kind == "U" else values
                file[f"{asset_id}/{name}"] = text
    else:
        group = zarr.open_group(path, mode="a").create_group(asset_id)
        for name, values in arrays.items():
            text = values.astype("U4") if values.dtype.kind == "U" else values
            group.create_array(name, data=text, config={"write_empty_chunks": True})

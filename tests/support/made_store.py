"""A small store of values drawn at random, written by zarr in no time, with all of them at hand."""

import json
from collections.abc import Callable
from dataclasses import asdict
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from slatprep.parameters import SampleParameters, StoreParameters
from slatprep.records import PIXIEVERSE, Contents, Normalization, PropertyRange
from slatprep.store.writer import create_store, finish_store

IDS = ("ant", "bear.front", "bear.side", "cup")
SIZES = (5, 0, 11, 7)
BUILD_ID = "0123456789abcdef" * 4


def make_store(
    path: Path, contents: Contents = PIXIEVERSE, *, merged: bool = False
) -> dict[str, np.ndarray]:
    """Write a store of four assets, one of them without voxels, and return its arrays by name."""
    rng = np.random.default_rng(0)
    cut = StoreParameters(voxel_chunk=4, voxel_chunks_per_shard=2, grid_assets_per_shard=2)
    create_store(path, len(IDS), sum(SIZES), cut, contents, merged)
    root = zarr.open_group(path, mode="r+", use_consolidated=False)
    arrays: dict[str, np.ndarray] = {}
    for name, array in root.members(max_depth=None):
        if isinstance(array, zarr.Array) and not name.startswith("grid/"):
            arrays[name] = _drawn(rng, array)
    resolution = contents.latents.resolution
    turns = np.tile(np.eye(4), (len(IDS), 1, 1))
    turns[:, :3, 3] = rng.uniform(-0.1, 0.1, (len(IDS), 3))
    cubes = (len(IDS), 64, 64, 64)
    material = np.full(cubes, contents.background, np.uint8)
    fields = np.full((len(IDS), len(contents.properties), 64, 64, 64), np.nan, np.float32)
    for row in range(len(IDS)):
        material[row, 3:9, 5:7, 20 + row] = rng.integers(0, len(contents.labels), (6, 2))
        material[row, 9, 5:7, 20 + row] = 255
        fields[row, :, 3:9, 5:7, 20 + row] = rng.uniform(-1, 1, (len(contents.properties), 6, 2))
    arrays |= {
        "asset/id": np.array(IDS, object),
        "asset/object_id": np.array([one.partition(".")[0] for one in IDS], object),
        "asset/category": np.array(["insect", "", "", "<dish>"], object),
        "asset/verdict": np.array(["good", "failed", "good", "good"], object),
        "asset/offset": np.array([0, *accumulate(SIZES)]),
        "asset/transform": turns,
        "voxel/coords": rng.integers(0, resolution, (sum(SIZES), 3)).astype(np.uint8),
        "grid/material": material,
        "grid/properties": fields,
    }
    with zarr.config.set({"array.write_empty_chunks": True}):
        for name, values in arrays.items():
            root[name][...] = values
    ranges = tuple(
        PropertyRange(one.name, one.log10, 2.0 + n, 5.0 + 2 * n)
        for n, one in enumerate(contents.properties)
    )
    parameters = {"align": {"radius": 1.5}, "sample": asdict(SampleParameters())}
    build = {"parameters": parameters, "versions": {"slatprep": "0"}, "name": "drawn"}
    finish_store(path, Normalization(ranges, "p1-p99"), BUILD_ID, build, contents)
    return arrays


def _drawn(rng: np.random.Generator, array: zarr.Array) -> np.ndarray:
    if array.dtype.kind in "OT":
        return np.array([f"text {n}" for n in range(array.shape[0])], object)
    if array.dtype.kind == "f":
        return rng.uniform(-1, 1, array.shape).astype(array.dtype)
    return rng.integers(0, 2 if array.dtype.kind == "b" else 7, array.shape).astype(array.dtype)


def rewrite(store: Path, array: str, rows: object, values: object) -> None:
    """Change values the proper way, by zarr: checksums are right, digests are not."""
    zarr.open_group(store, mode="r+", use_consolidated=False)[array][rows] = values


def edit_record(store: Path, row: int, edit: Callable[[dict[str, Any]], object]) -> None:
    """Change the record of an asset in place; its digest stays."""
    group = zarr.open_group(store, mode="r+", use_consolidated=False)
    record = json.loads(str(group["asset/record"][row]))
    edit(record)
    group["asset/record"][row] = json.dumps(record)


GONE = object()


def placed(document: dict[str, Any], path: str, value: object, by: str = "/") -> dict[str, Any]:
    """Return a document with the value at ``a/0/b`` replaced, or removed by `GONE`."""
    whole = at = json.loads(json.dumps(document))
    *steps, last = (int(step) if step.isdigit() else step for step in path.split(by))
    for step in steps:
        at = at[step]
    at[last] = value
    if value is GONE:
        del at[last]
    return whole


def edit_json(path: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    """Change a JSON file in place."""
    document = json.loads(path.read_text())
    edit(document)
    path.write_text(json.dumps(document))


def edit_attributes(path: Path, **changes: Any) -> None:
    """Replace attributes of the root; None takes one away."""

    def edit(document: dict[str, Any]) -> None:
        for name, value in changes.items():
            document["attributes"][name] = value
            if value is None:
                del document["attributes"][name]

    edit_json(path / "zarr.json", edit)

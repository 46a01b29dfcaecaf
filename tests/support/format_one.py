"""A store as format 1 had it, made of today's by zarr and JSON alone."""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import zarr

_NEWER = ("voxel/place", "voxel/confidence", "asset/confidence", "asset/expected_accuracy",
          "asset/unphysical", "asset/contradicted")  # fmt: skip


def write_format_one(store: Path, out: Path) -> None:
    """Copy a store, whose models are similarities, and take from it what format 1 lacked."""
    shutil.copytree(store, out)
    root = zarr.open_group(out, mode="r+", use_consolidated=False)
    for name in _NEWER:
        del root[name]
    root["asset/record"][:] = np.array([_older(text) for text in root["asset/record"][:]], object)
    build = root.attrs["build"]
    del build["parameters"]["align"]["max_displacement"]
    del build["parameters"]["sample"]["max_unphysical"]
    root.attrs.update({"format_version": 1, "build": build})
    del root.attrs["latents"], root.attrs["property_units"]
    names = [
        n for n in root["file/name"][:] if not n.startswith(tuple(f"{newer}/" for newer in _NEWER))
    ]
    contents = [
        json.dumps(dict(root.attrs), sort_keys=True, ensure_ascii=False).encode()
        if name.startswith("zarr.json#")
        else (out / name).read_bytes()
        for name in names
    ]
    columns = {
        "name": np.array(names, object),
        "size": np.array([len(content) for content in contents]),
        "sha256": np.array([hashlib.sha256(content).hexdigest() for content in contents], object),
    }
    for name, values in columns.items():
        root[f"file/{name}"].resize(values.shape)
        root[f"file/{name}"][:] = values
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(str(out), zarr_format=3)


def _older(text: str) -> str:
    record = json.loads(text)
    for name in ("deformation", "figures"):
        del record["alignment"][name]
    for name in ("confidence", "expected_accuracy", "contradicted"):
        del record["judgement"][name]
    del record["parameters"]["align"]["max_displacement"]
    del record["parameters"]["sample"]["max_unphysical"]
    del record["counts"]["unphysical"], record["latents"]
    return json.dumps(record, separators=(",", ":"), ensure_ascii=False)

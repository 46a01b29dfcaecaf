"""VoMP's npz of voxels with materials, which its simulation scripts read.

The array ``voxel_data`` has the fields of VoMP's dataset and of its predictions
(https://github.com/nv-tlabs/vomp). Its scripts for warp.fem, Newton and libuipc look them up at
their own points.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from slatprep.export.formats import Exported, ExportOptions, Points, Writer, annotated_points
from slatprep.storage.files import file_name
from slatprep.store import Store, StoredAsset

VOXEL = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
        ("youngs_modulus", "<f4"), ("poissons_ratio", "<f4"), ("density", "<f4"),
        ("segment_id", "<U32"),
    ]
)  # fmt: skip
"""The fields of a voxel: centre in the unit cube, E in Pa, density in kg/m^3, name of class."""

FOLDER = "voxels"


def writer(store: Store, ids: Sequence[str], options: ExportOptions) -> Writer:
    """Return the writer of an npz for each asset; see `slatprep.export.FORMATS`."""
    return Writer(partial(write, points=options.points or "slat"))


def write(
    directory: Path, number: int, assets: Iterable[StoredAsset], *, points: Points
) -> Iterator[Exported]:
    """Write ``voxels/<id>_with_materials.npz`` of each asset, and yield what was written."""
    (directory / FOLDER).mkdir(exist_ok=True)
    for asset in assets:
        there = annotated_points(asset, points)
        rows = np.zeros(len(there.material), dtype=VOXEL)
        for axis, name in enumerate("xyz"):
            rows[name] = there.in_slat[:, axis]
        solid = there.solid(asset)
        for column, name in enumerate(("youngs_modulus", "density", "poissons_ratio")):
            rows[name] = solid[:, column]
        rows["segment_id"] = np.array(asset.store.contents.labels, dtype="<U32")[there.material]
        name = f"{FOLDER}/{file_name(asset.asset_id)}_with_materials.npz"
        np.savez_compressed(directory / name, voxel_data=rows)
        yield Exported(asset, name, len(rows))

"""Coordinates of a store's dimensions, so that xarray can name rows, columns and places.

An array that is named as its dimension becomes an index in xarray: after
``xarray.open_zarr(store, group="voxel")`` one may write
``.sel(property="density")``. Zarr itself gives such an array no meaning.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slatprep.geometry.frames import voxel_centres
from slatprep.records import RESOLUTION
from slatprep.store.digests import add_array

_AXES = ("x", "y", "z")

ASSET_COORDINATES = "id object_id view category"
"""Arrays of ``asset`` that name its rows; the attribute is CF's."""


def write_coordinates(path: Path, properties: Sequence[str]) -> None:
    """Write the coordinates of every group into a store that is being made.

    Its groups are in place, and its metadata not yet consolidated.
    """
    import zarr

    root: Any = zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
    centres = voxel_centres(np.repeat(np.arange(RESOLUTION)[:, None], 3, axis=1))[:, 0]
    texts = {"property": properties, "axis": _AXES}
    for group, dimensions in (
        ("asset", ("property",)),
        ("voxel", ("axis", "property")),
        ("grid", ("property", *_AXES)),
    ):
        for dimension in dimensions:
            values = np.array(texts[dimension], object) if dimension in texts else centres
            description = f"coordinate of the dimension {dimension}"
            add_array(root[group], dimension, values, dimension, description)
    root["asset"].attrs["coordinates"] = ASSET_COORDINATES

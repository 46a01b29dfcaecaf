"""One HDF5 file, a group an asset."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from slatprep.export.assets import ExportedAsset, describe_columns, file_name
from slatprep.export.target import FORMAT
from slatprep.records import PROPERTY_COLUMNS

_DATASETS: dict[str, dict[str, Any]] = {
    "coords": {"description": "SLAT coordinate, x, y, z", "units": "voxel"},
    "feats": {"description": "SLAT latents"},
    "properties": {
        "description": "normalised properties in [-1, 1], NaN where not valid",
        "columns": PROPERTY_COLUMNS,
    },
    "properties_si": {
        "description": "properties, NaN where not valid",
        "columns": PROPERTY_COLUMNS,
        "units": ("Pa", "kg/m^3", "1"),
    },
    "material": {"description": "class 0..6, 255 where not valid"},
    "valid": {"description": "an annotation was found near enough"},
    "distance": {"description": "distance to the annotation used", "units": "voxel"},
    "transform": {
        "description": "PixieVerse frame to SLAT frame, both the unit cube [-0.5, 0.5]^3"
    },
}


class Writer:
    """An HDF5 export that is being written; a context manager.

    Parameters
    ----------
    path : Path
        The file.
    """

    def __init__(self, path: Path) -> None:
        import h5py

        self._file = h5py.File(path, "w")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def describe(self, about: dict[str, Any]) -> None:
        """Write the attributes of the root; what is nested becomes JSON."""
        for name, value in about.items():
            self._file.attrs[name] = json.dumps(value) if isinstance(value, dict) else value

    def add(self, asset: ExportedAsset) -> None:
        """Write an asset as a group of datasets, with its columns as attributes."""
        group = self._file.create_group(file_name(asset.asset_id))
        group.attrs.update(describe_columns(asset))
        for name, attributes in _DATASETS.items():
            array = getattr(asset, name)
            packing = {} if name == "transform" else {"compression": "gzip", "shuffle": True}
            dataset = group.create_dataset(name, data=array, **packing)
            dataset.attrs.update(attributes)


def is_export(path: Path) -> bool:
    """Whether a file is an HDF5 export of slatprep."""
    import h5py

    try:
        with h5py.File(path) as file:
            return bool(file.attrs.get("format") == FORMAT)
    except OSError:
        return False

"""One HDF5 file with a group for each asset."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slatprep.export.formats import ROWS, Exported, ExportOptions, Writer, describe_columns
from slatprep.export.target import FORMAT
from slatprep.readers.hdf5 import group_name
from slatprep.store import Store, StoredAsset
from slatprep.store.layout import LAYOUTS, MERGED_COLUMNS

if TYPE_CHECKING:
    import h5py

_DATASETS = (*ROWS, "properties_si", "transform", *MERGED_COLUMNS)


def writer(store: Store, ids: Sequence[str], options: ExportOptions) -> Writer:
    """Return the writer of one file with all assets; see `slatprep.export.FORMATS`."""
    return Writer(write, is_export=is_export)


def write(path: Path, about: dict[str, Any], assets: Iterable[StoredAsset]) -> Iterator[Exported]:
    """Write a file with a group for each asset, whose attributes are the asset's columns.

    `about` becomes the attributes of the root, with nested values as JSON.
    """
    import h5py

    with _LateFaults(path, "w+") as raw:
        with h5py.File(raw, "w") as file:
            for name, value in about.items():
                file.attrs[name] = json.dumps(value) if isinstance(value, dict) else value
            for asset in assets:
                _write_group(file, asset)
                raw.raise_fault()
                yield Exported(asset, path.name, len(asset.coords))
        raw.raise_fault()


def _write_group(file: h5py.File, asset: StoredAsset) -> None:
    group = file.create_group(group_name(asset.asset_id))
    group.attrs.update(describe_columns(asset))
    for name in _DATASETS:
        if name in MERGED_COLUMNS and not asset.store.merges:
            continue
        packing = {} if name == "transform" else {"compression": "gzip", "shuffle": True}
        dataset = group.create_dataset(name, data=getattr(asset, name), **packing)
        of = LAYOUTS.get(f"voxel/{name}") or LAYOUTS.get(f"asset/{name}")
        dataset.attrs["description"] = of.description if of else "properties, NaN where not valid"
        if of and of.unit:
            dataset.attrs["units"] = of.unit
        if name.startswith("properties") or name == "spread":
            table = asset.store.contents.properties
            dataset.attrs["columns"] = [one.name for one in table]
            if name == "properties_si":
                dataset.attrs["units"] = [one.unit for one in table]
    ranges = group.create_dataset("ranges", data=asset.store.normalization.spans)
    ranges.attrs["description"] = "lo and hi of each property, in log10 where the ranges say so"


class _LateFaults(io.FileIO):
    """A file that hides errors of writing until `raise_fault` raises them.

    HDF5 cannot close a file after an error such as a full disk: it retries for as long as the
    process runs, and then crashes it.
    """

    fault: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        try:
            while left and self.fault is None:
                left = left[super().write(left) or 0 :]
        except OSError as error:
            self.fault = error
        return memoryview(data).nbytes

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.fault = self.fault or error
            return size or 0

    def raise_fault(self) -> None:
        """Raise the first error, if there was one."""
        if self.fault is not None:
            raise self.fault


def is_export(path: Path) -> bool:
    """Return whether a file is an HDF5 export of slatprep."""
    import h5py

    try:
        with h5py.File(path) as file:
            return bool(file.attrs.get("format") == FORMAT)
    except OSError:
        return False

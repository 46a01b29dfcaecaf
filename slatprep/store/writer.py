"""Write the store: one task a shard, each shard by exactly one task.

Two writers of one shard lose data, because a shard is rewritten as a whole.
So `shards` cuts the store into tasks that share none, and `write_shard` does
one; what is small the parent writes itself.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slatprep.parameters import StoreParameters
from slatprep.records import PIXIEVERSE, Contents, Normalization
from slatprep.store.coordinates import write_coordinates
from slatprep.store.digests import write_digests
from slatprep.store.layout import (
    create_arrays,
    overlaps,
    root_attributes,
    row_ranges,
    rows_per_shard,
)
from slatprep.store.records import create_record_array


@dataclass(frozen=True)
class Shard:
    """One shard of every array of a group: a single task's work.

    Attributes
    ----------
    group : str
        ``voxel`` or ``grid``.
    rows : (int, int)
        First row and end in the store.
    first : int
        Index of the first asset that has rows in it.
    keys : sequence of str
        Keys, in the spool, of the assets that have rows in it.
    offsets : sequence of int
        ``voxel`` alone: first row of each of them in the store, and the last
        one's end.
    """

    group: str
    rows: tuple[int, int]
    first: int
    keys: Sequence[str]
    offsets: Sequence[int] = ()


def create_store(
    path: Path,
    n_assets: int,
    n_voxels: int,
    parameters: StoreParameters,
    contents: Contents = PIXIEVERSE,
) -> None:
    """Create an empty store with every array in place."""
    import zarr

    root = zarr.create_group(path, zarr_format=3)
    create_arrays(root, n_assets, n_voxels, parameters, contents)
    create_record_array(root, n_assets, parameters.compression_level)


def shards(
    keys: Sequence[str], offsets: Sequence[int], parameters: StoreParameters
) -> Iterator[Shard]:
    """Yield every shard of a store whose assets, by key, begin at rows `offsets`."""
    for start, stop in row_ranges(offsets[-1], rows_per_shard(parameters)):
        owners = [asset for asset, _ in overlaps(offsets, start, stop)]
        first, last = owners[0], owners[-1] + 1
        yield Shard("voxel", (start, stop), first, keys[first:last], offsets[first : last + 1])
    for start, stop in row_ranges(len(keys), parameters.grid_assets_per_shard):
        yield Shard("grid", (start, stop), start, keys[start:stop])


def finish_store(
    path: Path,
    normalization: Normalization,
    build_id: str,
    build: Mapping[str, object],
    contents: Contents = PIXIEVERSE,
) -> None:
    """Write the root's attributes and all files' digests; gather all metadata in one file.

    Parameters
    ----------
    path : Path
        The store.
    normalization : Normalization
        Ranges of the properties.
    build_id : str
        Id of the build.
    build : mapping
        Parameters and versions that made the content.
    contents : Contents
        What it holds.
    """
    import zarr

    attributes = root_attributes(normalization, build_id, build, contents)
    open_for_writing(path).attrs.update(attributes)
    write_coordinates(path, attributes["property_columns"])
    write_digests(path)
    with warnings.catch_warnings():
        # Zarr says that consolidated metadata are not in format 3's text yet.
        # They only save reads: a reader that ignores them finds every array.
        warnings.filterwarnings("ignore", message="Consolidated metadata", category=UserWarning)
        zarr.consolidate_metadata(str(path), zarr_format=3)


def open_for_writing(path: Path) -> Any:
    """Open a new store's root, without its consolidated metadata."""
    import zarr

    return zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)

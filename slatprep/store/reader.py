"""Read a store, one asset at a time."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.records import Normalization, PropertyRange
from slatprep.store.layout import ARRAYS, FORMAT, FORMAT_VERSION

if TYPE_CHECKING:
    import zarr


@dataclass(frozen=True)
class StoredAsset:
    """One asset as the store holds it; properties are normalised.

    Attributes
    ----------
    asset_id : str
        Id of the row.
    coords : ndarray of uint8, shape (N, 3)
        SLAT voxels.
    feats : ndarray of float32, shape (N, 8)
        Their latents.
    properties : ndarray of float32, shape (N, 3)
        Young's modulus, density, Poisson's ratio in [-1, 1]; NaN where not valid.
    material : ndarray of uint8, shape (N,)
        Class 0..6; 255 where not valid.
    valid : ndarray of bool, shape (N,)
        Whether an annotation was found near enough.
    distance : ndarray of float32, shape (N,)
        Voxels to the annotation used.
    transform : ndarray of float64, shape (4, 4)
        PixieVerse frame to SLAT frame.
    grid_properties : ndarray of float32, shape (3, 64, 64, 64)
        The PixieVerse field in [-1, 1]; NaN where not annotated.
    grid_material : ndarray of uint8, shape (64, 64, 64)
        Class 0..6, 7 background, 255 occupied but not annotated.
    columns : dict
        The asset's row of every other ``asset/*`` array, by the array's last
        name: ``fitness``, ``verdict``, ``category``, ...
    """

    asset_id: str
    coords: NDArray[np.uint8]
    feats: NDArray[np.float32]
    properties: NDArray[np.float32]
    material: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    distance: NDArray[np.float32]
    transform: NDArray[np.float64]
    grid_properties: NDArray[np.float32]
    grid_material: NDArray[np.uint8]
    columns: dict[str, Any]


class Store:
    """A store opened for reading; `open_store` makes one.

    Parameters
    ----------
    path : Path
        Where it lies.
    group : zarr.Group
        Its root, for everything this class does not offer.
    """

    def __init__(self, path: Path, group: zarr.Group) -> None:
        self.path = path
        self.group = group
        self.attributes: dict[str, Any] = dict(group.attrs)

    def __len__(self) -> int:
        return len(self.ids)

    def __iter__(self) -> Iterator[StoredAsset]:
        return (self.asset(asset_id) for asset_id in self.ids)

    @cached_property
    def ids(self) -> list[str]:
        """Asset ids, sorted."""
        return [str(asset_id) for asset_id in self._read("asset/id")]

    @cached_property
    def offsets(self) -> NDArray[np.int64]:
        """Asset a owns rows ``offsets[a]:offsets[a+1]`` of ``voxel/*``, int64 (A+1,)."""
        return np.asarray(self._read("asset/offset"))

    @property
    def normalization(self) -> Normalization:
        """The ranges that properties were normalised with."""
        entries = self.attributes["normalization"]
        ranges = [
            PropertyRange(name, bool(e["log10"]), float(e["lo"]), float(e["hi"]))
            for name in self.attributes["property_columns"]
            for e in [entries[name]]
        ]
        source = entries[ranges[0].name]["source"]
        return Normalization((ranges[0], ranges[1], ranges[2]), source)

    def column(self, name: str) -> NDArray[Any]:
        """Read one ``asset/*`` array whole, by its last name."""
        return np.asarray(self._read(f"asset/{name}"))

    def find(self, asset_id: str) -> int:
        """Return the index of an asset.

        Raises
        ------
        StoreError
            If the store has no such asset; the message names those it might be.
        """
        index = self._index.get(asset_id)
        if index is None:
            views = [known for known in self.ids if known.startswith(f"{asset_id}.")]
            close = views or difflib.get_close_matches(asset_id, self.ids)
            hint = (
                f"did you mean {' or '.join(close[:5])}?" if close else f"it has {len(self)} assets"
            )
            raise StoreError(f"{self.path} has no asset {asset_id!r}; {hint}")
        return index

    def asset(self, asset_id: str) -> StoredAsset:
        """Read everything about one asset.

        Raises
        ------
        StoreError
            If the store has no such asset.
        """
        index = self.find(asset_id)
        rows = slice(int(self.offsets[index]), int(self.offsets[index + 1]))
        voxel = {
            layout.name.partition("/")[2]: np.asarray(self._read(layout.name, rows))
            for layout in ARRAYS
            if layout.name.startswith("voxel/")
        }
        names = [layout.name.partition("/")[2] for layout in ARRAYS if "asset/" in layout.name]
        columns = {name: self._column(name)[index] for name in names if name not in _NOT_COLUMNS}
        return StoredAsset(
            asset_id=asset_id,
            transform=np.asarray(self._column("transform")[index]),
            grid_properties=np.asarray(self._read("grid/properties", index)),
            grid_material=np.asarray(self._read("grid/material", index)),
            columns=columns,
            **voxel,
        )

    @cached_property
    def _index(self) -> dict[str, int]:
        return {asset_id: index for index, asset_id in enumerate(self.ids)}

    @cached_property
    def _columns(self) -> dict[str, NDArray[Any]]:
        return {}

    def _column(self, name: str) -> NDArray[Any]:
        if name not in self._columns:
            self._columns[name] = self.column(name)
        return self._columns[name]

    def _read(self, name: str, selection: Any = ...) -> Any:
        try:
            array: Any = self.group[name]
        except KeyError:
            raise StoreError(f"{self.path} lacks the array {name}; build it again") from None
        return array[selection]


_NOT_COLUMNS = ("id", "offset", "transform")


def open_store(path: str | Path) -> Store:
    """Open a store for reading.

    Parameters
    ----------
    path : str or Path
        The store's directory.

    Returns
    -------
    Store
        Nothing but metadata has been read.

    Raises
    ------
    StoreError
        If there is nothing, something else, or a store of a newer format.
    """
    import zarr

    path = Path(path)
    if not path.exists():
        raise StoreError(f"{path} does not exist; build a store with `slatprep build-store`")
    attributes = _root_attributes(path)
    if attributes.get("format") != FORMAT:
        raise StoreError(
            f"{path} is not a slatprep store; expected a directory that "
            "`slatprep build-store` wrote"
        )
    version = attributes.get("format_version")
    if version != FORMAT_VERSION:
        raise StoreError(
            f"{path} has format version {version!r}; this slatprep reads {FORMAT_VERSION}. "
            "Use the slatprep that wrote it, or a newer one"
        )
    return Store(path, zarr.open_group(path, mode="r", zarr_format=3))


def is_store(path: Path) -> bool:
    """Whether a path holds a slatprep store of any version."""
    return _root_attributes(path).get("format") == FORMAT


def _root_attributes(path: Path) -> dict[str, Any]:
    try:
        document = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
        attributes = document["attributes"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return attributes if isinstance(attributes, dict) else {}

"""Read a store, one asset at a time."""

from __future__ import annotations

import errno
import os
import pkgutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, StoreError, amount
from slatprep.geometry.voxels import shown_in_cells, voxels_at
from slatprep.normalize import denormalize_properties
from slatprep.records import MaterialField, Place, StructuredLatents, words_of
from slatprep.storage.documents import bounded, parse_document
from slatprep.storage.place import Folder, place_of, storage_of
from slatprep.store.assets import ASSET_COLUMNS, AssetTable, AttributesError, number_of, other_store
from slatprep.store.attributes import width_findings
from slatprep.store.contract import MAX_METADATA_BYTES, MAX_VOXELS
from slatprep.store.layout import FORMAT, FORMAT_VERSION, MERGED_COLUMNS, arrays_with, last_names
from slatprep.store.shard_reader import DamagedFileError, UnreachableError, is_out_of_reach

if TYPE_CHECKING:
    from PIL.Image import Image

TRAINING_COLUMNS = ("coords", "feats", "properties")
"""Columns that `Store.read` reads by default."""

VOXEL_COLUMNS = last_names("voxel", arrays_with(merged=True))


@dataclass(frozen=True, eq=False, repr=False)
class StoredAsset:
    """One asset as the store holds it; properties are normalised.

    The PixieVerse side (`grid_properties`, `grid_material` and `field`) is read
    on first access, which may raise `StoreError`.

    Attributes
    ----------
    store : Store
        The store it was read from.
    index : int
        Its row in the store.
    asset_id : str
        Id of the row.
    coords : ndarray of uint8, shape (N, 3)
        SLAT voxels of the encoder's grid; ``latents.centres`` has their positions.
    feats : ndarray of float32, shape (N, channels)
        Latents of the voxels; ``store.contents.latents`` describes them.
    properties : ndarray of float32, shape (N, P)
        The store's properties in [-1, 1]; NaN where not valid.
    material : ndarray of uint8, shape (N,)
        Class, an index into ``store.contents.labels``; 255 where not valid.
    valid : ndarray of bool, shape (N,)
        Whether an annotation was found near enough.
    distance : ndarray of float32, shape (N,)
        Distance to the annotation used [voxel].
    confidence : ndarray of float32, shape (N,)
        Probability that the class is right; 0 where not valid.
    place : ndarray of float32, shape (N, 3)
        Point of the PixieVerse frame at which each voxel's labels were read.
    spread : ndarray of float32, shape (N, P)
        Standard deviation of each normalised property over the annotations from which the
        labels are merged; NaN where fewer than two are valid.
    votes : ndarray of float32, shape (N,)
        Share of the valid annotations that give the class, 0 where none is valid; NaN where
        the asset has one annotation.
    transform : ndarray of float64, shape (4, 4)
        Similarity from the PixieVerse frame to the SLAT frame. The record has the deformation that
        follows it, if any; see `slatprep.store.records.StoredRecords.place_map`.
    columns : dict
        The asset's row of every other ``asset/*`` array, by the array's last
        name: ``fitness``, ``verdict``, ``category``, ...
    """

    store: Store
    index: int
    asset_id: str
    coords: NDArray[np.uint8]
    feats: NDArray[np.float32]
    properties: NDArray[np.float32]
    material: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    distance: NDArray[np.float32]
    place: NDArray[np.float32]
    confidence: NDArray[np.float32]
    spread: NDArray[np.float32]
    votes: NDArray[np.float32]
    transform: NDArray[np.float64]
    columns: dict[str, Any]

    def __repr__(self) -> str:
        what = f"{self.columns['category'] or 'category unknown'}, {self.columns['verdict']}"
        return f"<StoredAsset {self.asset_id}: {what}, {amount(len(self.coords), 'voxel')}>"

    def plot(self) -> Image:
        """Draw the asset as ``slatprep check-alignment`` does; a notebook shows the picture.

        StoreError if its record cannot be read.
        """
        # Pictures belong to a room above the store, but people look for them here.
        picture = pkgutil.resolve_name("slatprep.inspect.pictures.write:picture_of")
        return cast("Image", picture(self))

    @property
    def merged(self) -> bool:
        """Whether the asset's labels are merged from several annotations."""
        return not np.isnan(self.votes[:1]).all()

    @cached_property
    def latents(self) -> StructuredLatents:
        """The asset's SLAT, as it was read from its source."""
        return self.store.latents_of(self.coords, self.feats)

    @cached_property
    def cells(self) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
        """Occupied cells of the 64^3 grid, and a voxel of each; see `shown_in_cells`."""
        return shown_in_cells(self.coords, self.store.contents.latents.resolution)

    @cached_property
    def properties_si(self) -> NDArray[np.float32]:
        """Properties of ``store.contents`` in SI units, (N, P); NaN where not valid."""
        return denormalize_properties(self.properties, self.store.normalization)

    @cached_property
    def grid_properties(self) -> NDArray[np.float32]:
        """The PixieVerse field in [-1, 1], (P, 64, 64, 64); NaN where not annotated."""
        return np.asarray(self.store.read_rows("grid/properties", self.index, self.index + 1)[0])

    @cached_property
    def grid_material(self) -> NDArray[np.uint8]:
        """Class, ``store.contents.background``, or 255 (not annotated), (64, 64, 64)."""
        return np.asarray(self.store.read_rows("grid/material", self.index, self.index + 1)[0])

    @cached_property
    def normalised_field(self) -> MaterialField:
        """The PixieVerse field that the asset was made from, with properties in [-1, 1]."""
        contents, material = self.store.contents, self.grid_material.reshape(-1)
        cells = np.flatnonzero(material < contents.background)
        return MaterialField(
            occupancy=self.grid_material != contents.background,
            voxels=voxels_at(cells),
            material=material[cells],
            properties=self.grid_properties.reshape(-1, material.size)[:, cells].T,
            table=contents.properties,
            classified=bool(contents.classes),
        )

    @cached_property
    def field(self) -> MaterialField:
        """The PixieVerse field that the asset was made from, with properties in SI units."""
        own = self.normalised_field
        properties = denormalize_properties(own.properties, self.store.normalization)
        return replace(own, properties=properties)


class Store(AssetTable):
    """A store opened for reading; `open_store` makes one.

    Threads and forked processes may share it. A pickled store opens the same path
    again; if another store is there by then, each use raises StoreError.

    Parameters
    ----------
    path : Place
        Place of the store.
    document : dict
        The root's ``zarr.json``.
    folder : Folder, optional
        The store's folder, open, if its document was read through it.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return opened_elsewhere, (open_again, self.path, self.identity)

    def __iter__(self) -> Iterator[StoredAsset]:
        return (self.asset(index) for index in range(len(self)))

    @overload
    def __getitem__(self, name: str | int) -> StoredAsset: ...

    @overload
    def __getitem__(self, name: slice) -> list[StoredAsset]: ...

    def __getitem__(self, name: str | int | slice) -> StoredAsset | list[StoredAsset]:
        if isinstance(name, slice):
            return [self.asset(index) for index in range(*name.indices(len(self)))]
        return self.asset(name)

    def read(
        self, index: str | int, columns: str | Sequence[str] = TRAINING_COLUMNS
    ) -> dict[str, NDArray[Any]]:
        """Read rows of ``voxel/*`` of one asset, fast, as training needs it.

        Parameters
        ----------
        index : str or int
            Which asset, by number or by id; see `match`.
        columns : str or sequence of str
            Last names of ``voxel/*`` arrays: ``coords``, ``feats``,
            ``properties``, ``material``, ``valid``, ``distance``, ``place``,
            ``confidence``, ``spread``, ``votes``.

        Returns
        -------
        dict of str to ndarray
            Fresh arrays of N rows; the checksum of every chunk has been verified.

        Raises
        ------
        StoreError
            If there is no such asset or array, or a file is missing or damaged.
        """
        start, stop = self.rows(self.match(index) if isinstance(index, str) else index)
        columns = words_of(columns)
        if storage_of(self.path).local is not None:
            return {name: self._voxel_rows(name, start, stop) for name in columns}
        # Each array is an object of its own, and each answer takes long, so all are asked for at
        # once. Threads that were kept for the next call would be missing in a forked process.
        with ThreadPoolExecutor(max(len(columns), 1)) as pool:
            read = pool.map(lambda name: self._voxel_rows(name, start, stop), columns)
            return dict(zip(columns, read, strict=True))

    def latents_of(
        self, coords: NDArray[np.uint8], feats: NDArray[np.float32]
    ) -> StructuredLatents:
        """Return a SLAT of voxels (N, 3) and latents (N, channels), as `read` returns them."""
        space = self.contents.latents
        return StructuredLatents(
            coords, feats, standardised=space.standardised, resolution=space.resolution
        )

    def rows(self, index: int) -> tuple[int, int]:
        """Return the first row of an asset in ``voxel/*``, and the one after its last.

        Raises
        ------
        StoreError
            If there is no such asset, or its rows are invalid.
        """
        index = number_of(index, len(self), self.path)
        start, stop = self.offsets[index : index + 2].tolist()
        if not 0 <= start <= stop <= start + MAX_VOXELS:
            raise StoreError(
                f"{self.path}/asset/offset: asset {index} has rows {start} to {stop}; "
                f"expected 0 to {MAX_VOXELS} rows"
            )
        return start, stop

    def asset(self, name: str | int) -> StoredAsset:
        """Return one asset, by its id, a unique beginning of its id, or its number.

        ``store[name]`` does the same; see `match`. The grid is read on first access.

        Raises
        ------
        StoreError
            If the store has no such asset, or a file is missing or damaged.
        """
        index = self.match(name)
        arrays = self.read(index, VOXEL_COLUMNS)
        side = self.contents.latents.resolution
        if arrays["coords"].max(initial=0) >= side:
            raise DamagedFileError(
                str(self.path), "voxel/coords", f"a coordinate above {side - 1}", f"0 to {side - 1}"
            )
        return StoredAsset(
            store=self,
            index=index,
            asset_id=self.ids[index],
            transform=self.cached_column("transform")[index].copy(),
            columns={name: self.cached_column(name)[index] for name in ASSET_COLUMNS},
            **arrays,
        )

    def _voxel_rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        if name not in VOXEL_COLUMNS:
            raise self.no_column(name, VOXEL_COLUMNS)
        if name in MERGED_COLUMNS and not self.merges:
            columns = [len(self.about.property_columns)] if name == "spread" else []
            return np.full([stop - start, *columns], np.nan, dtype=np.float32)
        return self.read_rows(f"voxel/{name}", start, stop)


def open_store(path: Store | str | Place, *, copy: bool = False) -> Store:
    """Open a store for reading.

    Parameters
    ----------
    path : str or Place
        The store's directory, or its URL on an object store. On an object store
        the current version is opened, and stays open when it is replaced. An
        open store is returned as it is.
    copy : bool
        Copy a store from an object store to the local disk first, unless that
        was done before. This suits training, which reads the store many times.

    Returns
    -------
    Store
        The open store; only one file of metadata has been read.

    Raises
    ------
    StoreError
        If there is no store, its format has another version, or its attributes
        are invalid.
    """
    if isinstance(path, Store):
        return path
    path = storage_of(place_of(path)).current_version()
    if copy:
        path = storage_of(path).copied_version()
    document, folder = _opened_root(path)
    version = document["attributes"].get("format_version")
    if type(version) is not int or version != FORMAT_VERSION:
        raise StoreError(
            f"{path} has format version {version!r}; this slatprep reads {FORMAT_VERSION}. "
            "Use the slatprep that wrote it, or a newer one"
        )
    store = Store(path.absolute(), document, folder)  # The working folder may change.
    # A store is refused when it is opened, not halfway through a command.
    for finding in width_findings(store.about, store.metadata):
        raise AttributesError(f"{path}/{finding}; run `slatprep verify`")
    return store


def open_again(path: Place, identity: str) -> Store:
    """Open a store that was opened before, by its path and `AssetTable.identity`.

    StoreError if it cannot be opened, or another store is there now.
    """
    store = open_store(path)
    if store.identity != identity:
        raise other_store(path)
    return store


class LostStore(Store):
    """Stands for a store that a process got but cannot open; each use raises the `error`.

    An error while a task is unpickled would end the worker, and its words would be lost.
    """

    def __init__(self, error: StoreError) -> None:
        self.__dict__["error"] = error

    def __getattribute__(self, name: str) -> Any:
        if name.startswith("__"):
            return super().__getattribute__(name)
        # Otherwise each use would lengthen its traceback, which keeps the callers' data alive.
        raise self.__dict__["error"].with_traceback(None)


def opened_elsewhere(opens: Callable[..., Store], *of: object) -> Store:
    """Return the store that `opens` returns, or a `LostStore`, which must not be kept."""
    try:
        return opens(*of)
    except StoreError as error:
        return LostStore(error)


def is_store(path: Place) -> bool:
    """Return whether a place itself is a slatprep store of any format version.

    UnreachableError if its ``zarr.json`` is there, on the local disk, and may not be read.
    """
    try:
        _opened_root(path)
    except StoreError as error:
        # A folder that may be entered, but not read, has the same error without such a file.
        there = isinstance(path, Path) and os.path.lexists(path / "zarr.json")
        if there and isinstance(error, UnreachableError):
            raise
        return False
    return True


def require_outside(out: Path, to_replace: bool = False) -> None:
    """Raise unless an output path lies outside of every store.

    ConfigError if it is a store, unless a store is `to_replace`; if it lies inside a store, or
    cannot be read.
    """
    try:
        target = out.resolve()
        places = target.parents if to_replace else (target, *target.parents)
        around = next((path for path in places if is_store(path)), None)
    except (OSError, RuntimeError) as error:  # loops of links
        raise ConfigError(
            f"{out}: cannot be looked at ({error}); expected a path that may be written"
        ) from None
    if around is not None:
        where = f"lies inside the store {around}" if around != target else "is a store"
        raise ConfigError(f"{out} {where}; expected a path outside of any store")


def require_beside(folder: Path) -> None:
    """Raise unless a folder beside a store, which the user did not name, may be written.

    StoreError if it is a link, which anybody may have put there; ConfigError as `require_outside`.
    """
    if folder.is_symlink():
        raise StoreError(f"{folder}: is a link; expected a folder, or no file: move it away")
    require_outside(folder)


def _opened_root(path: Place) -> tuple[dict[str, Any], Folder]:
    """Return the root's ``zarr.json`` of a store of any format version, and its folder.

    All files are read through that folder, as a build may put another one at the path at any time.
    StoreError if the file does not exist, cannot be read, or is not that of a store.
    """
    file = path / "zarr.json"
    try:
        folder = storage_of(path).folder()
        with folder.open("zarr.json") as opened:
            text = bounded(opened.upto(MAX_METADATA_BYTES), MAX_METADATA_BYTES)
        document = parse_document(text)
    except (FileNotFoundError, NotADirectoryError) as error:
        what = "its bucket" if "bucket does not exist" in str(error) else file
        raise StoreError(
            f"{path} is not a slatprep store: {what} does not exist; build a store with "
            "`slatprep build-store`"
        ) from None
    except (OSError, ValueError) as error:
        # A pipe or a folder of that name is no store.
        if isinstance(error, OSError) and error.errno not in (errno.EINVAL, errno.EISDIR):
            if is_out_of_reach(path, error):
                raise UnreachableError(path, file.name, str(error.strerror)) from None
            raise StoreError(f"{path}: cannot be reached ({error.strerror})") from None
        document = {}
    attributes = document.get("attributes")
    if not isinstance(attributes, dict) or attributes.get("format") != FORMAT:
        raise StoreError(
            f"{path} is not a slatprep store; expected a directory that "
            "`slatprep build-store` wrote"
        )
    return document, folder

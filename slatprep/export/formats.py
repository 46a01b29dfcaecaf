"""Code that all export formats share: their interface, their options, and the data of assets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, StoreError, require_one_of, tally
from slatprep.geometry.deformation import PlaceMap
from slatprep.geometry.frames import voxel_centres
from slatprep.records import BACKGROUND, MATERIAL_CLASSES, PROPERTY_COLUMNS, words_of
from slatprep.store import Store, StoredAsset
from slatprep.store.records import StoredRecords

Points = Literal["slat", "grid"]
Frame = Literal["slat", "pixieverse"]

TRELLIS_ENCODER = "dinov2_vitl14_reg_slat_enc_swin8_B_64l8_fp16"
"""The encoder that TRELLIS's published configurations name as ``latent_model``."""

COLUMNS = (
    "object_id", "view", "category", "verdict", "confidence", "expected_accuracy", "fitness",
    "fitness_backward", "inlier_rmse", "ambiguity", "valid_share",
)  # fmt: skip
"""The columns of ``asset/*`` in every export."""

TARGETS = ("properties", "material", "valid", "confidence")
"""The arrays that a decoder is trained with, beside the latents."""

ROWS = ("coords", "feats", *TARGETS, "distance", "place")
"""The arrays of ``voxel/*`` in every export that has them all."""


class Exported(NamedTuple):
    """An asset that was written, its file's name, its number of points, figures for the index."""

    asset: StoredAsset
    file: str
    points: int
    figures: Mapping[str, float] = MappingProxyType({})


def choose_ids(store: Store, assets: Sequence[str | int], verdicts: Sequence[str]) -> list[str]:
    """Return the sorted ids of `assets` with one of `verdicts`; an empty sequence takes all.

    Raises ConfigError if an id or a verdict is unknown, or no asset is left.
    """
    verdicts = words_of(verdicts)
    wanted = store.having(verdicts)
    named = sorted({store.match(name) for name in words_of(assets)})
    rows = named or range(len(store))
    chosen = sorted(store.ids[row] for row in rows if wanted[row])
    if not chosen:
        among = " among those named" if named else ""
        raise ConfigError(
            f"{store.path}: no asset has the verdict {' or '.join(verdicts)}{among}; the "
            f"verdicts are {tally(store.column('verdict')[list(rows)])}"
        )
    return chosen


def describe_columns(asset: StoredAsset) -> dict[str, Any]:
    """Return an asset's id and its `COLUMNS`, as Python objects."""
    columns = {name: np.asarray(asset.columns[name]).tolist() for name in COLUMNS}
    return {"asset_id": asset.asset_id, **columns}


class AnnotatedPoints(NamedTuple):
    """Points with materials: positions (N, 3) in either frame's unit cube, SI values (N, P).

    The `place_map` between the frames is that of a field's voxels; None for SLAT voxels.
    """

    in_slat: NDArray[np.float64]
    in_pixieverse: NDArray[np.float64]
    material: NDArray[np.uint8]
    values: NDArray[np.float32]
    distance: NDArray[np.float32]
    place_map: PlaceMap | None = None

    def solid(self, asset: StoredAsset) -> NDArray[np.float32]:
        """Return Young's modulus [Pa], density [kg/m^3] and Poisson's ratio, (N, 3)."""
        return self.values[:, asset.store.columns_of(PROPERTY_COLUMNS)]


def require_solver_classes(store: Store) -> None:
    """Raise StoreError if a store has other classes than PhysGaussian's, which solvers know."""
    if store.contents.classes not in (MATERIAL_CLASSES, ()):
        raise StoreError(
            f"{store.path} has classes of its own ({', '.join(store.contents.classes)}); expected "
            f"those of PhysGaussian's solver ({', '.join(MATERIAL_CLASSES[:BACKGROUND])}), or none"
        )


def clipped_values(store: Store, ids: Iterable[str], points: Points) -> tuple[str, ...]:
    """Return a remark if the build set values of these assets to the ends of the store's ranges."""
    column = store.column("clipped_grid" if points == "grid" else "clipped")
    counts = column[[store.find(one) for one in ids]].sum(axis=0).tolist()
    named = zip(counts, store.about.property_columns, strict=True)
    if not (clipped := [f"{count:,} of {name}" for count, name in named if count]):
        return ()
    beyond = "values beyond the store's ranges are taken as the end of the range"
    return (f"{beyond}: {', '.join(clipped)}",)


def annotated_points(asset: StoredAsset, points: Points) -> AnnotatedPoints:
    """Return the valid SLAT voxels, or the annotated voxels of the field at distance 0."""
    if points == "grid":
        field, place_map = asset.field, StoredRecords(asset.store).place_map(asset)
        centres = voxel_centres(field.voxels)
        return AnnotatedPoints(
            place_map.to_slat(centres),
            centres,
            field.material,
            field.properties,
            np.zeros(len(field.material), dtype=np.float32),
            place_map,
        )
    valid = asset.valid
    return AnnotatedPoints(
        asset.latents.centres[valid],
        asset.place[valid].astype(np.float64),
        asset.material[valid],
        asset.properties_si[valid],
        asset.distance[valid],
    )


@dataclass(frozen=True)
class ExportOptions:
    """Options of some formats; ConfigError for an unknown word or a wrong size of shards.

    Attributes
    ----------
    points : {"slat", "grid"}, optional
        PLY, voxel_data, USD: the valid voxels of the SLAT, or the annotated voxels of the
        PixieVerse field. By default the field for USD, and the SLAT for others.
    frame : {"slat", "pixieverse"}
        PLY: the unit cube of the SLAT, or PixieVerse's world coordinates.
    shard_size : int
        WebDataset: assets in one shard.
    latent_model : str, optional
        npz: the encoder's name, by which TRELLIS's dataset finds the latents. By default
        `TRELLIS_ENCODER` for TRELLIS's latents, else the store's name of the encoder.
    size : float
        USD: width of the unit cube [m].
    materials : int
        USD: most materials into which E and nu of an asset are binned.
    """

    points: Points | None = None
    frame: Frame = "slat"
    shard_size: int = 256
    latent_model: str | None = None
    size: float = 1.0
    materials: int = 64

    def __post_init__(self) -> None:
        if self.points is not None:
            require_one_of("points", self.points, get_args(Points))
        require_one_of("frame", self.frame, get_args(Frame))
        if not (isinstance(self.shard_size, int | np.integer) and self.shard_size >= 1):
            raise ConfigError(f"shard_size is {self.shard_size}; expected a whole number from 1")


@dataclass(frozen=True)
class Writer:
    """Functions that write the files of an export.

    Attributes
    ----------
    write : callable
        Takes the folder, the number of a batch and its assets; writes them and yields an
        `Exported` for each. For an export in a single file: takes the file, the description
        of the store, and all assets.
    batch : int
        Assets per task of a worker; several, because each task opens the store.
    finish : callable, optional
        Takes the folder and the index's entries, sorted by id; writes the files that cover all
        assets and returns their names.
    points : {"slat", "grid"}
        The voxels whose values are written.
    remarks : callable
        Takes the index's entries; returns remarks on the result for the user.
    is_export : callable, optional
        Only for an export in a single file, which one process writes: returns whether an
        existing file is such an export, so that it may be replaced.
    """

    write: Callable[..., Iterable[Exported]]
    batch: int = 16
    finish: Callable[[Path, Sequence[dict[str, Any]]], Sequence[str]] | None = None
    points: Points = "slat"
    remarks: Callable[[Sequence[dict[str, Any]]], tuple[str, ...]] = lambda _entries: ()
    is_export: Callable[[Path], bool] | None = None


WriteOne = Callable[[Path, StoredAsset], Exported]
"""Writes an asset into a folder."""


def one_by_one(write: WriteOne, **others: Any) -> Writer:
    """Return a writer of one file for each asset, which `write` puts into a folder.

    `others` are the other fields of `Writer`.
    """
    return Writer(partial(_write_each, write), **others)


def _write_each(
    write: WriteOne, directory: Path, _number: int, assets: Iterable[StoredAsset]
) -> Iterator[Exported]:
    return (write(directory, asset) for asset in assets)

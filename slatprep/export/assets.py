"""Choose assets of a store, and read what exports need of each."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, StoreError
from slatprep.geometry.voxels import voxels_of
from slatprep.normalize import denormalize
from slatprep.records import BACKGROUND, Verdict
from slatprep.store import Store

COLUMNS = (
    "object_id",
    "view",
    "category",
    "verdict",
    "fitness",
    "fitness_backward",
    "inlier_rmse",
    "ambiguity",
    "valid_share",
)
"""The columns of ``asset/*`` that travel with an exported asset."""

_ARRAYS = ("coords", "feats", "properties", "material", "valid", "distance")
_LONGEST_NAME = 180


@dataclass(frozen=True)
class ExportedAsset:
    """An asset with all that an export may write of it.

    Attributes
    ----------
    asset_id : str
        Id of the row.
    coords, feats : ndarray
        The SLAT: (N, 3) uint8 and (N, 8) float32.
    properties, properties_si : ndarray of float32, shape (N, 3)
        Young's modulus, density, Poisson's ratio: in [-1, 1], and in Pa,
        kg/m^3 and 1. NaN where not valid.
    material, valid, distance : ndarray
        (N,) uint8, bool, float32 as the store holds them.
    transform : ndarray of float64, shape (4, 4)
        PixieVerse frame to SLAT frame.
    columns : dict
        `COLUMNS` of the asset.
    grid_voxels, grid_material, grid_properties_si : ndarray or None
        The annotated voxels of the PixieVerse field, where they were asked
        for: (K, 3) uint8, (K,) uint8, (K, 3) float32 in SI units.
    """

    asset_id: str
    coords: NDArray[np.uint8]
    feats: NDArray[np.float32]
    properties: NDArray[np.float32]
    properties_si: NDArray[np.float32]
    material: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    distance: NDArray[np.float32]
    transform: NDArray[np.float64]
    columns: dict[str, Any]
    grid_voxels: NDArray[np.uint8] | None = None
    grid_material: NDArray[np.uint8] | None = None
    grid_properties_si: NDArray[np.float32] | None = None


def select_assets(store: Store, assets: Sequence[str], verdicts: Sequence[str]) -> list[str]:
    """Return the ids that were asked for, sorted.

    Parameters
    ----------
    store : Store
        The store.
    assets : sequence of str
        Ids; empty means all.
    verdicts : sequence of str
        Verdicts that may go out; empty means all.

    Raises
    ------
    ConfigError
        If an id or a verdict is unknown, or nothing is left.
    """
    unknown = sorted(set(verdicts) - set(Verdict))
    if unknown:
        raise ConfigError(f"verdict is {unknown[0]!r}; expected one of {', '.join(Verdict)}")
    try:
        rows = sorted({store.find(asset_id) for asset_id in assets}) or range(len(store))
    except StoreError as error:
        # A name that is not there is a wrong call; nothing is wrong with the store.
        raise ConfigError(str(error)) from None
    verdict = store.column("verdict")
    chosen = [store.ids[row] for row in rows if not verdicts or verdict[row] in verdicts]
    if not chosen:
        there = Counter(str(verdict[row]) for row in rows)
        counts = ", ".join(f"{count} {name}" for name, count in sorted(there.items()))
        raise ConfigError(
            f"{store.path}: no asset has the verdict {' or '.join(verdicts)}; those asked for "
            f"are {counts}"
        )
    return chosen


def read_assets(store: Store, ids: Sequence[str], *, grid: bool = False) -> Iterator[ExportedAsset]:
    """Read assets one after the other, their PixieVerse fields only if `grid`."""
    transforms = store.column("transform")
    table = {name: store.column(name).tolist() for name in COLUMNS}
    normalization = store.normalization
    for asset_id in ids:
        row = store.find(asset_id)
        arrays = store.read(row, _ARRAYS)
        yield ExportedAsset(
            asset_id=asset_id,
            properties_si=denormalize(arrays["properties"], normalization),
            transform=transforms[row],
            columns={name: values[row] for name, values in table.items()},
            **arrays,
            **(_read_grid(store, asset_id) if grid else {}),
        )


def _read_grid(store: Store, asset_id: str) -> dict[str, NDArray[Any]]:
    asset = store.asset(asset_id)
    material, properties = asset.grid_material, asset.grid_properties
    annotated = material < BACKGROUND
    return {
        "grid_voxels": voxels_of(annotated),
        "grid_material": material[annotated],
        "grid_properties_si": denormalize(properties[:, annotated].T, store.normalization),
    }


def describe_columns(asset: ExportedAsset) -> dict[str, Any]:
    """Return an asset's id and columns as a JSON object."""
    return {"asset_id": asset.asset_id, **asset.columns}


def file_name(asset_id: str, *, dots: bool = True) -> str:
    """Return a file name for an asset, without suffix.

    Plain ids stay as they are. Whatever could mean something to a shell, an
    archive or a file system is percent-encoded, as is a leading sign; a name
    that would be too long ends in a hash instead.

    Parameters
    ----------
    asset_id : str
        Any text.
    dots : bool
        Whether dots may stay.

    Examples
    --------
    >>> file_name("0a1b2c.front"), file_name("0a1b2c.front", dots=False)
    ('0a1b2c.front', '0a1b2c%2Efront')
    >>> file_name("../a b"), file_name("-rf")
    ('%2E.%2Fa%20b', '%2Drf')
    """
    name = quote(asset_id, safe="")
    if not dots:
        name = name.replace(".", "%2E")
    if name.startswith((".", "_", "-", "~")):
        name = f"%{ord(name[0]):02X}{name[1:]}"
    if len(name) > _LONGEST_NAME:
        digest = hashlib.sha256(asset_id.encode()).hexdigest()[:32]
        name = f"{name[:_LONGEST_NAME]}~{digest}"
    return name

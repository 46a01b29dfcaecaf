"""Score a store against known truth, as demo data has it.

The truth of an asset is ``<truth_dir>/<asset id>.npz`` with ``transform``
(4, 4), ``material`` (N,), ``name``, ``level`` and ``symmetric``.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.geometry.frames import (
    VOXEL_SIZE,
    apply_transform,
    displacement,
    invert_transform,
    voxel_centres,
)
from slatprep.records import BACKGROUND
from slatprep.store import StoredAsset, open_store

SUCCESS_DISPLACEMENT = 1.5
"""An asset is placed right where its mean displacement [voxel] is below this."""

ANSWERABLE_DISTANCE = 2.0
"""A SLAT voxel has a true answer where an annotation lies within this distance [voxel]."""

_TRUTH_KEYS = ("transform", "material", "name", "level", "symmetric")


@dataclass(frozen=True)
class Truth:
    """What is known of one asset: transform (4, 4), class of each SLAT voxel (N,), and names."""

    path: Path
    transform: NDArray[np.float64]
    material: NDArray[np.uint8]
    name: str
    level: int
    symmetric: bool


@dataclass(frozen=True)
class TruthScore:
    """How one asset of a store compares with its truth.

    Attributes
    ----------
    asset_id, name, level, symmetric
        As the truth states them.
    displacement : float
        Mean distance [voxel] over the SLAT voxels between where the estimated
        and the true inverse transform put them in the PixieVerse frame.
    label_accuracy : float
        Share of the answerable voxels whose class is right; a voxel without
        a label is wrong.
    truth_own : float
        The same share for the nearest annotated voxel under the true
        transform: what is left to lose by the lookup alone.
    valid_share : float
        Share of the SLAT voxels that carry a label.
    """

    asset_id: str
    name: str
    level: int
    symmetric: bool
    displacement: float
    label_accuracy: float
    truth_own: float
    valid_share: float


@dataclass(frozen=True)
class LevelScore:
    """The non-symmetric assets of one level: shares, means and medians of their scores."""

    level: int
    assets: int
    success: float
    displacement_median: float
    displacement_p90: float
    label_accuracy: float
    truth_own: float
    valid_share: float


@dataclass(frozen=True)
class TruthReport:
    """Scores of a store: one an asset, one a level; `missing` has a truth but no row."""

    assets: tuple[TruthScore, ...]
    levels: tuple[LevelScore, ...]
    missing: tuple[str, ...]


def score_against_truth(store: Path, truth_dir: Path) -> TruthReport:
    """Compare every asset of a store with its truth.

    Parameters
    ----------
    store : Path
        A store of `slatprep build-store`; only its published layout is read.
    truth_dir : Path
        Folder of truth files; assets of the store without one are left out.

    Returns
    -------
    TruthReport

    Raises
    ------
    StoreError
        If the store cannot be opened.
    InputError
        If there is no truth in the folder, or a truth does not fit its asset.
    """
    truths = {path.stem: path for path in sorted(truth_dir.glob("*.npz"))}
    if not truths:
        raise InputError(truth_dir, "no truth in it", "a folder with one <asset id>.npz an asset")
    opened = open_store(store)
    scores = tuple(
        _score_asset(opened.asset(asset_id), truths[asset_id])
        for asset_id in opened.ids
        if asset_id in truths
    )
    return TruthReport(scores, summarise(scores), tuple(sorted(set(truths) - set(opened.ids))))


def summarise(scores: Sequence[TruthScore]) -> tuple[LevelScore, ...]:
    """Return the score of each level over its assets that have one right placement only."""
    levels = sorted({score.level for score in scores if not score.symmetric})
    return tuple(
        _summarise_level(level, [s for s in scores if s.level == level and not s.symmetric])
        for level in levels
    )


def _summarise_level(level: int, scores: Sequence[TruthScore]) -> LevelScore:
    displacements = np.array([score.displacement for score in scores])
    return LevelScore(
        level=level,
        assets=len(scores),
        success=float(np.mean(displacements < SUCCESS_DISPLACEMENT)),
        displacement_median=float(np.median(displacements)),
        displacement_p90=float(np.percentile(displacements, 90)),
        label_accuracy=float(np.mean([score.label_accuracy for score in scores])),
        truth_own=float(np.mean([score.truth_own for score in scores])),
        valid_share=float(np.mean([score.valid_share for score in scores])),
    )


def _score_asset(asset: StoredAsset, path: Path) -> TruthScore:
    annotated = np.argwhere(asset.grid_material < BACKGROUND)
    return compare_with_truth(
        asset.asset_id,
        read_truth(path),
        coords=asset.coords,
        transform=asset.transform,
        material=asset.material,
        valid=asset.valid,
        annotated=annotated,
        annotated_material=asset.grid_material[tuple(annotated.T)],
    )


def compare_with_truth(
    asset_id: str,
    truth: Truth,
    *,
    coords: NDArray[np.uint8],
    transform: NDArray[np.float64],
    material: NDArray[np.uint8],
    valid: NDArray[np.bool_],
    annotated: NDArray[np.integer[Any]],
    annotated_material: NDArray[np.uint8],
) -> TruthScore:
    """Compare one asset's transform and labels with its truth.

    Parameters
    ----------
    asset_id : str
        For the score's name.
    truth : Truth
        What `read_truth` gave.
    coords, transform, material, valid : ndarray
        SLAT voxels (N, 3), the estimated transform (4, 4), and what was looked
        up at the voxels (N,).
    annotated, annotated_material : ndarray
        Annotated voxels (K, 3) of the PixieVerse frame and their classes (K,).

    Returns
    -------
    TruthScore

    Raises
    ------
    InputError
        If the truth does not have one class for each SLAT voxel.
    """
    from scipy.spatial import cKDTree

    if truth.material.shape != material.shape:
        raise InputError(
            truth.path,
            f"material has shape {truth.material.shape}",
            f"{material.shape}, one class for each SLAT voxel of the asset",
        )
    looked_up = apply_transform(invert_transform(truth.transform), voxel_centres(coords))
    distance, nearest = cKDTree(voxel_centres(annotated)).query(looked_up)
    answerable = distance / VOXEL_SIZE <= ANSWERABLE_DISTANCE
    own_material = annotated_material[nearest]
    return TruthScore(
        asset_id=asset_id,
        name=truth.name,
        level=truth.level,
        symmetric=truth.symmetric,
        displacement=displacement(transform, truth.transform, coords),
        label_accuracy=_share(((material == truth.material) & valid)[answerable]),
        truth_own=_share((own_material == truth.material)[answerable]),
        valid_share=_share(valid),
    )


def _share(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if flags.size else float("nan")


def read_truth(path: Path) -> Truth:
    """Read one asset's truth.

    Raises
    ------
    InputError
        If the file cannot be read or lacks something.
    """
    expected = f"an npz with {', '.join(_TRUTH_KEYS)}"
    try:
        with np.load(path, allow_pickle=False) as file:
            return Truth(
                path=path,
                transform=file["transform"].astype(np.float64),
                material=file["material"],
                name=str(file["name"]),
                level=int(file["level"]),
                symmetric=bool(file["symmetric"]),
            )
    except KeyError as error:
        raise InputError(path, str(error.args[0]), expected) from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(path, f"cannot be read ({error})", expected) from error

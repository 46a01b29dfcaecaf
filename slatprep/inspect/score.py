"""Score a store against known truth, as demo data has it.

The truth of an asset is ``<truth_dir>/<asset id>.npz`` with ``transform`` (4, 4), ``material``
(N,), ``name``, ``level`` and ``symmetric``. If the two shapes differ, it also has ``places``
(N, 3), the true place of each SLAT voxel in the PixieVerse frame; ``transform`` is then the
similarity nearest to these places, or that without the warp of level 4. In a store without
classes, a voxel is right if its properties equal the true ``properties`` (N, P), with a column for
each name in ``columns`` (P,).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.geometry.frames import VOXEL_SIZE, apply_transform, invert_transform, voxel_centres
from slatprep.readers.files import ArraySpec, load_source, npz_arrays
from slatprep.records import (
    MAX_PROPERTIES,
    Annotation,
    MaterialField,
    Place,
    StructuredLatents,
)
from slatprep.store import StoredAsset, open_store
from slatprep.workers import Progress, counted

SUCCESS_DISPLACEMENT = 1.5
"""Largest mean displacement [voxel] of a right placement, above that of the true similarity."""

SAME_VALUE = 0.01
"""Largest relative difference at which a property counts as equal to its true value."""

MOST_VALUES = 255
"""Largest number of distinct rows of true properties in an asset."""

ANSWERABLE_DISTANCE = 2.0
"""Largest distance [voxel] from a true place to an annotated voxel at which labels are scored."""

_TRUTH = {
    "transform": ArraySpec(((4, 4),), "f"),
    "material": ArraySpec(((None,),), "iu"),
    "name": ArraySpec(((),), "U"),
    "level": ArraySpec(((),), "iu"),
    "symmetric": ArraySpec(((),), "b"),
}
_PLACES = {"places": ArraySpec(((None, 3),), "f")}
_VALUES = {
    "properties": ArraySpec(tuple((None, n + 1) for n in range(MAX_PROPERTIES)), "f"),
    "columns": ArraySpec(tuple((n + 1,) for n in range(MAX_PROPERTIES)), "U"),
}


@dataclass(frozen=True)
class Truth:
    """The truth of one asset: transform (4, 4), class of each SLAT voxel (N,), and names.

    ``places`` (N, 3) are the true places of the SLAT voxels in the PixieVerse
    frame's unit cube; None if the inverse transform gives them.
    """

    path: Path
    transform: NDArray[np.float64]
    material: NDArray[np.integer[Any]]
    name: str
    level: int
    symmetric: bool
    places: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class TruthScore:
    """Comparison of one asset of a store with its truth.

    Attributes
    ----------
    asset_id, name, level, symmetric
        As the truth states them.
    displacement : float
        Mean distance [voxel] between the stored and the true place of a SLAT voxel
        in the PixieVerse frame.
    label_accuracy : float
        Share of the voxels within `ANSWERABLE_DISTANCE` whose class is right; in a store
        without classes, whose properties are all right. A voxel that is not valid is wrong.
    truth_own : float
        The same share if each voxel takes the class of the annotated voxel nearest to its
        true place: the accuracy that a perfect alignment reaches.
    valid_share : float
        Share of the SLAT voxels that are valid.
    similarity_displacement, similarity_accuracy : float
        Displacement, and share of right classes, of the truth's transform.
    """

    asset_id: str
    name: str
    level: int
    symmetric: bool
    displacement: float
    label_accuracy: float
    truth_own: float
    valid_share: float
    similarity_displacement: float
    similarity_accuracy: float

    @property
    def placed(self) -> bool:
        """Whether the placement is right, compared with the best similarity."""
        return self.displacement < self.similarity_displacement + SUCCESS_DISPLACEMENT


@dataclass(frozen=True)
class LevelScore:
    """The non-symmetric assets of one level: shares, means and medians of their scores.

    Displacements are medians (``displacement_p90``: the 90th percentile), other numbers
    are means; ``success`` is the share of assets that are placed right.
    """

    level: int
    assets: int
    success: float
    displacement_median: float
    displacement_p90: float
    label_accuracy: float
    truth_own: float
    valid_share: float
    similarity_displacement: float
    similarity_accuracy: float


@dataclass(frozen=True)
class TruthReport:
    """Scores of a store by asset and by level; `missing` are ids with a truth but no row."""

    assets: tuple[TruthScore, ...]
    levels: tuple[LevelScore, ...]
    missing: tuple[str, ...]


def score_against_truth(
    store: Place, truth_dir: Path, progress: Progress | None = None
) -> TruthReport:
    """Compare every asset of a store with its truth in the folder, if it has one.

    Raises InputError if the folder has no truth, none for an asset of the store, or a truth that
    does not fit its asset.
    """
    truths = {path.stem: path for path in sorted(truth_dir.glob("*.npz"))}
    if not truths:
        raise InputError(truth_dir, "no truth in it", "a folder with one <asset id>.npz an asset")
    opened = open_store(store)
    known = [asset_id for asset_id in opened.ids if asset_id in truths]
    if not known:
        fault = f"none of its {len(truths):,} files has the id of an asset of {store}"
        raise InputError(truth_dir, fault, f"names such as {opened.ids[0]}.npz")
    each = (_score_asset(opened.asset(asset_id), truths[asset_id]) for asset_id in known)
    scores = list(counted(each, len(known), progress))
    missing = tuple(sorted(truths.keys() - known))
    return TruthReport(tuple(scores), summarise(scores), missing)


def summarise(scores: Sequence[TruthScore]) -> tuple[LevelScore, ...]:
    """Return the score of each level over its assets that are not symmetric."""
    counted = [score for score in scores if not score.symmetric]
    return tuple(
        _summarise_level(level, [score for score in counted if score.level == level])
        for level in sorted({score.level for score in counted})
    )


def _summarise_level(level: int, scores: Sequence[TruthScore]) -> LevelScore:
    def over(name: str) -> list[float]:
        return [getattr(score, name) for score in scores]

    means = ("label_accuracy", "truth_own", "valid_share", "similarity_accuracy")
    return LevelScore(
        level=level,
        assets=len(scores),
        success=float(np.mean(over("placed"))),
        displacement_median=float(np.median(over("displacement"))),
        displacement_p90=float(np.percentile(over("displacement"), 90)),
        similarity_displacement=float(np.median(over("similarity_displacement"))),
        **{name: float(np.mean(over(name))) for name in means},
    )


def _score_asset(asset: StoredAsset, path: Path) -> TruthScore:
    truth, field = read_truth(path), asset.field
    annotation = Annotation(
        asset.properties_si, asset.material, asset.valid, asset.distance, asset.place
    )
    if not field.classified:
        names, values = _true_values(path, len(truth.material))
        known, labels = np.unique(values, axis=0, return_inverse=True)
        if len(known) > MOST_VALUES:
            what = f"has {len(known)} different rows of properties"
            raise InputError(path, what, f"at most {MOST_VALUES}")
        columns = asset.store.columns_of(names)
        truth = replace(truth, material=labels.reshape(-1))
        field = replace(field, material=_row_of(field.properties[:, columns], known))
        material = _row_of(annotation.properties[:, columns], known)
        annotation = replace(annotation, material=material)
    return compare_with_truth(asset.asset_id, truth, field, asset.latents, annotation)


def _true_values(path: Path, count: int) -> tuple[tuple[str, ...], NDArray[np.floating[Any]]]:
    """Return the names of the true properties, and their values (N, P) at the SLAT voxels."""
    data, _ = load_source(path, path.parent, "truth")
    arrays = npz_arrays(data, path, _VALUES)
    names, values = tuple(map(str, arrays["columns"])), arrays["properties"]
    if values.shape != (count, len(names)):
        raise InputError(path, f"properties has shape {values.shape}", f"({count}, {len(names)})")
    return names, values


def _row_of(values: NDArray[np.float32], known: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Return the index (N,) of the known row that equals each row of values; len(known) if none."""
    found = np.full(len(values), len(known), np.uint8)
    for number, row in enumerate(known):
        found[np.isclose(values, row, rtol=SAME_VALUE, atol=1e-6).all(axis=1)] = number
    return found


def compare_with_truth(
    asset_id: str,
    truth: Truth,
    field: MaterialField,
    latents: StructuredLatents,
    annotation: Annotation,
) -> TruthScore:
    """Compare one asset's places and labels with its truth.

    Raises InputError if the truth does not have one class and one place for each voxel.
    """
    from scipy.spatial import cKDTree

    by_similarity = apply_transform(invert_transform(truth.transform), latents.centres)
    true_places = by_similarity if truth.places is None else truth.places
    for name, kind, found, shape in (
        ("material", "class", truth.material, annotation.material.shape),
        ("places", "place", true_places, by_similarity.shape),
    ):
        if found.shape != shape:
            wanted = f"{shape}, one {kind} for each SLAT voxel of the asset"
            raise InputError(truth.path, f"{name} has shape {found.shape}", wanted)
    tree = cKDTree(voxel_centres(field.voxels))
    distance, nearest = tree.query(true_places)
    answerable = distance / VOXEL_SIZE <= ANSWERABLE_DISTANCE
    labelled_right = (annotation.material == truth.material) & annotation.valid
    similarity_nearest = nearest if truth.places is None else tree.query(by_similarity)[1]

    def right(chosen: NDArray[np.intp]) -> float:
        return _share((field.material[chosen] == truth.material)[answerable])

    return TruthScore(
        asset_id=asset_id,
        name=truth.name,
        level=truth.level,
        symmetric=truth.symmetric,
        displacement=_mean_distance(annotation.place, true_places),
        label_accuracy=_share(labelled_right[answerable]),
        truth_own=right(nearest),
        valid_share=_share(annotation.valid),
        similarity_displacement=_mean_distance(by_similarity, true_places),
        similarity_accuracy=right(similarity_nearest),
    )


def _mean_distance(
    places: NDArray[np.floating[Any]], true_places: NDArray[np.floating[Any]]
) -> float:
    apart = places.astype(np.float64) - true_places
    return float(np.linalg.norm(apart, axis=1).mean() / VOXEL_SIZE)


def _share(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if flags.size else float("nan")


def read_truth(path: Path) -> Truth:
    """Read one asset's truth; raise InputError if the file is unreadable or holds bad numbers."""
    try:
        data, _ = load_source(path, path.parent, "truth")
        arrays = npz_arrays(data, path, _TRUTH)
        places = npz_arrays(data, path, _PLACES, partial=True).get("places")
    except InputError as error:
        raise InputError(path, f"cannot be read ({error.fault})", error.expected) from None
    transform = arrays["transform"].astype(np.float64)
    if not np.isfinite(transform).all() or not np.linalg.det(transform) > 0:
        raise InputError(path, "transform is not finite or has no inverse", "a similarity")
    if places is not None and not np.isfinite(places).all():
        raise InputError(path, "places are not all finite", "points of the unit cube")
    return Truth(
        path=path,
        transform=transform,
        material=arrays["material"],
        name=str(arrays["name"]),
        level=int(arrays["level"]),
        symmetric=bool(arrays["symmetric"]),
        places=None if places is None else places.astype(np.float64),
    )

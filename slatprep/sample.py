"""Class and properties at SLAT voxels, from the annotated PixieVerse voxels near them.

`sample` looks them up in one field, `merge` combines the results of several fields.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.normalize import from_mapped, to_mapped
from slatprep.parameters import SampleParameters
from slatprep.records import UNANNOTATED, Annotation, Contents, MaterialField, Property

if TYPE_CHECKING:
    from slatprep.geometry.nearest import VoxelIndex


def sample(
    field: MaterialField,
    places: ArrayLike,
    parameters: SampleParameters,
    *,
    labels_alone: bool = False,
) -> Annotation:
    """Look class and properties up at the places (N, 3) of SLAT voxels in the PixieVerse frame.

    Each place takes the values of the nearest annotated voxel (SLAT-Phys, "Physics-to-SLAT
    Annotation Alignment"). With the method ``vote`` it takes the values of the nearest voxel of the
    class that wins a vote of the annotated voxels around it. Background and unannotated voxels
    never count. Places are rounded to float32 first, as a store holds them, so that labels follow
    from the store.

    The result is in SI units. Voxels that are not valid have NaN and the class 255. ``distance``
    [voxel] is to the voxel whose values were taken. For a voxel that is not valid it is to the
    nearest, or infinite with `labels_alone`, which is faster.
    """
    voxels = voxel_index_of(field)
    place = np.asarray(places, dtype=np.float32)
    points = place.astype(np.float64)
    limit = parameters.max_distance * (1.0 + 1e-12) if labels_alone else np.inf
    if parameters.method == "vote":
        distance, used, valid = voxels.voted(
            points, field.material, parameters.vote_width, parameters.max_distance, limit
        )
    else:
        distance, used = voxels.nearest(points, limit)
        valid = distance <= parameters.max_distance
    properties, material = field.properties.take(used, axis=0), field.material.take(used)
    properties[~valid] = np.nan
    material[~valid] = UNANNOTATED
    return Annotation(properties, material, valid, distance.astype(np.float32), place)


TOLERANCE = 1e-5
"""Relative tolerance of the limits of `same_within`."""


@lru_cache(maxsize=1)
def voxel_index_of(field: MaterialField) -> VoxelIndex:
    """Return the index of the field's annotated voxels, cached for repeated lookups."""
    from slatprep.geometry.nearest import VoxelIndex

    return VoxelIndex(field.voxels)


def merge(annotations: Sequence[Annotation], table: Sequence[Property]) -> Annotation:
    """Merge several annotations of the same SLAT voxels, from `in_table`, each with its confidence.

    At each voxel only valid annotations count. A property is their mean, of log10 if `table` says
    so. The class is the most frequent one; the lowest id wins a draw. A voxel is valid if at least
    one annotation gives each property and at least one gives the class. Place and distance come
    from the first annotation. The spread is the square root of the mean squared deviation.

    The confidence is the mean of the valid annotations' confidences, each times a factor. It is 0
    for another class, 1/2 if a property is far from the merged one, and 1 otherwise.
    """
    valid = np.stack([one.valid for one in annotations])
    mapped = np.stack([to_mapped(one.properties, table) for one in annotations])
    there = ~np.isnan(mapped)
    count = there.sum(axis=0)
    of = np.maximum(count, 1)
    # Values are taken relative to the largest, so that equal ones have exactly spread 0.
    most = np.where(there, mapped, -np.inf).max(axis=0)
    mean = most + np.where(there, mapped - most, 0.0).sum(axis=0) / of
    apart = np.where(there, mapped - mean, 0.0)
    spread = np.sqrt((apart**2).sum(axis=0) / of)

    given = np.stack([one.material for one in annotations])
    classes = range(1 + int(given[given != UNANNOTATED].max(initial=0)))
    votes = np.stack([(given == one).sum(axis=0, dtype=np.uint16) for one in classes])
    material = votes.argmax(axis=0).astype(np.uint8)
    some = (count > 0).all(axis=-1) & votes.any(axis=0)

    near = (np.abs(apart) <= same_within(mean, table)).all(axis=-1)
    sure = np.stack([one.confidence for one in annotations if one.confidence is not None])
    agrees = (given == material) | (given == UNANNOTATED)
    counted = np.where(agrees & valid, np.where(near, 1.0, 0.5), 0.0)
    confidence = (sure * counted).sum(axis=0) / np.maximum(valid.sum(axis=0), 1)
    share = votes.max(axis=0) / np.maximum(votes.sum(axis=0), 1)

    spread[count < 2] = np.nan
    mean[~some], spread[~some], material[~some] = np.nan, np.nan, UNANNOTATED
    confidence[~some] = share[~some] = 0.0
    return replace(
        annotations[0],
        properties=from_mapped(mean, table),
        material=material,
        valid=some,
        confidence=confidence.astype(np.float32),
        spread=spread.astype(np.float32),
        votes=share.astype(np.float32),
    )


def same_within(
    mapped: NDArray[np.float64], table: Sequence[Property], least: ArrayLike = 0.0
) -> NDArray[np.float64]:
    """Return the largest deviations from mapped properties (..., P) that count as the same.

    That is a factor of two, a fifth of the value if log10 does not normalise the property, and at
    least `least`. A small tolerance lets what a store rounds count as its source does.
    """
    limits = np.where([one.log10 for one in table], np.log10(2.0), 0.2 * np.abs(mapped))
    return np.maximum(limits, least) * (1.0 + TOLERANCE)


def lacking(field: MaterialField, contents: Contents) -> tuple[str, ...]:
    """Return the names of properties, and ``classes``, that a store has and a field lacks."""
    own = {one.name for one in field.table}
    missing = tuple(one.name for one in contents.properties if one.name not in own)
    return (*missing, "classes") if contents.classes and not field.classified else missing


def in_table(annotation: Annotation, field: MaterialField, contents: Contents) -> Annotation:
    """Return an annotation from a field with the columns of a store, for `merge`.

    Properties that the field lacks are NaN, and the material is 255 if it lacks classes.
    """
    missing = lacking(field, contents)
    own = {one.name: column for column, one in enumerate(field.table)}
    columns = [own.get(one.name, -1) for one in contents.properties]
    properties = annotation.properties[:, columns]
    properties[:, [column < 0 for column in columns]] = np.nan
    unclassed = np.full_like(annotation.material, UNANNOTATED)
    material = unclassed if "classes" in missing else annotation.material
    return replace(annotation, properties=properties, material=material)

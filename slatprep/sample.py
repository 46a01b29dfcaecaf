"""Material and properties at SLAT voxels, from the annotated PixieVerse voxels near them.

`sample` looks them up in one field, `merge` makes one of what several fields say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from slatprep.geometry.frames import voxel_centres
from slatprep.normalize import from_mapped, to_mapped
from slatprep.parameters import SampleParameters
from slatprep.records import (
    RESOLUTION,
    UNANNOTATED,
    Annotation,
    Contents,
    MaterialField,
    Property,
)

if TYPE_CHECKING:
    from slatprep.geometry.nearest import Lattice

NEAR_POWER, NEAR_SHARE = float(np.log10(2.0)), 0.2
"""How far a property may lie off the merged one to count as the same: in log10, a factor of two,
or as a share of the merged value where it is not normalised by log10."""


def sample(
    field: MaterialField,
    places: ArrayLike,
    parameters: SampleParameters,
    *,
    labels_alone: bool = False,
) -> Annotation:
    """Look material and properties up at SLAT voxels.

    Each SLAT voxel, carried into the PixieVerse frame, takes the values of
    an annotated voxel there: the nearest one (SLAT-Phys, "Physics-to-SLAT
    Annotation Alignment"), or the nearest one of the class that the annotated
    voxels around it vote for. Background and unannotated voxels are
    never taken.

    Parameters
    ----------
    field : MaterialField
        The PixieVerse field.
    places : array_like, shape (N, 3)
        Where the SLAT voxels lie in the PixieVerse frame, points of the unit cube;
        `slatprep.align.deformation.PlaceMap` and `slatprep.geometry.frames.places_of`
        carry them there. They are rounded to float32 first: a store holds them
        so, and the labels follow from what it holds.
    parameters : SampleParameters
        The method, and from which distance on a SLAT voxel is not valid.
    labels_alone : bool
        Whether nobody asks how far off the voxels are that are not valid: their
        ``distance`` is then infinite.

    Returns
    -------
    Annotation
        In SI units; NaN and 255 where not valid. ``distance`` is to the voxel
        whose values were taken, or to the nearest where not valid.
    """
    lattice = lattice_of(field)
    place = np.asarray(places, dtype=np.float32)
    points = place.astype(np.float64)
    limit = parameters.max_distance * (1.0 + 1e-12) if labels_alone else np.inf
    distance, used = lattice.nearest(points, limit)
    valid = distance <= parameters.max_distance
    if parameters.method == "vote":
        found = distance, used
        voted = lattice.vote(points, field.material, parameters.vote_width, found)
        changed = valid & (voted >= 0) & (voted != used)
        used = np.where(changed, voted, used)
        apart = points[changed] - voxel_centres(field.voxels[used[changed]])
        distance[changed] = np.linalg.norm(apart, axis=1) * RESOLUTION
    properties, material = field.properties[used], field.material[used]
    properties[~valid] = np.nan
    material[~valid] = UNANNOTATED
    return Annotation(properties, material, valid, distance.astype(np.float32), place)


@lru_cache(maxsize=1)
def lattice_of(field: MaterialField) -> Lattice:
    """Return the field's annotated voxels by cell; a field is looked up several times in a row."""
    from slatprep.geometry.nearest import Lattice

    return Lattice(field.voxels)


def merge(annotations: Sequence[Annotation], table: Sequence[Property]) -> Annotation:
    """Make one annotation of several of the same SLAT voxels.

    At each voxel those that are valid there count. A property is the mean of those that
    have it, of log10 where the table says so, and the class the one that most of them give, of
    several such the one with the lowest id. The voxel is valid where every property, and
    the class, is given by one at least.

    Its confidence is the mean of theirs, each taken fully where it gives no other class
    and each of its properties is near the merged one, by half where a property is not,
    and not at all where it gives another class.

    Parameters
    ----------
    annotations : sequence of Annotation
        As `in_table` gives them, each with its confidence; place and distance are taken from
        the first.
    table : sequence of Property
        What their P properties are.

    Returns
    -------
    Annotation
        In SI units, with spread and votes. The spread is that of the annotations
        themselves: the square root of the mean squared deviation.
    """
    valid = np.stack([one.valid for one in annotations])
    mapped = np.stack([to_mapped(one.properties, table) for one in annotations])
    there = ~np.isnan(mapped)
    count = there.sum(axis=0)
    of = np.maximum(count, 1)
    # From the largest: where all are the same, the mean is that and the spread nothing.
    most = np.where(there, mapped, -np.inf).max(axis=0)
    mean = most + np.where(there, mapped - most, 0.0).sum(axis=0) / of
    apart = np.where(there, mapped - mean, 0.0)
    spread = np.sqrt((apart**2).sum(axis=0) / of)

    given = np.stack([one.material for one in annotations])
    classes = range(1 + int(given[given != UNANNOTATED].max(initial=0)))
    votes = np.stack([(given == one).sum(axis=0, dtype=np.uint16) for one in classes])
    material = votes.argmax(axis=0).astype(np.uint8)
    some = (count > 0).all(axis=-1) & votes.any(axis=0)

    powers = np.array([one.log10 for one in table])
    limit = np.where(powers, NEAR_POWER, NEAR_SHARE * np.abs(mean))
    near = (np.abs(apart) <= limit * (1.0 + 1e-6)).all(axis=-1)
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


def lacking(field: MaterialField, contents: Contents) -> tuple[str, ...]:
    """Return what a store holds and a field says nothing of: names of properties, ``classes``."""
    own = {one.name for one in field.table}
    missing = tuple(one.name for one in contents.properties if one.name not in own)
    return (*missing, "classes") if contents.classes and not field.classified else missing


def in_table(annotation: Annotation, field: MaterialField, contents: Contents) -> Annotation:
    """Return an annotation with the columns of a store, as `merge` takes it.

    Parameters
    ----------
    annotation : Annotation
        Looked up in the field.
    field : MaterialField
        Its properties are among those of the store.
    contents : Contents
        What the store holds. Of properties that the field lacks, the values are NaN, and
        the material is 255 where it lacks classes.
    """
    missing = lacking(field, contents)
    own = {one.name: column for column, one in enumerate(field.table)}
    columns = [own.get(one.name, -1) for one in contents.properties]
    properties = annotation.properties[:, columns]
    properties[:, [column < 0 for column in columns]] = np.nan
    material = annotation.material
    if "classes" in missing:
        material = np.full_like(material, UNANNOTATED)
    return replace(annotation, properties=properties, material=material)

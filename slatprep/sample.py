"""Material and properties at SLAT voxels, from the annotated PixieVerse voxels near them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from slatprep.geometry.frames import voxel_centres
from slatprep.parameters import SampleParameters
from slatprep.records import RESOLUTION, UNANNOTATED, Annotation, MaterialField


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
    from slatprep.geometry.nearest import Lattice

    lattice = Lattice(field.voxels)
    place = np.asarray(places, dtype=np.float32)
    points = place.astype(np.float64)
    limit = parameters.max_distance * (1.0 + 1e-12) if labels_alone else np.inf
    distance, used = lattice.nearest(points, limit)
    valid = distance <= parameters.max_distance
    if parameters.method == "vote":
        voted = lattice.vote(points, field.material, parameters.vote_width)
        changed = valid & (voted >= 0) & (voted != used)
        used = np.where(changed, voted, used)
        apart = points[changed] - voxel_centres(field.voxels[used[changed]])
        distance[changed] = np.linalg.norm(apart, axis=1) * RESOLUTION
    properties, material = field.properties[used], field.material[used]
    properties[~valid] = np.nan
    material[~valid] = UNANNOTATED
    return Annotation(properties, material, valid, distance.astype(np.float32), place)

"""Material and properties at SLAT voxels, from the nearest annotated PixieVerse voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.geometry import apply_transform, invert_transform, voxel_centres
from slatprep.parameters import SampleParameters
from slatprep.records import UNANNOTATED, Annotation, MaterialField


def sample(
    field: MaterialField,
    coords: NDArray[np.uint8],
    transform: ArrayLike,
    parameters: SampleParameters,
) -> Annotation:
    """Look material and properties up at SLAT voxels.

    Each SLAT voxel is carried into the PixieVerse frame and takes the values of
    the nearest annotated voxel there; background and unannotated voxels are
    never anyone's label (SLAT-Phys, "Physics-to-SLAT Annotation Alignment").

    Parameters
    ----------
    field : MaterialField
        The PixieVerse field.
    coords : ndarray of uint8, shape (N, 3)
        SLAT voxels.
    transform : array_like, shape (4, 4)
        PixieVerse frame to SLAT frame.
    parameters : SampleParameters
        ``max_distance``: beyond this many voxels a SLAT voxel is not valid.

    Returns
    -------
    Annotation
        In SI units; NaN and 255 where not valid.
    """
    from slatprep.lattice import nearest_voxel

    points = apply_transform(invert_transform(transform), voxel_centres(coords))
    distance, nearest = nearest_voxel(points, field.voxels)
    valid = distance <= parameters.max_distance
    properties = np.where(valid[:, None], field.properties[nearest], np.float32(np.nan))
    material = np.where(valid, field.material[nearest], np.uint8(UNANNOTATED))
    return Annotation(
        properties=properties.astype(np.float32),
        material=material.astype(np.uint8),
        valid=valid,
        distance=distance.astype(np.float32),
    )

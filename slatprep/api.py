"""The stages on plain arrays, with defaults, for notebooks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.align import align
from slatprep.geometry.deformation import PlaceMap, map_of
from slatprep.geometry.voxels import flat_index, occupancy_of, voxels_of
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.parameters.files import checked
from slatprep.records import (
    MAX_LATENT_RESOLUTION,
    RESOLUTION,
    UNANNOTATED,
    Alignment,
    Annotation,
    MaterialField,
    StructuredLatents,
)
from slatprep.sample import sample


def align_voxels(
    pixieverse: ArrayLike,
    slat: ArrayLike,
    parameters: AlignParameters | None = None,
    *,
    resolution: int = RESOLUTION,
) -> Alignment:
    """Find the map that lays one voxel set on another.

    Parameters
    ----------
    pixieverse : array_like
        The PixieVerse side: an occupancy, (64, 64, 64) bool with axes x, y, z,
        or the occupied voxels, (K, 3) in 0..63. Solid or shell.
    slat : array_like
        The SLAT side, in either form, on its own grid; a leading batch column of
        zeros, (N, 4), is dropped.
    parameters : AlignParameters, optional
        Engine, model and scale bounds; by default those of a build.
    resolution : int
        Voxels of the SLAT's grid along each axis.

    Returns
    -------
    Alignment
        ``transform`` (4, 4) takes points of the PixieVerse frame to points of
        the SLAT frame, both the unit cube [-0.5, 0.5]^3. Further fields are ``quality``,
        the score of every candidate, and the ``deformation`` if the shapes differ.
        `slatprep.map_of` returns its map of points, in both directions.

    Raises
    ------
    ValueError
        If a voxel set is empty, has another shape, or leaves the grid.
    ConfigError
        If a parameter makes no sense.

    Notes
    -----
    The problem is that of SLAT-Phys, "Physics-to-SLAT Annotation
    Alignment"; the default engine is described in docs/method.md.

    Examples
    --------
    An L, and the same L after a quarter turn about z:

    >>> import numpy as np
    >>> shape = np.zeros((64, 64, 64), dtype=bool)
    >>> shape[20:44, 22:36, 26:34] = shape[20:26, 22:36, 34:50] = True
    >>> turned = np.rot90(shape, axes=(0, 1))
    >>> alignment = align_voxels(shape, turned)
    >>> (alignment.transform[:3, :3].round(2) + 0.0).tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    >>> round(alignment.quality.fitness, 2)
    1.0
    """
    source, target = _voxels(pixieverse, "pixieverse"), _voxels(slat, "slat", resolution)
    field = MaterialField(
        occupancy=occupancy_of(source),
        voxels=source,
        material=np.zeros(len(source), dtype=np.uint8),
        properties=np.ones((len(source), 3), dtype=np.float32),
    )
    feats = np.zeros((len(target), 8), dtype=np.float32)
    latents = StructuredLatents(target, feats, resolution=resolution)
    return align(field, latents, checked(AlignParameters, parameters or AlignParameters()))


def annotate_voxels(
    field: MaterialField,
    coords: ArrayLike,
    transform: Alignment | ArrayLike,
    parameters: SampleParameters | None = None,
    *,
    resolution: int = RESOLUTION,
) -> Annotation:
    """Look the material and its properties up at SLAT voxels.

    Parameters
    ----------
    field : MaterialField
        The PixieVerse field, as `read_field` gives it.
    coords : array_like, shape (N, 3)
        SLAT voxels in 0..resolution - 1.
    transform : Alignment, or array_like, shape (4, 4)
        An alignment from `align_voxels`, used with its deformation; or a similarity
        from the PixieVerse frame to the SLAT frame.
    parameters : SampleParameters, optional
        Largest distance of an annotation, and the method; by default those of a build.
    resolution : int
        Voxels of the SLAT's grid along each axis.

    Returns
    -------
    Annotation
        Properties in SI units (N, 3), material (N,), valid (N,), distance (N,)
        in voxels, and place (N, 3) in the PixieVerse frame.

    Raises
    ------
    ValueError
        If `coords` are no voxels, `transform` is no similarity, or the field's voxels, classes
        and properties do not fit together, or are not those of annotated voxels, each once.
    ConfigError
        If a parameter makes no sense.
    """
    if isinstance(transform, Alignment):
        place_map = map_of(transform)
    else:
        place_map = PlaceMap(np.asarray(transform, dtype=np.float64))
    places = place_map.places(_voxels(coords, "coords", resolution), resolution)
    parameters = checked(SampleParameters, parameters or SampleParameters())
    return sample(_checked(field), places, parameters)


def _checked(field: MaterialField) -> MaterialField:
    """Return a field with the arrays that lookups rely on; ValueError if they do not fit."""
    voxels = _voxels(field.voxels, "field.voxels")
    material, properties = np.asarray(field.material), np.asarray(field.properties)
    for name, values, shape in (
        ("material", material, (len(voxels),)),
        ("properties", properties, (len(voxels), len(field.table))),
    ):
        if values.shape != shape:
            raise ValueError(f"field.{name} has shape {values.shape}; expected {shape}")
    if not ((material >= 0) & (material < UNANNOTATED) & (material == np.floor(material))).all():
        raise ValueError(
            f"field.material has values that are no classes; expected 0 to {UNANNOTATED - 1}"
        )
    if len(np.unique(flat_index(voxels))) < len(voxels):
        raise ValueError("field.voxels has a voxel twice; expected each annotated voxel once")
    properties = properties.astype(np.float32)
    for of, values in zip(field.table, properties.T, strict=True):
        wrong = values[~(np.isfinite(values) & ((values > 0) | (not of.log10)))]
        if wrong.size:
            expected = "numbers above 0" if of.log10 else "finite numbers"
            raise ValueError(f"field.properties has {of.name} {wrong[0]:g}; expected {expected}")
    return replace(field, voxels=voxels, material=material.astype(np.uint8), properties=properties)


def _voxels(voxels: ArrayLike, name: str, side: int = RESOLUTION) -> NDArray[np.uint8]:
    """Return voxels (N, 3) uint8 of an occupancy or of a list of voxels."""
    if not 2 <= side <= MAX_LATENT_RESOLUTION:
        raise ValueError(f"resolution is {side}; expected 2 to {MAX_LATENT_RESOLUTION}")
    array: NDArray[Any] = np.asarray(voxels)
    if array.shape == (side,) * 3:
        if not np.isin(array, (0, 1)).all():
            raise ValueError(f"{name} is an occupancy with values other than 0 and 1; threshold it")
        array = voxels_of(array.astype(bool))
    if array.ndim == 2 and array.shape[1] == 4 and not array[:, 0].any():
        array = array[:, 1:]
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise ValueError(
            f"{name} has shape {array.shape}; expected an occupancy of {(side,) * 3} with a voxel "
            "in it, or voxels (N, 3)"
        )
    if not ((array >= 0) & (array < side) & (array == np.floor(array))).all():
        raise ValueError(
            f"{name} has values from {array.min()} to {array.max()}; "
            f"expected whole numbers in 0..{side - 1}"
        )
    return array.astype(np.uint8)

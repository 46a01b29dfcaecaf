"""USD of particles for Newton and Isaac Lab: a file for each asset, and a scene of all.

The schemas are those of newton-usd-schemas 0.6, which Newton 1.8 reads with
``ModelBuilder.add_usd``: ``NewtonPointsDeformableSimAPI`` on the points, ``NewtonMPMMaterialAPI``
on the materials, ``NewtonMPMSceneAPI`` on the scene. They are written by name, so that only
usd-core is needed.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, needing
from slatprep.export import formats
from slatprep.records import COLOURS, MATERIAL_CLASSES, RESOLUTION
from slatprep.records.yielding import MAX_POISSON, YIELDING
from slatprep.storage.files import file_name
from slatprep.store import Store, StoredAsset

SCENE = "scene.usda"

YIELDING_ATTRIBUTES = {
    "friction": "internalFriction",
    "pressure": "yieldPressure",
    "tension": "tensileYieldRatio",
    "stress": "yieldStress",
    "hardening": "hardening",
    "dilatancy": "dilatancy",
    "viscosity": "viscosity",
}
"""The ``newton:mpm`` attribute of each field of `Yielding`."""

_PITCH = 1.25
"""Distance between neighbours in the scene, in sizes of the unit cube."""


@contextmanager
def _disk_errors() -> Iterator[None]:
    """Turn an error of USD into an OSError, as the disk did not take a file."""
    (tf,) = _pxr("Tf")
    try:
        yield
    except tf.ErrorException as error:
        # It has a line for each block, all with the same reason.
        reason = next(iter(re.findall(r" : '(?:.*writing file: )?([^'\n]+)", str(error))), "")
        full = (n for n in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) if os.strerror(n) in reason)
        raise OSError(next(full, errno.EIO), reason or "USD did not say why") from None


def writer(store: Store, ids: Sequence[str], options: formats.ExportOptions) -> formats.Writer:
    """Return the writer of a USD file for each asset; see `slatprep.export.FORMATS`.

    ConfigError if `options.materials` is less than the number of classes, the size is beyond
    reason, or usd-core is missing.
    """
    least = len(YIELDING)
    if options.materials < least:
        raise ConfigError(f"materials is {options.materials}; expected {least} or more")
    if not 1e-6 <= options.size <= 1e6:  # float32 cannot hold the masses of others.
        raise ConfigError(f"size is {options.size:g}; expected a length of 1e-06 to 1e+06 m")
    formats.require_solver_classes(store)
    _pxr("Usd")
    points = options.points or "grid"
    one = partial(write, points, options.size, options.materials)
    finish = partial(write_scene, options.size)
    return formats.one_by_one(one, finish=finish, points=points, remarks=_remarks)


def write(
    points: formats.Points, size: float, materials: int, directory: Path, asset: StoredAsset
) -> formats.Exported:
    """Write ``<id>.usdc`` of an asset, its unit cube `size` metres wide."""
    there = formats.annotated_points(asset, points)
    solid = there.solid(asset).astype(np.float64)
    clipped = int(np.count_nonzero(solid[:, 2] > MAX_POISSON))
    solid[:, 2] = np.minimum(solid[:, 2], MAX_POISSON)
    name = f"{file_name(asset.asset_id)}.usdc"
    binned = bin_materials(there.material, solid, materials)
    volumes = size**3 * _volumes(asset, there)
    width = float(np.cbrt(volumes.mean())) if len(volumes) else size / RESOLUTION
    masses = solid[:, 1] * volumes
    places = there.in_slat * size
    _write_asset(directory / name, asset.asset_id, places, width, masses, solid, binned)
    figures = {
        "spacing": width,
        "materials": len(binned.material),
        "kilograms": float(masses.sum()),
        "E_error": binned.modulus_error,
        "nu_error": binned.ratio_error,
        "nu_clipped": clipped,
    }
    return formats.Exported(asset, name, len(there.material), figures)


@_disk_errors()
def write_scene(size: float, directory: Path, entries: Sequence[dict[str, Any]]) -> list[str]:
    """Write the scene: gravity, ground, and a reference to each asset; return its name."""
    geom, tf = _pxr("UsdGeom", "Tf")
    stage, _ = _stage(directory / SCENE, "/World")
    # The solver has one grid for all assets: as fine as the finest needs.
    _simulation(stage, "/World", min(entry["spacing"] for entry in entries))
    columns = int(np.ceil(np.sqrt(len(entries))))
    for number, entry in enumerate(entries):
        row, column = divmod(number, columns)
        label = tf.MakeValidIdentifier(f"a{number:04d}_{entry['asset_id']}")
        one = geom.Xform.Define(stage, f"/World/{label}")
        one.GetPrim().GetReferences().AddReference(f"./{entry['file']}")
        one.GetPrim().SetCustomDataByKey("slatprep:asset_id", entry["asset_id"])
        # A second operation: that of the asset's file lifts it onto the ground.
        place = one.AddTranslateOp(opSuffix="place")
        place.Set(tuple(float(_PITCH * size * step) for step in (column, row, 0)))
    stage.GetRootLayer().Save()
    return [SCENE]


@_disk_errors()
def _write_asset(
    path: Path,
    asset_id: str,
    positions: NDArray[np.float64],
    width: float,
    masses: NDArray[np.float64],
    solid: NDArray[np.float64],
    binned: Binned,
) -> None:
    """Write an asset: points (N, 3) about `width` wide [m], masses (N,) [kg], `solid` (N, 3).

    The columns of `solid` are E [Pa], density [kg/m^3] and nu.
    """
    geom, sdf, vt, shade = _pxr("UsdGeom", "Sdf", "Vt", "UsdShade")
    stage, root = _stage(path, "/Asset")
    root.GetPrim().SetCustomDataByKey("slatprep:asset_id", asset_id)
    _simulation(stage, "", width)
    lowest = float(positions[:, 2].min()) if len(positions) else 0.0
    root.AddTranslateOp(opSuffix="lift").Set((0.0, 0.0, width / 2 - lowest))
    if len(positions):
        points = geom.Points.Define(stage, "/Asset/Points")
        prim = points.GetPrim()
        prim.AddAppliedSchema("NewtonPointsDeformableSimAPI")
        prim.AddAppliedSchema("PhysicsDeformableBodyAPI")
        points.CreatePointsAttr(vt.Vec3fArray.FromNumpy(positions.astype(np.float32)))
        points.CreateWidthsAttr([width])
        points.SetWidthsInterpolation(geom.Tokens.constant)
        half = np.full(3, width / 2)
        extent = np.array([positions.min(axis=0) - half, positions.max(axis=0) + half])
        points.CreateExtentAttr(vt.Vec3fArray.FromNumpy(extent.astype(np.float32)))
        kind = sdf.ValueTypeNames.FloatArray
        written = vt.FloatArray.FromNumpy(masses.astype(np.float32))
        prim.CreateAttribute("physics:masses", kind, custom=False).Set(written)
        colours = (COLOURS[binned.material[binned.rows]] / 255).astype(np.float32)
        shown = points.CreateDisplayColorPrimvar(geom.Tokens.vertex)
        shown.Set(vt.Vec3fArray.FromNumpy(colours))
        binding = shade.MaterialBindingAPI.Apply(prim)
        for number, material in enumerate(binned.material):
            _add_material(stage, binding, number, int(material), solid, binned)
        binding.SetMaterialBindSubsetsFamilyType(geom.Tokens.nonOverlapping)
    stage.GetRootLayer().Save()


def _add_material(
    stage: Any, binding: Any, number: int, material: int, solid: NDArray[np.float64], binned: Binned
) -> None:
    """Add a material, and the subset of the points that it is bound to."""
    geom, sdf, vt, shade = _pxr("UsdGeom", "Sdf", "Vt", "UsdShade")
    name = f"{MATERIAL_CLASSES[material]}_{number:03d}"
    made = shade.Material.Define(stage, f"/Asset/Materials/{name}")
    prim = made.GetPrim()
    prim.AddAppliedSchema("PhysicsMaterialAPI")
    prim.AddAppliedSchema("NewtonMPMMaterialAPI")
    rows = np.flatnonzero(binned.rows == number)
    figures = {
        "physics:density": float(solid[rows, 1].mean()),
        "newton:mpm:youngsModulus": binned.modulus[number],
        "newton:mpm:poissonsRatio": binned.ratio[number],
    }
    for field, value in YIELDING[material]._asdict().items():
        figures[f"newton:mpm:{YIELDING_ATTRIBUTES[field]}"] = value
    for attribute, value in figures.items():
        prim.CreateAttribute(attribute, sdf.ValueTypeNames.Float, custom=False).Set(float(value))
    indices = vt.IntArray.FromNumpy(rows.astype(np.int32))
    subset = binding.CreateMaterialBindSubset(name, indices, geom.Tokens.point)
    shade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(made, materialPurpose="physics")


def _simulation(stage: Any, parent: str, width: float) -> None:
    """Add solver, gravity and ground for a simulation of particles `width` [m] wide."""
    geom, physics, sdf = _pxr("UsdGeom", "UsdPhysics", "Sdf")
    scene = physics.Scene.Define(stage, f"{parent}/PhysicsScene")
    scene.CreateGravityDirectionAttr((0.0, 0.0, -1.0))
    scene.CreateGravityMagnitudeAttr(9.81)
    prim = scene.GetPrim()
    prim.AddAppliedSchema("NewtonSceneAPI")
    prim.AddAppliedSchema("NewtonMPMSceneAPI")
    types = sdf.ValueTypeNames
    for name, kind, value in (
        ("newton:maxSolverIterations", types.Int, 100),
        ("newton:mpm:voxelSize", types.Float, 2 * width),
        ("newton:mpm:tolerance", types.Float, 1e-6),
        # With one strain per cell, Newton's default, stiff solids creep.
        ("newton:mpm:strainBasisType", types.Token, "linear"),
        ("newton:mpm:strainBasisOrder", types.Int, 1),
        ("newton:mpm:strainDiscontinuousBasis", types.Bool, True),
    ):
        variability = sdf.VariabilityUniform
        prim.CreateAttribute(name, kind, custom=False, variability=variability).Set(value)
    ground = geom.Plane.Define(stage, f"{parent}/Ground")
    ground.CreateAxisAttr("Z")
    physics.CollisionAPI.Apply(ground.GetPrim())


def _stage(path: Path, name: str) -> tuple[Any, Any]:
    """Return a new stage in metres and kilograms, z up, and its root of that name."""
    usd, geom, physics = _pxr("Usd", "UsdGeom", "UsdPhysics")
    stage = usd.Stage.CreateNew(str(path))
    geom.SetStageMetersPerUnit(stage, 1.0)
    physics.SetStageKilogramsPerUnit(stage, 1.0)
    geom.SetStageUpAxis(stage, geom.Tokens.z)
    root = geom.Xform.Define(stage, name)
    stage.SetDefaultPrim(root.GetPrim())
    return stage, root


def _volumes(asset: StoredAsset, there: formats.AnnotatedPoints) -> NDArray[np.float64]:
    """Return the volume (N,) of each point's voxel, in the SLAT's unit cube."""
    if there.place_map is None:
        return np.full(len(there.in_slat), asset.store.contents.latents.resolution**-3.0)
    return there.place_map.volume_ratios(there.in_slat) / RESOLUTION**3


def _remarks(entries: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """Return remarks on what binning and clipping changed."""
    modulus = max(entry["E_error"] for entry in entries)
    ratio = max(entry["nu_error"] for entry in entries)
    most = max(entry["materials"] for entry in entries)
    changed = f"E differs from the store by at most {modulus:.2%}, nu by at most {ratio:.2g}"
    if modulus < 1e-5 and ratio < 1e-5:
        changed = "E and nu are those of the store"
    remarks = [f"up to {most} materials an asset: {changed}; --materials sets how many"]
    if clipped := sum(entry["nu_clipped"] for entry in entries):
        remarks.append(f"nu of {clipped:,} points was above {MAX_POISSON} and is written so")
    return tuple(remarks)


def _pxr(*names: str) -> list[Any]:
    """Import modules of OpenUSD."""
    with needing("USD needs", "usd"):
        return [import_module(f"pxr.{name}") for name in names]


_FINEST = 1e-6
"""Relative width of the finest bins of E; smaller differences are float32's rounding."""

_RATIO = 0.25
"""Width of the bins of nu if the bins of E have relative width 1: 0.25 spans the usual range."""


class Binned(NamedTuple):
    """M materials: class, E [Pa] and nu of each, the material of each row (N,), largest errors."""

    material: NDArray[np.uint8]
    modulus: NDArray[np.float64]
    ratio: NDArray[np.float64]
    rows: NDArray[np.intp]
    modulus_error: float
    ratio_error: float


def bin_materials(material: NDArray[np.uint8], solid: NDArray[np.float64], most: int) -> Binned:
    """Bin rows of a class, E, density, nu (N, 3) into at most `most` materials.

    Bins are as fine as `most` allows, and no bin has rows of two classes. E and nu of a bin
    lie in the middle of its members (E in its logarithm), which makes the largest error least.
    """
    from scipy import ndimage

    logarithm = np.log10(solid[:, 0])
    if not len(solid):
        return Binned(material, logarithm, logarithm, np.zeros(0, np.intp), 0.0, 0.0)
    width = _FINEST
    while True:
        by_modulus = _cover(logarithm, np.log10(1 + width), most)
        by_ratio = _cover(solid[:, 2], _RATIO * width, most)
        if by_modulus is not None and by_ratio is not None:
            keys = np.stack([material, by_modulus, by_ratio], axis=1)
            bins, rows = np.unique(keys, axis=0, return_inverse=True)
            if len(bins) <= most:
                break
        width *= 1.25
    rows, every = rows.reshape(-1), np.arange(len(bins))
    middle = [
        (ndimage.minimum(values, rows, every) + ndimage.maximum(values, rows, every)) / 2
        for values in (logarithm, solid[:, 2])
    ]
    modulus, ratio = 10 ** middle[0], middle[1]
    return Binned(
        bins[:, 0].astype(np.uint8),
        modulus,
        ratio,
        rows,
        float(np.abs(modulus[rows] / solid[:, 0] - 1).max(initial=0.0)),
        float(np.abs(ratio[rows] - solid[:, 2]).max(initial=0.0)),
    )


def _cover(values: NDArray[np.float64], width: float, most: int) -> NDArray[np.intp] | None:
    """Return the bin of each value (N,), with the fewest bins of `width`; None if above `most`."""
    ordered = np.unique(values)
    starts: list[int] = []
    next_start = 0
    while next_start < len(ordered):
        if len(starts) == most:
            return None
        starts.append(next_start)
        next_start = int(np.searchsorted(ordered, ordered[next_start] + width, side="right"))
    return np.searchsorted(ordered[starts], values, side="right") - 1

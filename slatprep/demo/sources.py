"""Write demo data in the layouts of sources other than PixieVerse.

`write_vomp`, `write_physxnet` and `write_voxels` take plain arrays, so that they can also write
other data in these layouts.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.records import BACKGROUND, PROPERTIES
from slatprep.storage.arrays import write_ply

Source = Literal[
    "pixieverse", "pixie-predictions", "pixie-prediction-ids",
    "vomp", "physxnet", "voxels-npz", "voxels-hdf5", "voxels-zarr", "voxels-ply",
]  # fmt: skip
"""Source of a demo's annotated side, with its form."""

ONE_FRAME = ("vomp", "physxnet")
"""Sources whose voxels come from the same mesh as the latents."""

CLASSES = ("elastic", "metal", "granular", "viscous", "liquid", "snow", "rigid")
"""Names of the classes 0 to 6 in a demo's plain voxels."""

# Columns: friction angle, damping, restitution, friction, and the two conductivities.
_BY_CLASS = np.array([
    [0.0, 0.20, 0.60, 0.80, 0.2, 1e-9],
    [0.0, 0.02, 0.50, 0.40, 50.0, 1e7],
    [34.0, 0.60, 0.05, 0.60, 0.3, 1e-4],
    [12.0, 0.70, 0.10, 0.50, 0.8, 1e-2],
    [0.0, 0.90, 0.00, 0.01, 0.6, 5e-2],
    [25.0, 0.80, 0.02, 0.10, 0.1, 1e-6],
    [0.0, 0.05, 0.40, 0.50, 2.0, 1e-12],
])  # fmt: skip

TABLE: tuple[dict[str, Any], ...] = (
    {"name": "density", "unit": "kg/m^3", "scale": "log10"},
    {"name": "youngs_modulus", "unit": "Pa", "scale": "log10"},
    {"name": "poissons_ratio", "unit": "1", "scale": "linear", "least": 0, "most": 0.5},
    {"name": "yield_stress", "unit": "Pa", "scale": "log10"},
    {"name": "friction_angle", "unit": "degree", "scale": "linear", "least": 0, "most": 90},
    {"name": "damping", "unit": "1", "scale": "linear", "least": 0, "most": 1},
    {"name": "restitution", "unit": "1", "scale": "linear", "least": 0, "most": 1},
    {"name": "friction", "unit": "1", "scale": "linear", "least": 0, "most": 2},
    {"name": "thermal_conductivity", "unit": "W/(m K)", "scale": "log10"},
    {"name": "electrical_conductivity", "unit": "S/m", "scale": "log10"},
)
"""Properties of a demo's plain voxels, in the form of ``source.json``."""


def columns_of(
    source: Source, material: NDArray[Any], properties: NDArray[np.float32]
) -> dict[str, NDArray[np.float32]]:
    """Return the properties (K,) that a source has, by name, in SI units.

    `material` (K,) are classes 0..6, `properties` (K, 3) Young's modulus, density and Poisson's
    ratio. Other properties are computed: the yield stress is 1 % of the modulus, the rest are
    values by class, multiplied by 0.5 to 1.5 depending on Poisson's ratio.
    """
    known = dict(zip((one.name for one in PROPERTIES), properties.T, strict=True))
    if source == "physxnet":
        return {"density": known["density"]}
    if not source.startswith("voxels"):
        return known
    factor = np.clip(0.5 + 2.0 * known["poissons_ratio"], 0.5, 1.5)[:, None]
    others = (_BY_CLASS[material.astype(np.intp)] * factor).astype(np.float32)
    others[:, 1:3] = np.minimum(others[:, 1:3], 1.0)
    known["yield_stress"] = np.float32(0.01) * known["youngs_modulus"]
    known |= dict(zip((str(one["name"]) for one in TABLE[4:]), others.T, strict=True))
    return {str(one["name"]): known[str(one["name"])] for one in TABLE}


def classes_of(source: Source) -> tuple[str, ...]:
    """Return the classes of a demo's plain voxels; HDF5 has none."""
    return () if source == "voxels-hdf5" else CLASSES


def write_field(
    root: Path, source: Source, name: str, grid: NDArray[np.float32], surface: NDArray[np.uint8]
) -> None:
    """Write the annotated side of an object, for any source but Pixie's.

    `grid` (64, 64, 64, 4) has PixieVerse's format; voxels of class -1 are omitted. `surface` (N, 3)
    are the voxels of the object's SLAT, which PhysXNet annotates.
    """
    known = (grid[..., 3] >= 0) & (grid[..., 3] < BACKGROUND)
    voxels = np.argwhere(known)
    if source == "physxnet":
        voxels = surface.astype(np.intp)[known[tuple(surface.T)]]
    rows = grid[tuple(voxels.T)]
    material = rows[:, 3].astype(np.uint8)
    columns = columns_of(source, material, rows[:, [1, 0, 2]])
    if source == "vomp":
        write_vomp(root, name, voxels, columns)
    elif source == "physxnet":
        write_physxnet(root, name, voxels, columns["density"])
    else:
        form = source.removeprefix("voxels-")
        extra = {"material": material} if classes_of(source) else {}
        write_voxels(root, name, form, {"voxels": voxels.astype(np.int32)} | columns | extra)


def write_vomp(
    root: Path, name: str, voxels: NDArray[Any], columns: Mapping[str, NDArray[np.float32]]
) -> None:
    """Write voxels (K, 3) of 64^3 as VoMP does, in a structured array with their lower corners."""
    names = ("x", "y", "z", "youngs_modulus", "poissons_ratio", "density")
    rows = np.zeros(len(voxels), [*((key, "<f4") for key in names), ("segment_id", "<U32")])
    for key, axis in zip("xyz", voxels.T, strict=True):
        rows[key] = axis / 64.0 - 0.5
    for key in names[3:]:
        rows[key] = columns[key]
    rows["segment_id"] = "segment_0"
    folder = root / "voxels"
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / f"{name}_with_materials.npz", voxel_data=rows)


def write_physxnet(
    root: Path, name: str, voxels: NDArray[Any], density: NDArray[np.float32]
) -> None:
    """Write voxels (K, 3) of 64^3 and their density [kg/m^3] as PhysX-3D's toolkit does."""
    for folder in ("property", "voxels"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    rows = np.full((len(voxels), 14), -1.0)
    rows[:, 0] = 30.0  # the object's largest dimension [cm]
    rows[:, 1] = 1.0  # rank of the part by its probability of being touched
    rows[:, 2] = density / 1000.0  # g/cm^3
    rows[:, 3] = rows[:, 13] = 0.0  # the group that moves together, and its kind of motion
    np.save(root / "property" / f"{name}2.npy", rows)
    write_points(root / "voxels" / f"{name}.ply", {
        axis: ((one + 0.5) / 64.0 - 0.5).astype(np.float32)
        for axis, one in zip("xyz", voxels.T, strict=True)
    })  # fmt: skip


def write_points(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write points as a binary PLY with a property for each column (K,)."""
    dtype = np.dtype([(key, array.dtype.newbyteorder("<")) for key, array in columns.items()])
    write_ply(path, np.rec.fromarrays(list(columns.values()), dtype=dtype))


def write_description(
    root: Path,
    properties: tuple[dict[str, Any], ...],
    classes: tuple[str, ...] | bool,
    **others: object,
) -> None:
    """Write ``source.json`` of plain voxels, with the names of its classes, if it has any."""
    root.mkdir(parents=True, exist_ok=True)
    about = {"properties": properties, "classes": classes or False, **others}
    write_json(root / "source.json", about)


def write_json(path: Path, value: object) -> None:
    """Write JSON with a line for each value."""
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def write_hdf5(path: Path, arrays: Mapping[str, NDArray[Any]], below: str = "") -> None:
    """Write arrays to a new file, or add them to a file, in the group `below` (``name/``)."""
    import h5py

    with h5py.File(path, "a" if below else "w") as file:
        for key, array in arrays.items():
            file.create_dataset(below + key, data=array, track_times=False)


def write_voxels(root: Path, name: str, form: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write plain voxels of an object: ``voxels`` (K, 3) and a column (K,) for each property.

    `form` is ``npz``, ``hdf5``, ``zarr`` or ``ply``; a PLY has the voxels' centres as points.
    """
    root.mkdir(parents=True, exist_ok=True)
    if form == "npz":
        np.savez(root / f"{name}.npz", **dict[str, Any](arrays))
    elif form == "hdf5":
        write_hdf5(root / f"{name}.h5", arrays)
    elif form == "zarr":
        import zarr

        group = zarr.open_group(root / f"{name}.zarr", mode="w", zarr_format=3)
        for key, array in arrays.items():
            # With all chunks written, a chunk that is missing later is known to be lost.
            group.create_array(
                key, data=np.ascontiguousarray(array), config={"write_empty_chunks": True}
            )
    else:
        columns = {key: array for key, array in arrays.items() if key != "voxels"}
        points = ((arrays["voxels"] + 0.5) / 64.0 - 0.5).astype(np.float32)
        write_points(root / f"{name}.ply", dict(zip("xyz", points.T, strict=True)) | columns)

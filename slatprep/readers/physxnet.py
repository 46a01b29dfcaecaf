"""PhysXNet and similar datasets, as voxels of PhysX-3D's toolkit or as meshes of parts.

The toolkit's ``voxelize.py`` writes the centres of an object's voxels, which are TRELLIS's, to
``voxels/<id>.ply``. Each voxel has a row of ``property/<id>2.npy``, which begins with the object's
largest dimension [cm], the part's rank in touching, and its density [g/cm^3]. Its movement group,
that group's parent, eight numbers of the movement, and its kind follow. ``property/<id>1.npy``
holds embeddings of text. PhysX-3D's ``tools/1_gptanno.py`` asks for the density in g/cm^3. A part's
annotation reads ``"1.2 g/cm^3"``, and the toolkit keeps the number before the blank.

Objects of parts have no voxels, but a JSON with the material of each part, and a mesh per part.
PhysXNet, PhysX-Mobility and PhysXVerse are published in this form: ``finaljson/<id>.json`` and
``partseg/<id>/objs/<label>.obj``. PhysX-Anything's ``4_simready_gen.py`` reads ``density``,
``"Young's Modulus (GPa)"`` and ``"Poisson's Ratio"`` of each part, and its mesh at
``objs/<label>/<label>.obj``.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep import records
from slatprep.errors import ConfigError, InputError, needing
from slatprep.parameters import PixieverseSource
from slatprep.readers.adapters import FoundField, Holding, SourceAdapter
from slatprep.readers.files import ArraySpec, load_source, npy_array, refusing, require_complete
from slatprep.readers.points import ply_points
from slatprep.readers.voxel_sets import field_of_voxels
from slatprep.records import PROPERTIES, RESOLUTION, AssetPair, MaterialField, Place, oddity
from slatprep.storage.files import Listing

_ROWS = ArraySpec(shapes=((None, 14),), kinds="f", note=", as PhysX-3D's toolkit writes it")
_DENSITY = 2
_TABLE = tuple(one for one in PROPERTIES if one.name == "density")


class PhysXNet(SourceAdapter):
    """``property/<id>2.npy`` and ``voxels/<id>.ply``, in the frame of the SLAT of the same mesh."""

    patterns = ("property/{id}2.npy",)

    def describe(self, source: PixieverseSource) -> Holding:
        """Return the density as the only property, and no classes."""
        return Holding(_TABLE, ())

    def find(self, source: PixieverseSource, listing: Listing) -> Iterator[FoundField]:
        """Find the fields by the names of their files; each also needs a PLY of its voxels."""
        if "finaljson" in listing.of_folder("", folders=True):
            raise ConfigError(
                f"{source.root}: is PhysXNet as it is downloaded, annotations of the parts of "
                "meshes, which have no voxels. Use the adapter `parts`, which voxelises them. "
                "Expected is what PhysX-3D's toolkit makes of it, with property/ and voxels/"
            )
        for found in super().find(source, listing):
            beside, problem = f"voxels/{found.object_id}.ply", found.problem
            if not problem and not listing.is_file(beside):
                problem = (
                    f"{source.root / found.path}: nothing says where its rows lie, as there is no "
                    f"{beside}, which PhysX-3D's toolkit writes with it"
                )
            yield replace(found, beside=(beside,), problem=problem)

    def read(self, pair: AssetPair, max_unphysical: float) -> MaterialField:
        """Read a field; see `slatprep.readers.adapters.SourceAdapter`."""
        path, _ = require_complete(pair)
        root, (beside,) = pair.roots.pixieverse, pair.beside
        data, file = load_source(path, root, "grid")
        rows = npy_array(data, path, _ROWS)
        text, points = load_source(beside, root, "description")
        vertices, _ = ply_points(text, beside)
        if len(rows) != len(vertices):
            expected = f"{len(vertices)}, a row a vertex of {beside.name}"
            raise InputError(path, f"has {len(rows)} rows", expected)
        return field_of_voxels(
            path,
            np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1),
            rows[:, _DENSITY : _DENSITY + 1],
            table=_TABLE,
            bare=_BARE,
            max_unphysical=max_unphysical,
            sources=(file, points),
            frame=np.eye(4),
            roots=pair.roots,
        )


_KEYS: dict[str, tuple[str, tuple[str, ...]]] = {
    "youngs_modulus": ("Young's Modulus (GPa)", ("GPa",)),
    "density": ("density", ("g/cm^3", "kg/m^3")),
    "poissons_ratio": ("Poisson's Ratio", ()),
}
"""Key of each property, and the units that may stand behind a number."""

_BARE = records.Units("GPa", "g/cm^3")
"""Units of numbers without one."""

_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)", re.S)

_MAX_PARTS = 250
"""Largest number of an object's parts and of its meshes, as a record holds 256 files."""


class Parts(SourceAdapter):
    """``finaljson/<id>.json`` and the meshes of its parts, voxelised solid on 64^3."""

    patterns = ("finaljson/{id}.json",)

    def describe(self, source: PixieverseSource) -> Holding:
        """Return PixieVerse's three properties, and no classes."""
        _trimesh()
        return Holding(PROPERTIES, ())

    def find(self, source: PixieverseSource, listing: Listing) -> Iterator[FoundField]:
        """Find the fields by the names of their JSON files."""
        for found in super().find(source, listing):
            beside: tuple[str, ...] = ()
            problem = found.problem
            try:
                beside = tuple(_meshes_of(found.object_id, listing).values())
            except OSError as error:
                problem = problem or f"{error.filename}: cannot be listed ({error.strerror})"
            if len(beside) > _MAX_PARTS:
                many = f"{found.path} has {len(beside)} meshes"
                problem = problem or f"{many}; expected at most {_MAX_PARTS}"
            yield replace(found, beside=beside, problem=problem)

    def read(self, pair: AssetPair, max_unphysical: float) -> MaterialField:
        """Read a field; see `slatprep.readers.adapters.SourceAdapter`."""
        path, _ = require_complete(pair)
        root = pair.roots.pixieverse
        data, file = load_source(path, root, "grid")
        rows = _parts_of(data, path)
        columns, own = [], dict[str, Any]()
        for one in PROPERTIES:
            stated = records.table_of(pair.roots.number) if pair.roots.units.of(one.name) else ""
            column = [_number(part, one.name, stated, path) for part in rows]
            if any(unit for _, unit in column):
                own[one.name] = one.unit  # All are converted here, not after it.
            usual = _BARE.of(one.name) if one.name in own else ""
            columns.append([float(records.to_si(n, unit or usual)) for n, unit in column])
        read = {one.name[:-4]: (one, *load_source(one, root, "description")) for one in pair.beside}
        meshes = []
        for label in (str(part["label"]) for part in rows):
            if label not in read:
                expected = " or ".join(_names(path.name.removesuffix(".json"), label))
                raise InputError(path, f"part {label} has no mesh", expected)
            meshes.append(_mesh(*read[label][:2]))
        voxels, owner = _voxels(meshes, path)
        extra = sorted(read.keys() - {str(part["label"]) for part in rows})
        field = field_of_voxels(
            path,
            voxels,
            np.array(columns).T[owner],
            bare=replace(_BARE, **own),
            max_unphysical=max_unphysical,
            sources=(file, *(source for _, _, source in read.values())),
            roots=pair.roots,
        )
        if extra:
            text = f"{path.name} has no part of the meshes {', '.join(extra)}, which are left out"
            field = replace(field, warnings=(*field.warnings, oddity("places", text)))
        return field


def _parts_of(data: bytes, path: Place) -> list[dict[str, Any]]:
    """Return the parts of a JSON, each with a label."""
    with refusing(path, "is no annotation of parts", 'an object with "parts", each with "label"'):
        parts = orjson.loads(data)["parts"]
        labels = [part["label"] for part in parts]
        if not all(type(label) is int for label in labels) or len({*labels}) < len(labels):
            raise TypeError(f"the labels {labels} are not integers, each of one part")
    if not 0 < len(parts) <= _MAX_PARTS:
        raise InputError(path, f"has {len(parts)} parts", f"1 to {_MAX_PARTS}")
    return list(parts)


def _number(part: dict[str, Any], name: str, stated: str, path: Place) -> tuple[float, str]:
    """Return the number of a part's property, and the unit behind it; empty if there is none.

    `stated` is the table of the dataset definition that states a unit, if it does.
    """
    key, units = _KEYS[name]
    given = part.get(key)
    match = _NUMBER.fullmatch(str(given))
    text = match[2].strip().lower().replace("³", "^3") if match else "?"
    known = {"": "", **{unit.lower(): unit for unit in units}}
    if match is None or text not in known:
        expected = " or ".join(["a number", *units])
        raise InputError(path, f"part {part['label']} has {key} {given!r}", expected)
    if text and stated:
        expected = f"a bare number, or no unit of {name} in {stated}"
        raise InputError(path, f"part {part['label']} has {key} {given!r}", expected)
    return float(match[1]), known[text]


def _names(name: str, label: str) -> tuple[str, str]:
    """Return the two paths at which the mesh of an object's part may lie."""
    return f"partseg/{name}/objs/{label}.obj", f"partseg/{name}/objs/{label}/{label}.obj"


def _meshes_of(name: str, listing: Listing) -> dict[str, str]:
    """Return the paths of an object's meshes by label, also of labels that no part has."""
    folder = f"partseg/{name}/objs/"
    files = listing.of_folder(folder, folders=False)
    found = {file[:-4]: folder + file for file in sorted(files) if file.endswith(".obj")}
    for label in sorted(listing.of_folder(folder, folders=True)):
        nested = _names(name, label)[1]
        if label not in found and listing.is_file(nested):
            found[label] = nested
    return found


def _mesh(path: Place, data: bytes) -> Any:
    """Return the mesh of a part."""
    with refusing(path, "is no mesh", "an OBJ with faces"):
        mesh = _trimesh().load(
            io.BytesIO(data), file_type="obj", force="mesh", process=False, skip_materials=True
        )
        if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
            raise ValueError("it has no faces, or vertices that are not finite")
    return mesh


def _voxels(meshes: list[Any], path: Place) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Voxelise the parts as solids; return voxels (K, 3) of 64^3, each once, and each one's part.

    The object's longest side spans the cube, as in TRELLIS's toolkit. If parts overlap, the
    smaller part takes the voxel, such as a part inside a shell.
    """
    low = np.min([mesh.vertices.min(axis=0) for mesh in meshes], axis=0)
    high = np.max([mesh.vertices.max(axis=0) for mesh in meshes], axis=0)
    side = float((high - low).max())
    if not side > 0:
        raise InputError(path, "has parts without any size", "meshes of a solid")
    owner = np.full((RESOLUTION,) * 3, -1, dtype=np.intp)
    filled = []
    for mesh in meshes:
        moved = mesh.copy()
        # Cell i spans i - 0.5 to i + 0.5 in the library's grid of pitch 1.
        scaled = (mesh.vertices - (low + high) / 2) / side * (RESOLUTION - 1e-6)
        moved.vertices = scaled + (RESOLUTION - 1) / 2
        cells = np.rint(moved.voxelized(pitch=1.0).fill().points).astype(np.int64)
        filled.append(np.unique(np.clip(cells, 0, RESOLUTION - 1), axis=0))
    for number in sorted(range(len(meshes)), key=lambda number: -len(filled[number])):
        owner[tuple(filled[number].T)] = number
    voxels = np.argwhere(owner >= 0)
    return voxels, owner[tuple(voxels.T)]


def _trimesh() -> Any:
    with needing("meshes of parts need", "parts"):
        import trimesh
    return trimesh

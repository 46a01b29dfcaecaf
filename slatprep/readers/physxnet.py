"""PhysXNet as PhysX-3D's toolkit voxelises it: the density of TRELLIS's voxels of an object.

Its ``voxelize.py`` writes the centres of an object's voxels to ``voxels/<id>.ply``. It writes
a row of ``property/<id>2.npy`` for each of them: the object's largest dimension [cm], the
part's rank in touching, its density [g/cm^3], its movement group and that group's parent,
eight numbers of the movement, and its kind. ``property/<id>1.npy`` holds embeddings of text.

PhysX-3D's ``tools/1_gptanno.py`` asks for the density in g/cm^3. A part's annotation reads
``"1.2 g/cm^3"``, and the toolkit keeps the number before the blank.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from slatprep.errors import ConfigError, InputError
from slatprep.parameters import PixieverseSource
from slatprep.readers.adapters import FoundField, Holding, find_by_pattern, patterns_of
from slatprep.readers.files import ArraySpec, load_source, npy_array, require_complete
from slatprep.readers.points import ply_points
from slatprep.readers.voxel_sets import field_of_voxels
from slatprep.records import PROPERTIES, AssetPair, MaterialField
from slatprep.storage.files import Listing

_ROWS = ArraySpec(shapes=((None, 14),), kinds="f", note=", as PhysX-3D's toolkit writes it")
_DENSITY = 2
_TABLE = tuple(one for one in PROPERTIES if one.name == "density")


class PhysXNet:
    """``property/<id>2.npy`` and ``voxels/<id>.ply``, in the frame of the SLAT of the same mesh."""

    patterns = ("property/{id}2.npy",)

    def describe(self, source: PixieverseSource) -> Holding:
        """Say that there is density, and no classes."""
        return Holding(_TABLE, ())

    def find(self, source: PixieverseSource, listing: Listing) -> Iterator[FoundField]:
        """Find the fields by the names of their files; each needs the voxels of its rows."""
        if "finaljson" in listing.of_folder("", folders=True):
            raise ConfigError(
                f"{source.root}: is PhysXNet as it is downloaded, annotations of the parts of "
                "meshes, which have no voxels. Use the adapter `parts`, which voxelises them. "
                "Expected is what PhysX-3D's toolkit makes of it, with property/ and voxels/"
            )
        for found in find_by_pattern(patterns_of(self, source), listing, {}):
            beside = f"voxels/{found.object_id}.ply"
            lacking = (
                ""
                if listing.is_file(beside)
                else (
                    f"{source.root / found.path}: nothing says where its rows lie, as there is no "
                    f"{beside}, which PhysX-3D's toolkit writes with it"
                )
            )
            yield replace(found, beside=(beside,), problem=found.problem or lacking)

    def read(self, pair: AssetPair, max_unphysical: float) -> MaterialField:
        """Read a field; see `slatprep.readers.adapters.SourceAdapter`."""
        path, _ = require_complete(pair)
        root, units = pair.roots.pixieverse, pair.roots.units
        (beside,) = pair.beside or (root / f"voxels/{path.name.removesuffix('2.npy')}.ply",)
        data, file = load_source(path, root, "grid")
        rows = npy_array(data, path, _ROWS)
        text, points = load_source(beside, root, "description")
        vertices, _ = ply_points(text, beside)
        if len(rows) != len(vertices):
            raise InputError(
                path, f"has {len(rows)} rows", f"{len(vertices)}, a row a vertex of {beside.name}"
            )
        return field_of_voxels(
            path,
            np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1),
            # The file's unit, unless the dataset definition states another.
            (1.0 if units.density else 1000.0) * rows[:, _DENSITY : _DENSITY + 1],
            table=_TABLE,
            max_unphysical=max_unphysical,
            sources=(file, points),
            frame=np.eye(4),
            roots=pair.roots,
        )

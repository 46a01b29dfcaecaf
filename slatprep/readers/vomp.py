"""VoMP's dataset: voxels with materials as a structured array, of meshes without classes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slatprep.errors import InputError
from slatprep.parameters import PixieverseSource
from slatprep.readers.adapters import FoundField, Holding, find_by_pattern, patterns_of
from slatprep.readers.files import ArraySpec, load_source, npz_arrays, require_complete
from slatprep.readers.voxel_sets import field_of_voxels
from slatprep.records import PROPERTIES, AssetPair, MaterialField
from slatprep.storage.files import Listing

_VOXELS = {"voxel_data": ArraySpec(shapes=((None,),), kinds="V")}
_SIDE = 64


class VoMP:
    """``voxels/<id>_with_materials.npz``: x, y, z in the unit cube, E, density and nu in SI units.

    A SLAT encoded from the same mesh lies in the same frame. The field records this frame, and
    the engine ``known`` uses it.
    """

    patterns = ("voxels/{id}_with_materials.npz", "{id}_with_materials.npz")

    def describe(self, source: PixieverseSource) -> Holding:
        """Say that there are PixieVerse's three properties and no classes."""
        return Holding(PROPERTIES, ())

    def find(self, source: PixieverseSource, listing: Listing) -> Iterator[FoundField]:
        """Find the fields by the names of their files."""
        return find_by_pattern(patterns_of(self, source), listing, {})

    def read(self, pair: AssetPair, max_unphysical: float) -> MaterialField:
        """Read a field; see `slatprep.readers.adapters.SourceAdapter`."""
        path, _ = require_complete(pair)
        data, file = load_source(path, pair.roots.pixieverse, "grid")
        rows = npz_arrays(data, path, _VOXELS)["voxel_data"]
        columns = tuple(one.name for one in PROPERTIES)
        missing = {"x", "y", "z", *columns} - set(rows.dtype.names or ())
        if missing or any(rows.dtype[name].kind not in "fiu" for name in (*"xyz", *columns)):
            wanted = f"numbers named x, y, z, {', '.join(columns)}"
            raise InputError(f"{path} [voxel_data]", f"has the columns {rows.dtype}", wanted)
        positions = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
        return field_of_voxels(
            path,
            # The dataset states lower corners, i / 64 - 0.5; predictions state centres.
            np.floor((positions + 0.5) * _SIDE + 0.25).astype(np.int64),
            np.stack([rows[name] for name in columns], axis=1),
            resolution=_SIDE,
            max_unphysical=max_unphysical,
            sources=(file,),
            frame=np.eye(4),
            roots=pair.roots,
        )

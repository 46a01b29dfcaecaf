"""Read particles: Gaussians as TRELLIS saves them, or plain points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.export import ply
from slatprep.readers.files import ArraySpec, npy_array, npz_arrays
from slatprep.readers.points import ply_points
from slatprep.storage.files import open_regular

Axes = Literal["trellis", "glb", "slat"]

SAVED_AXES: dict[Axes, NDArray[np.float64]] = {
    "trellis": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "glb": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "slat": np.eye(3),
}
"""The matrix from the SLAT frame to the axes of each kind of file.

TRELLIS saves Gaussians as (x, -z, y) (``Gaussian.save_ply``), and meshes as
(x, z, -y) (``to_glb``). SAM 3D Objects saves Gaussians as they are, ``slat``.
"""

FRAMES: dict[Axes, str] = {
    "slat": ply.COMMENTS["slat"],
    "trellis": "frame TRELLIS as it saves Gaussians, unit cube -0.5..0.5, y down",
    "glb": "frame TRELLIS as it saves meshes, unit cube -0.5..0.5, y up",
}
"""Comment that names the frame in a PLY of slatprep."""

_GAUSSIAN = ("f_dc_0", "opacity", "scale_0", "rot_0")
_REACH = 0.6
"""Largest coordinate of TRELLIS's Gaussians: voxels end at 0.5, offsets are below 2 voxels."""
_KEYS = ("positions", "points", "xyz")
_POINTS = ArraySpec(((None, 3),), "fiu", max_rows=100_000_000)


@dataclass(frozen=True)
class Particles:
    """The particles of a file.

    Attributes
    ----------
    positions : ndarray of float64, shape (N, 3)
        Positions as in the file.
    axes : {"trellis", "glb", "slat"}
        The axes of the file: those of TRELLIS's Gaussians, of its meshes, or of the SLAT frame.
    foreign : str
        Why the Gaussians are not from TRELLIS, so that their axes and scale are not known;
        empty if nothing indicates that.
    guessed : bool
        Whether `axes` rests only on the fields of Gaussians, which SAM 3D Objects writes, too.
    vertices : ndarray, optional
        The rows of a PLY of Gaussians, with all attributes.
    """

    positions: NDArray[np.float64]
    axes: Axes
    foreign: str = ""
    guessed: bool = False
    vertices: NDArray[Any] | None = None

    def in_slat(self) -> NDArray[np.float64]:
        """Return the positions (N, 3) in the SLAT frame."""
        # The transpose is the inverse; a row vector is multiplied from the right.
        return self.positions @ SAVED_AXES[self.axes]


def read_particles(path: Path, axes: Axes | None = None) -> Particles:
    """Read particles: a PLY with ``x y z``, an npy (N, 3), or an npz with one such array.

    A PLY of slatprep states its axes. A PLY with the fields and normals of TRELLIS's Gaussians, no
    ``f_rest_*`` and positions in the unit cube is read as ``trellis``, every other file as
    ``slat``. `axes` overrides both. InputError if the file cannot be used, has no particle, or a
    position is not finite.
    """
    path = Path(path)
    comments: tuple[str, ...] = ()
    vertices: NDArray[Any] | None = None
    if path.suffix.lower() == ".ply":
        vertices, comments = ply_points(_bytes_of(path), path)
        columns = [vertices[axis] for axis in "xyz"]
    else:
        columns = list(_read_numpy(path).T)
    if len(columns[0]) == 0:
        raise InputError(path, "holds no particles", "at least one")
    # Check column by column, so that a large file is not copied before it is refused.
    most = np.finfo(np.float32).max
    usable = ((column >= -most) & (column <= most) for column in columns)
    faults = [int(np.argmin(fine)) for fine in usable if not fine.all()]
    if faults:
        where = [float(column[min(faults)]) for column in columns]
        raise InputError(path, f"particle {min(faults)} lies at {where}", "finite float32 x, y, z")
    if axes is None and ply.COMMENTS["pixieverse"] in comments:
        raise InputError(
            path,
            "is an export of points in the PixieVerse frame",
            "the SLAT frame: slatprep export --frame slat; or say with --axes how they lie",
        )
    positions = np.stack(columns, axis=1, dtype=np.float64)
    names = frozenset(vertices.dtype.names or ()) if vertices is not None else frozenset()
    stated = next((key for key, words in FRAMES.items() if words in comments), None)
    gaussian = names.issuperset(_GAUSSIAN)
    foreign = _by_another_tool(positions, names) if gaussian else ""
    guessed: Axes = "trellis" if gaussian and not foreign else "slat"
    return Particles(
        positions,
        axes or stated or guessed,
        foreign,
        guessed=guessed == "trellis" and not axes and not stated,
        vertices=vertices if gaussian else None,
    )


def _by_another_tool(positions: NDArray[np.float64], names: frozenset[str]) -> str:
    """Return why Gaussians are not from TRELLIS; empty if they may be."""
    signs = []
    if "f_rest_0" in names:
        signs.append("it has f_rest_*")
    if not names.issuperset(("nx", "ny", "nz")):
        signs.append("it has no normals")
    if (reach := float(np.abs(positions).max())) > _REACH:
        signs.append(f"it reaches {reach:.3g} from the centre, out of the unit cube")
    return " and ".join(signs)


def _read_numpy(path: Path) -> NDArray[Any]:
    data = _bytes_of(path)
    if not data.startswith(b"PK"):
        return npy_array(data, path, _POINTS)
    arrays = npz_arrays(data, path, dict.fromkeys(_KEYS, _POINTS), partial=True)
    if len(arrays) != 1:
        raise InputError(
            path,
            f"has {' and '.join(arrays) or 'no particles'}",
            f"one array named {' or '.join(_KEYS)}",
        )
    return next(iter(arrays.values()))


def _bytes_of(path: Path) -> bytes:
    try:
        with open_regular(path) as file:
            return file.readall()
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "a readable file") from None

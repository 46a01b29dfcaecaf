"""Read particles: Gaussians as TRELLIS saves them, or plain points."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError, SlatprepError

Axes = Literal["trellis", "glb", "slat"]

SAVED_AXES: dict[Axes, NDArray[np.float64]] = {
    "trellis": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "glb": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "slat": np.eye(3),
}
"""What positions of the SLAT frame are multiplied with in a file of each kind.

TRELLIS saves Gaussians as (x, -z, y) (``Gaussian.save_ply``), and meshes as
(x, z, -y) (``to_glb``).
"""

FRAMES: dict[Axes, str] = {
    "slat": "frame SLAT, unit cube -0.5..0.5, z up",
    "trellis": "frame TRELLIS as it saves Gaussians, unit cube -0.5..0.5, y down",
    "glb": "frame TRELLIS as it saves meshes, unit cube -0.5..0.5, y up",
}
"""What a PLY written here says of its frame, in a comment."""

_GAUSSIAN = ("f_dc_0", "opacity", "scale_0", "rot_0")
_REACH = 0.6
"""Farther out TRELLIS decodes no Gaussian: its voxels end at 0.5, its offsets within two voxels."""
_KEYS = ("positions", "points", "xyz")


@dataclass(frozen=True)
class Particles:
    """Particles as their file has them.

    Attributes
    ----------
    positions : ndarray of float64, shape (N, 3)
        As in the file.
    axes : {"trellis", "glb", "slat"}
        The frame of the file: turned as TRELLIS saves Gaussians, or meshes, or the SLAT's.
    foreign : str
        By what Gaussians are another tool's than TRELLIS, whose axes and scale
        are not known; empty where nothing says so.
    """

    positions: NDArray[np.float64]
    axes: Axes
    foreign: str = ""

    def in_slat(self) -> NDArray[np.float64]:
        """Return the positions (N, 3) in the SLAT frame."""
        # The transpose is the inverse; a row vector is multiplied from the right.
        return self.positions @ SAVED_AXES[self.axes]


def read_particles(path: Path, axes: Axes | None = None) -> Particles:
    """Read particles from a file.

    Parameters
    ----------
    path : Path
        A PLY with ``x y z``; an npy of shape (N, 3); or an npz that holds such
        an array as ``positions``, ``points`` or ``xyz``.
    axes : {"trellis", "glb", "slat"}, optional
        The frame of the file. By default it is what a PLY of slatprep says it
        is; a PLY with the fields of Gaussians (``f_dc_0``, ``opacity``,
        ``scale_0``, ``rot_0``) is as TRELLIS saves it, unless it has ``f_rest_*``,
        has no normals or leaves the unit cube, as no Gaussians of TRELLIS do;
        and everything else is in the SLAT frame.

    Returns
    -------
    Particles
        At least one, all finite.

    Raises
    ------
    InputError
        If the file cannot be used.
    SlatprepError
        If a PLY is to be read and plyfile is not installed.
    """
    path = Path(path)
    if path.suffix.lower() == ".ply":
        positions, names, comments = _read_ply(path)
    else:
        positions, names, comments = _read_numpy(path), frozenset(), ()
    if len(positions) == 0:
        raise InputError(path, "holds no particles", "at least one")
    finite = np.isfinite(positions).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise InputError(
            path, f"particle {row} lies at {positions[row].tolist()}", "finite x, y, z"
        )
    if axes is None and any(comment.startswith("frame PixieVerse") for comment in comments):
        raise InputError(
            path,
            "is an export of points in the PixieVerse frame",
            "the SLAT frame: slatprep export --frame slat; or say with --axes how they lie",
        )
    stated = next((key for key, words in FRAMES.items() if words in comments), None)
    gaussian = names.issuperset(_GAUSSIAN)
    foreign = _by_another_tool(positions, names) if gaussian else ""
    guessed: Axes = "trellis" if gaussian and not foreign else "slat"
    return Particles(positions, axes or stated or guessed, foreign)


def _by_another_tool(positions: NDArray[np.float64], names: frozenset[str]) -> str:
    """Say by what Gaussians are not TRELLIS's; empty where they may be."""
    signs = []
    if "f_rest_0" in names:
        signs.append("it has f_rest_*")
    if not names.issuperset(("nx", "ny", "nz")):
        signs.append("it has no normals")
    if (reach := float(np.abs(positions).max())) > _REACH:
        signs.append(f"it reaches {reach:.3g} from the centre, out of the unit cube")
    return " and ".join(signs)


def _read_ply(path: Path) -> tuple[NDArray[np.float64], frozenset[str], tuple[str, ...]]:
    try:
        import plyfile
    except ImportError as error:
        raise SlatprepError(
            "reading a PLY needs the package plyfile; install it with "
            "`pip install 'slatprep[simulate]'`"
        ) from error
    try:
        read = plyfile.PlyData.read(path)
        vertex = read["vertex"].data
    except (OSError, KeyError, ValueError, UnicodeDecodeError, plyfile.PlyParseError) as error:
        raise InputError(
            path, f"is no readable PLY with vertices ({error})", "a PLY of Gaussians or points"
        ) from None
    names = vertex.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(path, f"has vertices of {', '.join(names)}", "fields x, y and z")
    if any(vertex.dtype[axis].kind not in "fiu" for axis in "xyz"):
        raise InputError(path, "has x, y, z that are lists", "a number each")
    positions = np.column_stack([np.asarray(vertex[axis], dtype=np.float64) for axis in "xyz"])
    return positions, frozenset(names), tuple(read.comments)


def _read_numpy(path: Path) -> NDArray[np.float64]:
    try:
        loaded: Any = np.load(path, allow_pickle=False)
        if not isinstance(loaded, np.ndarray):
            with loaded:
                held = [key for key in _KEYS if key in loaded.files]
                if len(held) != 1:
                    raise InputError(
                        path,
                        f"holds {', '.join(loaded.files) or 'nothing'}",
                        f"one array named {' or '.join(_KEYS)}",
                    )
                loaded = loaded[held[0]]
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            path, f"cannot be read ({error})", "particles as PLY, npy or npz"
        ) from None
    if loaded.ndim != 2 or loaded.shape[1] != 3 or loaded.dtype.kind not in "fiu":
        raise InputError(path, f"has shape {loaded.shape}, dtype {loaded.dtype}", "numbers (N, 3)")
    return np.asarray(loaded, dtype=np.float64)

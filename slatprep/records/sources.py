"""Records of where the two sides of a pair lie, and of the data read from them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import IO, Annotated, Any, ClassVar, Literal, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.records.json_types import Count, Digest, one_of
from slatprep.records.tables import (
    PIXIEVERSE,
    PROPERTIES,
    RESOLUTION,
    Contents,
    LatentMoments,
    Property,
)


class Place(Protocol):
    """The place of a file or folder: a `pathlib.Path`, or a URL as a `RemotePlace`.

    `slatprep.storage.place.place_of` makes one. These are the operations that both share;
    `slatprep.storage.place.storage_of` has the others.
    """

    @property
    def name(self) -> str:
        """Its last component."""

    @property
    def suffix(self) -> str:
        """The extension of its name, with the dot."""

    @property
    def parent(self) -> Self:
        """The folder that holds it."""

    def __hash__(self) -> int:
        """Equal places have equal hashes."""

    def __truediv__(self, key: str, /) -> Self:
        """Return the place of this name below it."""

    def absolute(self) -> Self:
        """Return it as an absolute place."""

    def exists(self) -> bool:
        """Return whether it is a file or a folder."""

    def is_dir(self) -> bool:
        """Return whether it is a folder."""

    def is_file(self) -> bool:
        """Return whether it is a file."""

    def open(
        self, mode: str, *, encoding: str | None = None, newline: str | None = None
    ) -> IO[Any]:
        """Open a file; on an object store for reading only."""

    def read_bytes(self) -> bytes:
        """Read a whole file."""

    def read_text(self, encoding: str | None = None) -> str:
        """Read a whole file as text."""


ROLES = ("grid", "mask", "bounds", "description", "transform", "slat", "texture")
"""The roles of a file in its asset."""

LATENT_ROLES = ("slat", "texture")
"""Roles of files below the root of the latents."""


@dataclass(frozen=True)
class SourceFile:
    """A file that was read; ``path`` is relative to its source's root, with forward slashes.

    ``source`` is 0 for the first source and the latents, and k for the k-th further source in
    `slatprep.parameters.BuildParameters.also`.
    """

    role: Annotated[str, one_of(*ROLES)]
    path: str
    size: Count
    sha256: Digest
    source: Count = 0


Plausibility = Literal["refuse", "warn", "off"]
"""The treatment of values that no material has, see `slatprep.readers.plausible`."""

LOG10 = "log10 "
"""Prefix of a unit if the file holds the logarithm of the value."""

FACTORS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "kg/m^3": 1.0, "g/cm^3": 1e3}
"""Factor by which a value in a unit is multiplied to be in SI units."""

_FACTOR = {"": 1.0, "1": 1.0} | FACTORS


def to_si(values: ArrayLike, unit: str) -> NDArray[np.float64]:
    """Return values of any shape in SI units; unchanged if the unit is ``1`` or empty."""
    given = np.asarray(values, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        si = 10.0**given if unit.startswith(LOG10) else given * _FACTOR[unit]
    return np.asarray(si)


@dataclass(frozen=True)
class Units:
    """Units of the values in the files of a source; empty if they are not stated.

    The checks of plausibility question a stated unit only if its values are impossible.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid"}

    youngs_modulus: Literal["", "Pa", "kPa", "MPa", "GPa", "log10 Pa"] = ""
    density: Literal["", "kg/m^3", "g/cm^3", "log10 kg/m^3"] = ""

    def of(self, name: str) -> str:
        """Return the stated unit of a property; empty if there is none."""
        return str(getattr(self, name, ""))


def table_of(number: int) -> str:
    """Return the table of the dataset definition that names the source of a number."""
    return f"[[also]] {number}" if number else "[pixieverse]"


@dataclass(frozen=True)
class SourceRoots:
    """The root folders of a source and of the latents, and what they hold.

    ``number`` is the source's index from 0. ``units`` are the units of its files; ``plausibility``
    is the treatment of values that no material has.
    """

    pixieverse: Place
    slat: Place
    contents: Contents = PIXIEVERSE
    adapter: str = "pixieverse"
    number: int = 0
    units: Units = field(default_factory=Units)
    plausibility: Plausibility = "refuse"

    def numbered(self, files: Iterable[SourceFile]) -> tuple[SourceFile, ...]:
        """Return files with the number of the source that they lie in."""
        return tuple(replace(file, source=self.number) for file in files)


@dataclass(frozen=True, slots=True)
class AssetPair:
    """The files of the two sides of a row of the store; nothing has been read yet.

    Attributes
    ----------
    asset_id : str
        Unique id of the row: the object id, or ``<object_id>.<view>`` if
        an object has several SLATs.
    object_id : str
        PixieVerse id of the object.
    view : str
        The image or seed that the SLAT was made from; empty if there is only one.
    category : str
        PixieVerse category; empty if unknown.
    roots : SourceRoots
        The roots below which the files must lie; one object for all pairs.
    grid, mask, bounds, transform : Place or None
        PixieVerse files, absolute; ``grid`` is None if the partner is missing.
    slat : Place or None
        SLAT file, absolute; None if the partner is missing.
    slat_group : str
        Group inside an HDF5 file with several assets; otherwise empty.
    problem : str
        Why the pair cannot be used (missing partner, two files for one id); empty if it can.
    beside : tuple of Place
        Further files that the adapter of the source reads for it.
    sample : str
        Name of this annotation among the object's; may be empty.
    others : tuple of AssetPair
        The object's further annotations to merge, each with the same SLAT.
    """

    asset_id: str
    object_id: str
    view: str
    category: str
    roots: SourceRoots
    grid: Place | None
    mask: Place | None
    bounds: Place | None
    slat: Place | None
    slat_group: str = ""
    problem: str = ""
    transform: Place | None = None
    beside: tuple[Place, ...] = ()
    sample: str = ""
    others: tuple[AssetPair, ...] = ()

    @property
    def annotations(self) -> tuple[AssetPair, ...]:
        """Every annotation of the object that goes into the row, this one first."""
        return (self, *self.others)

    @property
    def files(self) -> tuple[tuple[str, Place], ...]:
        """Role and place of each file of this annotation, in the order in which they are read."""
        beside = (("description", place) for place in self.beside)
        files = ("grid", self.grid), ("mask", self.mask), ("bounds", self.bounds), *beside
        files = *files, ("transform", self.transform)
        return tuple((role, place) for role, place in files if place is not None)


@dataclass(frozen=True, eq=False)
class MaterialField:
    """A PixieVerse field: occupied voxels, and their materials in SI units.

    Attributes
    ----------
    occupancy : ndarray of bool, shape (64, 64, 64)
        Occupied voxels, axes x, y, z of the PixieVerse frame.
    voxels : ndarray of uint8, shape (K, 3)
        The annotated voxels (occupied, with a class, physical), in C order of the grid.
    material : ndarray of uint8, shape (K,)
        Class of each annotated voxel, an index of `Contents.labels`.
    properties : ndarray of float32, shape (K, P)
        Properties of each annotated voxel in SI units, a column for each of `table`.
    unphysical : int
        Number of voxels with a class that are not annotated, as no material has their properties.
    bounds : dict or None
        World bounds as ``clip_features.npz`` states them, JSON-ready.
    sources : tuple of SourceFile
        The files read.
    warnings : tuple of str
        Remarks on this field for the user.
    table : tuple of Property
        The columns of `properties`.
    frame : ndarray of float64, shape (4, 4), or None
        Transform from its frame to the SLAT frame, if the source states it.
    classified : bool
        Whether the source has classes; without them `material` is 0 throughout.
    converted : bool
        Whether a reader applied the stated units and compared the values with known materials. If
        an adapter of another package did not, it is done after it.
    """

    occupancy: NDArray[np.bool_]
    voxels: NDArray[np.uint8]
    material: NDArray[np.uint8]
    properties: NDArray[np.float32]
    unphysical: int = 0
    bounds: dict[str, object] | None = None
    sources: tuple[SourceFile, ...] = ()
    warnings: tuple[str, ...] = ()
    table: tuple[Property, ...] = PROPERTIES
    frame: NDArray[np.float64] | None = None
    classified: bool = True
    converted: bool = False


_ODDITY = re.compile(r"(sample .+?: )?unusual (values|masks|places|latents): (.+)", re.DOTALL)


def oddity(kind: str, text: str) -> str:
    """Return a warning of unusual ``values``, ``masks``, ``places`` or ``latents`` of a source.

    A build prints it, and `slatprep info` and `slatprep list` repeat it.
    """
    return f"unusual {kind}: {text}"


def oddities_in(warnings: Iterable[str]) -> dict[str, str]:
    """Return the first text of each kind of `oddity` among warnings, in one line, by kind."""
    found = [match for one in warnings if (match := _ODDITY.match(one))]
    texts = {one[2]: " ".join(f"{one[1] or ''}{one[3]}".split()) for one in reversed(found)}
    return dict(sorted(texts.items()))


@dataclass(frozen=True, eq=False)
class StructuredLatents:
    """A SLAT: occupied surface voxels and their latents.

    ``coords`` is (N, 3) uint8 in 0..resolution - 1 in the order of the source file, ``feats`` is
    (N, channels) float32. ``standardised`` says whether `feats` are standardised already.
    ``resolution`` is the number of the encoder's voxels along each axis of the unit cube, 64 in the
    frame.
    """

    coords: NDArray[np.uint8]
    feats: NDArray[np.float32]
    sources: tuple[SourceFile, ...] = ()
    warnings: tuple[str, ...] = ()
    standardised: bool = False
    resolution: int = RESOLUTION

    @cached_property
    def centres(self) -> NDArray[np.float64]:
        """The centres (N, 3) of its voxels in the unit cube [-0.5, 0.5]^3 of the SLAT frame."""
        return (self.coords.astype(np.float64) + 0.5) / self.resolution - 0.5

    @cached_property
    def moments(self) -> LatentMoments:
        """Mean and standard deviation of each channel."""
        # By channel: numpy takes ten times as long along the first axis of a narrow array.
        channels = np.ascontiguousarray(self.feats.T)
        mean = channels.mean(axis=1, dtype=np.float64)
        std = channels.std(axis=1, dtype=np.float64)
        return LatentMoments(tuple(mean.tolist()), tuple(std.tolist()))

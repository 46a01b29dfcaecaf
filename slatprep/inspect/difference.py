"""What `slatprep.inspect.compare` finds: of a property, of an asset, of two stores."""

from __future__ import annotations

from dataclasses import dataclass

from slatprep.records import Place


@dataclass(frozen=True)
class Setting:
    """An attribute of the stores' roots that differs; None where one has no such attribute."""

    name: str
    a: object
    b: object


@dataclass(frozen=True)
class PropertyChange:
    """How a property changed over voxels that are valid in both stores.

    Attributes
    ----------
    voxels, changed : int
        Those voxels, and how many of them have another value.
    mean, most : float
        Mean and largest absolute change, in the SI unit.
    log10 : float or None
        Mean absolute change of log10, where both stores normalise it so.
    """

    voxels: int
    changed: int
    mean: float
    most: float
    log10: float | None


@dataclass(frozen=True)
class AssetChange:
    """What became of an asset that is in both stores.

    Attributes
    ----------
    asset_id : str
        Its id.
    what : tuple of str
        Words for all that differs: ``sources``, ``verdict``, ``placement``, ``voxels``,
        ``labels``, ``properties``, ``latents``, ``columns``; none where nothing does.
    verdicts : tuple of str
        In either store.
    sources : tuple of str
        Roles of the source files whose content differs.
    columns : tuple of str
        Other arrays that differ, such as ``asset/fitness`` and ``voxel/confidence``.
    moved : float
        Mean distance, in voxels of the PixieVerse frame, between where the two
        look a SLAT voxel up; where they have other SLAT voxels, by the transforms alone.
    voxels, unmatched : int
        SLAT voxels of both, and those that only one has.
    labels : int
        Voxels of both whose class differs, or that are valid in one only.
    properties : dict of str to PropertyChange
        By name, of those that both stores have.
    """

    asset_id: str
    what: tuple[str, ...]
    verdicts: tuple[str, str]
    sources: tuple[str, ...]
    columns: tuple[str, ...]
    moved: float
    voxels: int
    unmatched: int
    labels: int
    properties: dict[str, PropertyChange]


@dataclass(frozen=True)
class StoreDifference:
    """What differs between two stores.

    Attributes
    ----------
    a, b : Place
        The stores.
    same : bool
        Whether nothing does.
    settings : tuple of Setting
        Attributes that differ: format, ranges, parameters, versions, the digest of the records.
    only_a, only_b : tuple of str
        Ids of assets that one store alone has.
    assets, changed : int
        Assets that both have, and how many of these changed.
    what : dict of str to int
        Of those that changed how many in what respect; see `AssetChange`.
    verdicts : dict of str to int
        Changes of the verdict, such as ``good > failed``.
    moved, moved_most : float
        Median and largest of `AssetChange.moved` over the assets that moved; NaN where none did.
    voxels, labels : int
        SLAT voxels of both, and how many of them have another class.
    properties : dict of str to PropertyChange
        Over the voxels of all assets.
    worst : tuple of AssetChange
        Assets that changed, first those with most labels changed, then those that moved most.
    """

    a: Place
    b: Place
    same: bool
    settings: tuple[Setting, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    assets: int
    changed: int
    what: dict[str, int]
    verdicts: dict[str, int]
    moved: float
    moved_most: float
    voxels: int
    labels: int
    properties: dict[str, PropertyChange]
    worst: tuple[AssetChange, ...]

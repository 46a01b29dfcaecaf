"""The differences that `slatprep.inspect.compare` finds, as records."""

from __future__ import annotations

from dataclasses import dataclass

from slatprep.records import Place


@dataclass(frozen=True)
class Setting:
    """An attribute of the stores' roots that differs; None where a store does not have it."""

    name: str
    a: object
    b: object


@dataclass(frozen=True)
class PropertyChange:
    """How a property changed over voxels that are valid in both stores.

    Attributes
    ----------
    voxels, changed : int
        Number of those voxels, and of those whose value differs.
    mean, most : float
        Mean and largest absolute change, in the SI unit.
    log10 : float or None
        Mean absolute change of log10; None unless both stores normalise it so.
    """

    voxels: int
    changed: int
    mean: float
    most: float
    log10: float | None


@dataclass(frozen=True)
class AssetChange:
    """The change of an asset that is in both stores.

    Attributes
    ----------
    asset_id : str
        Its id.
    what : tuple of str
        What differs, in words: ``sources``, ``verdict``, ``placement``, ``voxels``,
        ``labels``, ``properties``, ``latents``, ``columns``; empty if nothing does.
    verdicts : tuple of str
        In the two stores.
    sources : tuple of str
        Roles of the source files whose content differs.
    columns : tuple of str
        Other arrays that differ, such as ``asset/fitness`` and ``voxel/confidence``.
    moved : float
        Mean distance, in voxels of the PixieVerse frame, between the two places where a
        SLAT voxel is looked up; from the transforms alone if the SLATs have different voxels.
    voxels, unmatched : int
        Number of SLAT voxels in both stores, and in only one.
    labels : int
        Voxels in both stores whose class differs, or that are valid in only one.
    properties : dict of str to PropertyChange
        By name, of the properties in both stores.
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
    """The differences between two stores.

    Attributes
    ----------
    a, b : Place
        The stores.
    same : bool
        Whether there are none.
    settings : tuple of Setting
        Attributes that differ: format, ranges, parameters, versions, the digest of the records.
    only_a, only_b : tuple of str
        Ids of assets in only one of the stores.
    assets, changed : int
        Number of assets in both, and of those that changed.
    what : dict of str to int
        Number of changed assets by what differs, see `AssetChange`.
    verdicts : dict of str to int
        Changes of the verdict, such as ``good > failed``.
    moved, moved_most : float
        Median and maximum of `AssetChange.moved` over the assets that moved; NaN if none did.
    voxels, labels : int
        Number of SLAT voxels in both stores, and of those whose class differs.
    properties : dict of str to PropertyChange
        Over the voxels of all assets.
    worst : tuple of AssetChange
        Assets that changed: those with most changed labels first, then those that moved most.
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

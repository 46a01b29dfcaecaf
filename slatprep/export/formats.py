"""What a format of an export offers: a `Writer`, which its module's ``writer`` returns."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from slatprep.export.assets import Exported

Points = Literal["slat", "grid"]
Frame = Literal["slat", "pixieverse"]


@dataclass(frozen=True)
class ExportOptions:
    """What only some formats ask for.

    Attributes
    ----------
    points : {"slat", "grid"}
        PLY: the SLAT's voxels with the annotations found for them, or the
        annotated voxels of the PixieVerse field.
    frame : {"slat", "pixieverse"}
        PLY: the unit cube of the SLAT, or the world of PixieVerse's bounds.
    shard_size : int
        WebDataset: assets in one shard.
    """

    points: Points = "slat"
    frame: Frame = "slat"
    shard_size: int = 256


@dataclass(frozen=True)
class Writer:
    """How the files of an export are written.

    Attributes
    ----------
    write : callable
        Takes the directory, the number of a batch and its assets; writes
        them and yields an `Exported` of each. Of an export that is one file:
        takes the file, what is to be said of the store, and all assets.
    batch : int
        Assets a worker takes at a time, so that opening the store does not
        count.
    notes : tuple of str
        What a person should know of the result.
    is_export : callable, optional
        Given where the export is one file, which one process writes: whether
        a file is such an export and may be replaced.
    """

    write: Callable[..., Iterable[Exported]]
    batch: int = 16
    notes: tuple[str, ...] = ()
    is_export: Callable[[Path], bool] | None = None

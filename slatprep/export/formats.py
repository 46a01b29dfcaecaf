"""What a format of an export offers: a `Writer`, which its module's ``writer`` returns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from slatprep.export.assets import Exported

Points = Literal["slat", "grid"]
Frame = Literal["slat", "pixieverse"]

TRELLIS_ENCODER = "dinov2_vitl14_reg_slat_enc_swin8_B_64l8_fp16"
"""The encoder whose latents TRELLIS's published configurations name as ``latent_model``."""


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
    latent_model : str
        npz: the encoder's name, by which TRELLIS's data set finds the latents.
    """

    points: Points = "slat"
    frame: Frame = "slat"
    shard_size: int = 256
    latent_model: str = TRELLIS_ENCODER


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
    finish : callable, optional
        Takes the directory and the index's entry of each asset, sorted by id;
        writes what is of all of them and returns the names of those files.
    is_export : callable, optional
        Given where the export is one file, which one process writes: whether
        a file is such an export and may be replaced.
    """

    write: Callable[..., Iterable[Exported]]
    batch: int = 16
    notes: tuple[str, ...] = ()
    finish: Callable[[Path, Sequence[dict[str, Any]]], Sequence[str]] | None = None
    is_export: Callable[[Path], bool] | None = None

"""The interface of an export format: the `Writer` that its module's ``writer`` returns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from slatprep.export.assets import Exported

Points = Literal["slat", "grid"]
Frame = Literal["slat", "pixieverse"]

TRELLIS_ENCODER = "dinov2_vitl14_reg_slat_enc_swin8_B_64l8_fp16"
"""The encoder that TRELLIS's published configurations name as ``latent_model``."""


@dataclass(frozen=True)
class ExportOptions:
    """Options of some formats.

    Attributes
    ----------
    points : {"slat", "grid"}, optional
        PLY, voxel_data, USD: the valid voxels of the SLAT, or the annotated voxels of the
        PixieVerse field. By default the field for USD, and the SLAT for others.
    frame : {"slat", "pixieverse"}
        PLY: the unit cube of the SLAT, or PixieVerse's world coordinates.
    shard_size : int
        WebDataset: assets in one shard.
    latent_model : str
        npz: the encoder's name, by which TRELLIS's dataset finds the latents.
    size : float
        USD: width of the unit cube [m].
    materials : int
        USD: the most materials that E and nu of an asset are binned into.
    """

    points: Points | None = None
    frame: Frame = "slat"
    shard_size: int = 256
    latent_model: str = TRELLIS_ENCODER
    size: float = 1.0
    materials: int = 64


@dataclass(frozen=True)
class Writer:
    """How the files of an export are written.

    Attributes
    ----------
    write : callable
        Takes the folder, the number of a batch and its assets; writes them and yields an
        `Exported` for each. For an export in a single file: takes the file, the description
        of the store, and all assets.
    batch : int
        Assets per task of a worker; several, because each task opens the store.
    notes : tuple of str
        Remarks on the result for the user.
    finish : callable, optional
        Takes the folder and the index's entries, sorted by id; writes the files that cover all
        assets and returns their names.
    remarks : callable, optional
        Takes the index's entries; returns further remarks for the user.
    is_export : callable, optional
        Only for an export in a single file, which one process writes: whether an existing
        file is such an export, so that it may be replaced.
    """

    write: Callable[..., Iterable[Exported]]
    batch: int = 16
    notes: tuple[str, ...] = ()
    finish: Callable[[Path, Sequence[dict[str, Any]]], Sequence[str]] | None = None
    remarks: Callable[[Sequence[dict[str, Any]]], tuple[str, ...]] | None = None
    is_export: Callable[[Path], bool] | None = None

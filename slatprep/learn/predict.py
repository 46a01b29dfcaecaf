"""Predict material fields from latents with a trained decoder, and write them.

A prediction is an npz that `slatprep evaluate`, `slatprep transfer` and numpy
read: it carries its ranges, so that nobody has to know the store behind it.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.learn.dataset import FEATS_MEAN, FEATS_STD
from slatprep.learn.decoder import PhysicsDecoder, make_decoder
from slatprep.learn.runs import read_state
from slatprep.normalize import denormalize_properties, normalization_of
from slatprep.readers.files import refusing
from slatprep.records import BACKGROUND, Normalization, StructuredLatents
from slatprep.storage.atomic import staged
from slatprep.storage.names import file_name

BATCH_VOXELS = 65_536
"""Voxels of a batch, about; a larger asset is one by itself."""


@dataclass(frozen=True)
class Checkpoint:
    """A trained decoder, the ranges of what it predicts, and the digest of its file."""

    model: PhysicsDecoder
    size: str
    normalization: Normalization
    sha256: str
    device: str


@dataclass(frozen=True, eq=False)
class PredictedField:
    """What a decoder says of one asset.

    Attributes
    ----------
    coords : ndarray of uint8, shape (N, 3)
        SLAT voxels, in the order of the latents.
    properties : ndarray of float32, shape (N, 3)
        Young's modulus, density, Poisson's ratio in [-1, 1].
    properties_si : ndarray of float32, shape (N, 3)
        The same in Pa, kg/m^3 and 1.
    material : ndarray of uint8, shape (N,)
        The likeliest class, 0 to 6: a voxel of a SLAT is not background.
    probabilities : ndarray of float32, shape (N, 8)
        Of all classes, background last; they add up to 1.
    seconds : float
        What decoding took, of a batch by voxels.
    """

    coords: NDArray[np.uint8]
    properties: NDArray[np.float32]
    properties_si: NDArray[np.float32]
    material: NDArray[np.uint8]
    probabilities: NDArray[np.float32]
    seconds: float


def checkpoint_state(
    model: PhysicsDecoder, size: str, normalization: Normalization
) -> dict[str, Any]:
    """Return what a checkpoint holds of a decoder that is to be used."""
    ranges = [[span.lo, span.hi] for span in normalization.ranges]
    return {
        "size": size,
        "model": model.state_dict(),
        "ranges": ranges,
        "ranges_source": normalization.source,
    }


def load_checkpoint(path: Path, device: str = "cpu") -> Checkpoint:
    """Read a decoder that `slatprep train` has written.

    Parameters
    ----------
    path : Path
        ``best.pt`` of a run, or the folder of the run.
    device : str
        Where it computes.

    Raises
    ------
    InputError
        If it is no such checkpoint, or one of before checkpoints had ranges.
    """
    if path.is_dir():
        path = path / "best.pt"
    if not path.is_file():
        raise InputError(path, "does not exist", "best.pt of a run of `slatprep train`")
    state = read_state(path)
    wanted = "best.pt of a run of `slatprep train`; one without ranges is trained anew"
    with refusing(path, "holds no decoder with its ranges", wanted):
        size = str(state["size"])
        if not isinstance(state["ranges"], list):
            raise TypeError(f"ranges are {type(state['ranges']).__name__}")
        ranges = np.array(state["ranges"], dtype=np.float64).reshape(3, 2)
        if not (np.isfinite(ranges).all() and (ranges[:, 0] < ranges[:, 1]).all()):
            raise ValueError(f"ranges are {ranges.tolist()}")
        model = make_decoder(size)
        model.load_state_dict(state["model"])
        if not all(bool(torch.isfinite(weight).all()) for weight in model.parameters()):
            raise ValueError("weights are not all finite")
        source = str(state["ranges_source"])
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    return Checkpoint(
        model.to(device).eval(), size, normalization_of(ranges, source), sha256, device
    )


def predict(
    checkpoint: Checkpoint,
    assets: Iterable[StructuredLatents],
    *,
    batch_voxels: int = BATCH_VOXELS,
) -> Iterator[PredictedField]:
    """Predict the fields of assets, in their order.

    Parameters
    ----------
    checkpoint : Checkpoint
        The decoder.
    assets : iterable of StructuredLatents
        Latents as TRELLIS gives them; they are standardised here.
    batch_voxels : int
        Assets are decoded together until they have so many voxels. What else
        is in a batch may change the last bits of a prediction.

    Yields
    ------
    PredictedField
        One for each.
    """
    batch: list[StructuredLatents] = []
    for latents in assets:
        if batch and sum(len(one.coords) for one in [*batch, latents]) > batch_voxels:
            yield from _decode(checkpoint, batch)
            batch = []
        batch.append(latents)
    if batch:
        yield from _decode(checkpoint, batch)


@torch.no_grad()
def _decode(checkpoint: Checkpoint, assets: list[StructuredLatents]) -> Iterator[PredictedField]:
    begin = time.perf_counter()
    counts = [len(latents.coords) for latents in assets]
    voxels = np.concatenate([latents.coords for latents in assets]).astype(np.int32)
    asset = np.repeat(np.arange(len(assets), dtype=np.int32), counts)
    feats = np.concatenate([latents.feats for latents in assets])
    feats = (feats - np.array(FEATS_MEAN, np.float32)) / np.array(FEATS_STD, np.float32)
    device = checkpoint.device
    coords = torch.from_numpy(np.concatenate([asset[:, None], voxels], axis=1)).to(device)
    said = checkpoint.model(coords, torch.from_numpy(feats).to(device))
    properties = said.properties.float().cpu().numpy()
    probabilities = torch.softmax(said.logits.float(), dim=1).cpu().numpy()
    seconds = (time.perf_counter() - begin) / len(voxels)
    ends = np.cumsum(counts)
    for latents, first, end in zip(assets, ends - counts, ends, strict=True):
        own, likely = properties[first:end], probabilities[first:end]
        yield PredictedField(
            coords=latents.coords,
            properties=own,
            properties_si=denormalize_properties(own, checkpoint.normalization),
            material=likely[:, :BACKGROUND].argmax(axis=1).astype(np.uint8),
            probabilities=likely,
            seconds=seconds * len(own),
        )


def write_prediction(
    folder: Path, asset_id: str, field: PredictedField, checkpoint: Checkpoint
) -> Path:
    """Write ``<asset id>.npz`` and return its path.

    It has the arrays of a `PredictedField`, ``ranges`` (3, 2) of the mapped
    properties, ``checkpoint`` (the SHA-256 of its file) and ``seconds``.
    """
    path = folder / f"{file_name(asset_id)}.npz"
    with staged(path) as file, file.open("wb") as stream:
        np.savez_compressed(
            stream,
            coords=field.coords,
            properties=field.properties,
            properties_si=field.properties_si,
            material=field.material,
            probabilities=field.probabilities,
            ranges=np.array([[span.lo, span.hi] for span in checkpoint.normalization.ranges]),
            checkpoint=np.array(checkpoint.sha256),
            seconds=np.array(field.seconds),
        )
    return path

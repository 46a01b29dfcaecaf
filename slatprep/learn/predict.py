"""Predict material fields from latents with a trained decoder, and write them.

A prediction is an npz that `slatprep evaluate`, `slatprep transfer` and numpy read. It holds its
ranges, so it serves without the store that the decoder was trained on.
"""

from __future__ import annotations

import json
import time
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.learn.decoder import PhysicsDecoder, make_decoder
from slatprep.learn.runs import BEST, read_state
from slatprep.normalize import denormalize_properties
from slatprep.readers.files import refusing
from slatprep.records import PIXIEVERSE, Contents, Normalization, StructuredLatents, labels_of
from slatprep.storage.atomic import staged
from slatprep.storage.documents import read_as
from slatprep.storage.files import file_digest, file_name

BATCH_VOXELS = 65_536
"""Voxels at which a batch is full; an asset with more is a batch by itself."""


@dataclass(frozen=True)
class _About:
    """What a checkpoint says of its decoder beside the weights, as one JSON text."""

    size: str
    normalization: Normalization
    contents: Contents

    def __post_init__(self) -> None:
        labels_of(self.contents.classes)
        if [(p.name, p.log10) for p in self.contents.properties] != [
            (span.name, span.log10) for span in self.normalization.ranges
        ]:
            raise ValueError("ranges and properties differ")
        if not all(-np.inf < s.lo < s.hi < np.inf for s in self.normalization.ranges):
            raise ValueError(f"ranges are {self.normalization.spans.tolist()}")


@dataclass(frozen=True)
class Checkpoint(_About):
    """A trained decoder: model, ranges, latents and properties, and the digest of its file."""

    model: PhysicsDecoder
    sha256: str
    device: str


@dataclass(frozen=True, eq=False)
class PredictedField:
    """A decoder's prediction for one asset.

    Attributes
    ----------
    coords : ndarray of uint8, shape (N, 3)
        SLAT voxels, in the order of the latents.
    properties : ndarray of float32, shape (N, P)
        The checkpoint's properties in [-1, 1].
    properties_si : ndarray of float32, shape (N, P)
        The same in SI units.
    material : ndarray of uint8, shape (N,)
        The most probable class, below `Contents.n_labels`: a voxel of a SLAT is not background.
    probabilities : ndarray of float32, shape (N, C)
        Probabilities of all classes, background last, with sum 1. Without classes, one column of 1.
    seconds : float
        Time of decoding: the share of its batch by voxels.
    """

    coords: NDArray[np.uint8]
    properties: NDArray[np.float32]
    properties_si: NDArray[np.float32]
    material: NDArray[np.uint8]
    probabilities: NDArray[np.float32]
    seconds: float


def checkpoint_state(
    model: PhysicsDecoder, size: str, normalization: Normalization, contents: Contents = PIXIEVERSE
) -> dict[str, Any]:
    """Return the state of a decoder for a checkpoint: tensors, and a text as `_About` reads it."""
    # Not by orjson, which has no infinity, as the bounds of properties may be.
    about = json.dumps(asdict(_About(size, normalization, contents)))
    return {"model": model.state_dict(), "about": about}


def load_checkpoint(path: Path, device: str = "cpu") -> Checkpoint:
    """Read a decoder of `slatprep train` for evaluation, from ``best.pt`` or the folder of its run.

    Raises InputError if the file is no such checkpoint, or is too old to have ranges.
    """
    if path.is_dir():
        path = path / BEST
    if not path.is_file():
        raise InputError(path, "does not exist", "best.pt, which a training writes with its epochs")
    state = read_state(path)
    wanted = "best.pt of a run of `slatprep train`; one without ranges is trained anew"
    with refusing(path, "holds no decoder with its ranges", wanted):
        if not isinstance(text := state["about"], str):  # A list may be endless in print.
            raise TypeError(f"about is {type(text).__name__}, not a text")
        about = read_as(_About, text)
        ranges = about.normalization.spans
        ends = np.array([[-1.0] * len(ranges), [1.0] * len(ranges)], dtype=np.float32)
        with np.errstate(over="ignore"):
            values = denormalize_properties(ends, about.normalization)
        if not np.isfinite(values).all():
            raise ValueError(f"ranges {ranges.tolist()} lead to values that are not finite")
        model = make_decoder(about.size, about.contents)
        for name, weight in state["model"].items():
            if not weight.is_floating_point():
                raise TypeError(f"weights {name} are {weight.dtype}, not real numbers")
        model.load_state_dict(state["model"])
        if not all(bool(torch.isfinite(weight).all()) for weight in model.parameters()):
            raise ValueError("weights are not all finite")
    model.to(device).eval()
    return Checkpoint(**vars(about), model=model, sha256=file_digest(path), device=device)


def predict(
    checkpoint: Checkpoint, assets: Iterable[StructuredLatents], *, batch_voxels: int = BATCH_VOXELS
) -> Iterator[PredictedField]:
    """Yield the predicted field of each asset, in order.

    Latents must come from the checkpoint's encoder; they are standardised here unless they are
    already. Assets up to `batch_voxels` voxels are decoded together, which may change the last
    bits.
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
    space = replace(checkpoint.contents.latents, standardised=False)
    feats = np.concatenate(
        [one.feats if one.standardised else space.standardise(one.feats) for one in assets]
    )
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
            material=likely[:, : checkpoint.contents.n_labels].argmax(axis=1).astype(np.uint8),
            probabilities=likely,
            seconds=seconds * len(own),
        )


def write_prediction(
    folder: Path, asset_id: str, field: PredictedField, checkpoint: Checkpoint
) -> Path:
    """Write a prediction to ``<asset id>.npz`` in a folder and return its path.

    It has the arrays of a `PredictedField`, ``ranges`` (P, 2), names of properties and classes,
    ``checkpoint`` (the SHA-256 of its file) and ``seconds``. InputError, and no file, if the
    prediction is not finite or another file would be replaced.
    """
    contents = checkpoint.contents
    values = (field.properties, field.properties_si, field.probabilities)
    if not all(np.isfinite(array).all() for array in values):
        encoder = contents.latents.encoder
        raise InputError(
            asset_id, "what is predicted of its latents is not finite", f"latents of {encoder}"
        )
    # The id of a file is its name, already encoded.
    path = folder / f"{file_name(unquote(asset_id))}.npz"
    if path.exists() and not (path.is_file() and _is_prediction(path)):
        fault = "exists and is not a prediction of slatprep"
        raise InputError(path, fault, "a prediction to replace, or no file: name another --out")
    with staged(path) as file, file.open("wb") as stream:
        np.savez_compressed(
            stream,
            **vars(field),
            ranges=checkpoint.normalization.spans,
            checkpoint=np.array(checkpoint.sha256),
            **contents.beside_labels,  # type: ignore[arg-type]
            **contents.latents.beside_voxels,  # type: ignore[arg-type]
        )
    return path


def _is_prediction(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as held:
            return "checkpoint.npy" in held.namelist()
    except (OSError, zipfile.BadZipFile):
        return False

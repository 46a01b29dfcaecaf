"""Write demo data to disk, in the layouts of PixieVerse and TRELLIS, and the truth."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.demo.asset import DemoAsset, DemoView
from slatprep.demo.sources import Source, columns_of, write_field, write_hdf5
from slatprep.geometry.frames import VOXEL_SIZE
from slatprep.geometry.voxels import shown_in_cells
from slatprep.normalize import PIXIE_RANGES, normalize_mapped
from slatprep.records import BACKGROUND, RESOLUTION, TRELLIS, LatentSpace

SlatForm = Literal["npz", "npz-batch", "hdf5", "hdf5-groups"]
SlatNames = Literal["id", "sha256"]

_CHANNELS = replace(PIXIE_RANGES, ranges=tuple(PIXIE_RANGES.ranges[k] for k in (1, 0, 2)))
"""Pixie's ranges in the order of its channels: density, Young's modulus, Poisson's ratio."""


def row_id(asset: DemoAsset, view: DemoView) -> str:
    """Return the id of an asset's row: the object's id, plus the view if it has several."""
    return f"{asset.object_id}.{view.view}" if view.view else asset.object_id


def slat_name(asset: DemoAsset, names: SlatNames) -> str:
    """Return an object's name on the SLAT side: its id, or a sha256 as in TRELLIS."""
    if names == "sha256":
        return hashlib.sha256(f"asset file of {asset.object_id}".encode()).hexdigest()
    return asset.object_id


def write_annotated(
    root: Path,
    asset: DemoAsset,
    source: Source,
    resolution: int = RESOLUTION,
    samples: NDArray[np.float32] | None = None,
) -> None:
    """Write the annotated side of an asset below `root`: a grid with mask and bounds, or voxels.

    For PixieVerse, the grids in `samples`, if given, replace the asset's grid.
    """
    folder = root / asset.object_id
    if source.startswith("pixie-"):
        prediction = _prediction(asset.grid, scores=source == "pixie-predictions")
        _write_prediction(folder, prediction, asset)
    elif source != "pixieverse":
        cells, _ = shown_in_cells(asset.views[0].coords, resolution)
        write_field(root, source, asset.object_id, asset.grid, cells)
    else:
        for k, grid in enumerate([asset.grid] if samples is None else samples):
            (folder / f"sample_{k}").mkdir(parents=True, exist_ok=True)
            np.save(folder / f"sample_{k}" / "material_grid.npy", grid)
        np.save(folder / "clip_features_mask.npy", asset.occupancy.astype(np.float32))
        np.savez(
            folder / "clip_features.npz",
            min_bounds=np.full(3, -0.5),
            max_bounds=np.full(3, 0.5),
            voxel_size=np.float64(VOXEL_SIZE),
            feature_dim=np.int64(768),
            grid_shape=np.full(3, RESOLUTION, dtype=np.int64),
            alpha_weighted=np.bool_(True),
            alpha_threshold_for_mask=np.float64(0.01),
        )


def _write_prediction(folder: Path, prediction: NDArray[np.float32], asset: DemoAsset) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "sample_0_pred.npy", prediction)
    np.save(folder / "sample_0_mask.npy", asset.occupancy.astype(np.float32))


def _prediction(grid: NDArray[np.float32], scores: bool = True) -> NDArray[np.float32]:
    """Return a grid in the format of Pixie's network: channels first, classes as scores or ids."""
    values = grid[..., :3].astype(np.float64)
    values[..., :2] = np.log10(values[..., :2] + 1e-6)
    values = np.clip(normalize_mapped(values, _CHANNELS), -1.0, 1.0)
    # A prediction has no class -1, so voxels without a label become background.
    ids = np.where(grid[..., 3] < 0, BACKGROUND, grid[..., 3])
    classes = ids[..., None] == np.arange(8) if scores else ids[..., None]
    channels = np.concatenate([values, classes], axis=-1)
    return np.ascontiguousarray(np.moveaxis(channels, -1, 0), dtype=np.float32)


def write_results(root: Path, asset: DemoAsset) -> None:
    """Write a prediction with errors, in the layout of Pixie's results.

    The field is shifted by up to a voxel along each axis, so it predicts background at the
    object's boundary. Its properties have noise, for the whole field and for each voxel.
    """
    rng = np.random.default_rng(int.from_bytes(asset.object_id.encode(), "big"))
    shifted = np.roll(asset.grid, rng.integers(-1, 2, size=3), axis=(0, 1, 2))
    prediction = _prediction(shifted)
    prediction[:3] += rng.normal(0.0, 0.1, size=(3, 1, 1, 1))
    prediction[:3] += rng.normal(0.0, 0.1, size=prediction[:3].shape)
    _write_prediction(root / asset.object_id, prediction, asset)


SHAPE_LATENTS = "shape_latents/shape_enc_next_dc_f16c32_fp16"
"""Folder in which TRELLIS.2's toolkit puts shape latents, before ``_`` and the resolution."""


def write_slat(
    root: Path, asset: DemoAsset, form: SlatForm, names: SlatNames, space: LatentSpace = TRELLIS
) -> None:
    """Write the SLATs of an asset below `root`: a file for each, or a group of ``latents.h5``."""
    name = slat_name(asset, names)
    if space.encoder.startswith("trellis2"):
        root /= f"{SHAPE_LATENTS}_{16 * space.resolution}"
    root.mkdir(parents=True, exist_ok=True)
    for view in asset.views:
        stem = root / name / view.view if view.view else root / name
        stem.parent.mkdir(parents=True, exist_ok=True)
        arrays: dict[str, Any] = {"coords": view.coords, "feats": view.feats}
        if form == "npz-batch":
            arrays["coords"] = np.pad(view.coords.astype(np.int32), ((0, 0), (1, 0)))
        if form.startswith("npz"):
            np.savez(stem.with_suffix(".npz"), **arrays)
        elif form == "hdf5":
            write_hdf5(stem.with_suffix(".h5"), arrays)
        else:
            write_hdf5(root / "latents.h5", arrays, f"{name}/")


def write_truth(root: Path, asset: DemoAsset, source: Source) -> None:
    """Write the truth of each row of an asset to ``<root>/<row id>.npz``."""
    root.mkdir(parents=True, exist_ok=True)
    for view in asset.views:
        columns = columns_of(source, view.material, view.properties)
        truth: dict[str, Any] = {
            "transform": view.transform,
            "material": view.material,
            "properties": np.stack(list(columns.values()), axis=1),
            "columns": np.array(list(columns)),
            "symmetric": np.array(asset.symmetric, dtype=bool),
            "name": np.array(asset.name),
            "level": np.array(asset.level, dtype=np.int64),
        }
        if view.places is not None:
            truth["places"] = view.places
        path = root / f"{row_id(asset, view)}.npz"
        np.savez(path, **truth)


SPREAD = np.array([0.03, 0.15, 0.02])
"""Standard deviation of a part's log10 density, log10 Young's modulus and Poisson's ratio."""

MISTAKEN = 0.15
"""Probability that a part gets a class drawn at random."""

_STREAM = 6
"""Index of the random stream; `slatprep.demo.asset` uses the indices below."""


def sample_grids(seed: int, index: int, asset: DemoAsset, samples: int) -> NDArray[np.float32]:
    """Return annotations (samples, 64, 64, 64, 4) with a language model's errors in each part.

    In each part, log density, log Young's modulus and Poisson's ratio are drawn about the true
    values with the deviations `SPREAD`. A sample does not depend on the number of samples.
    """
    known = (asset.grid[..., 3] >= 0) & (asset.grid[..., 3] != BACKGROUND)
    parts, part_of = np.unique(asset.grid[known], axis=0, return_inverse=True)
    grids = np.repeat(asset.grid[None], samples, axis=0)
    for k, grid in enumerate(grids):
        rng = np.random.default_rng([seed, index, _STREAM, k])
        error = rng.normal(0.0, SPREAD, size=(len(parts), 3))
        drawn = parts.astype(np.float64)
        drawn[:, :2] *= 10.0 ** error[:, :2]
        drawn[:, 2] = np.clip(drawn[:, 2] + error[:, 2], 0.05, 0.48)
        mistaken = rng.uniform(size=len(parts)) < MISTAKEN
        drawn[:, 3] = np.where(mistaken, rng.integers(BACKGROUND, size=len(parts)), drawn[:, 3])
        grid[known] = drawn[part_of.reshape(-1)]
    return grids

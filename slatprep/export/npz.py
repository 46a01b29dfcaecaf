"""One npz an asset, as TRELLIS's dataset toolkit writes latents, with the targets added."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slatprep.export.assets import ExportedAsset


def write_asset(path: Path, asset: ExportedAsset) -> int:
    """Write an asset; return its number of voxels.

    ``coords`` (N, 3) uint8 and ``feats`` (N, 8) float32 are TRELLIS's own;
    ``properties`` (N, 3) float32 in [-1, 1] with NaN where not valid,
    ``material`` (N,) uint8 and ``valid`` (N,) bool are the targets.
    """
    np.savez_compressed(
        path,
        coords=asset.coords,
        feats=asset.feats,
        properties=asset.properties,
        material=asset.material,
        valid=asset.valid,
    )
    return len(asset.coords)

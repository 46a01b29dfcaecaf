"""Compare ways to look labels and properties up at SLAT voxels.

    python benchmarks/lookup.py DIR [DIR ...]

Each DIR holds pixieverse/, slat/ and truth/, as `slatprep make-demo` writes
them. Ways: the nearest annotated voxel (the paper's), and a vote of the
27 nearest annotated voxels, weighted by a Gaussian of their distance (its width
in voxels), with properties averaged over the voxels of the winning class, or
taken from the nearest one of it ("near"). Printed per level,
under the transform that the default engine finds: the share of right classes
over all voxels and over those within two voxels of another class, and the mean
absolute error of log10 E, log10 density and Poisson's ratio.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from engines import pairs_with_truth
from scipy.spatial import cKDTree

from slatprep.align import align
from slatprep.geometry.frames import RESOLUTION, apply_transform, invert_transform, voxel_centres
from slatprep.normalize import to_mapped
from slatprep.parameters import AlignParameters
from slatprep.readers import read_field, read_latents


def main(folders: list[str]) -> None:
    sums: dict[tuple[int, str], list[np.ndarray]] = defaultdict(list)
    for folder in map(Path, folders):
        for pair, path in pairs_with_truth(folder):
            with np.load(path) as file:
                truth = {key: file[key] for key in ("material", "properties", "level", "symmetric")}
            if truth["symmetric"]:
                continue
            field, latents = read_field(pair), read_latents(pair)
            transform = align(field, latents, AlignParameters()).transform
            here = apply_transform(invert_transform(transform), voxel_centres(latents.coords))
            tree = cKDTree(voxel_centres(field.voxels))
            distance, index = tree.query(here, k=27)
            distance = distance * RESOLUTION
            level = int(truth["level"])
            slat = cKDTree(latents.coords.astype(float))
            border = np.array(
                [
                    (truth["material"][near] != truth["material"][row]).any()
                    for row, near in enumerate(slat.query_ball_point(latents.coords, 2.0))
                ]
            )
            mapped = to_mapped(field.properties)
            wanted = to_mapped(truth["properties"])
            ways = {"nearest": (field.material[index[:, 0]], mapped[index[:, 0]])}
            for sigma in (0.5, 0.6, 0.75, 1.0):
                winner, properties, nearest = _vote(field.material, mapped, distance, index, sigma)
                ways[f"vote {sigma} mean"] = winner, properties
                ways[f"vote {sigma} near"] = winner, nearest
            for way, (material, properties) in ways.items():
                right = material == truth["material"]
                error = np.abs(properties - wanted).mean(axis=0)
                near = right[border].mean() if border.any() else np.nan
                sums[level, way].append(np.array([right.mean(), near, *error]))
    print("level  way            labels  at borders  log10 E  log10 density  Poisson's ratio")
    for (level, way), rows in sorted(sums.items()):
        share, border, *error = np.nanmean(rows, axis=0)
        print(f"L{level}     {way:<13}  {share:.4f}  {border:10.4f}", *(f"{e:9.4f}" for e in error))


def _vote(
    material: np.ndarray, mapped: np.ndarray, distance: np.ndarray, index: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    weight = np.exp(-0.5 * (distance / sigma) ** 2) + 1e-12
    votes = np.stack([(weight * (material[index] == k)).sum(axis=1) for k in range(7)], axis=1)
    winner = votes.argmax(axis=1).astype(np.uint8)
    inside = weight * (material[index] == winner[:, None])
    properties = (inside[:, :, None] * mapped[index]).sum(axis=1) / inside.sum(axis=1)[:, None]
    first = (inside > 0).argmax(axis=1)  # neighbours come nearest first
    return winner, properties, mapped[index[np.arange(len(index)), first]]


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(sys.argv[1:])

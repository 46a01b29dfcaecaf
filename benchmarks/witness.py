"""Measure what latents settle, and what they should not have touched.

    python benchmarks/witness.py DIR [--jobs N]

DIR is a dataset with truth, as `slatprep make-demo --latents material` writes
it. Two stores are built of it in a temporary folder, without and with the pass
that compares labels with latents.

An asset counts as tied if a placement that fits as well as the chosen one gives
other classes to more than 5 % of the voxels that have one under all of them. It
is settled right if no tied placement would have more right classes there, but
for 2 %: of a ball whose placements form a continuum, none may be the true one.
Printed beside that: assets without a tie whose row changed, and the share of
right classes of the assets that latents contradict and of the worst ones they do not.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from slatprep.geometry.frames import places_of
from slatprep.inspect.score import read_truth
from slatprep.judge.evidence import HARMLESS
from slatprep.parameters import WitnessParameters
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import build_store
from slatprep.records import UNANNOTATED
from slatprep.sample import sample
from slatprep.store import open_store
from slatprep.store.records import StoredRecords

LEEWAY = 0.02


def main(folder: Path, jobs: int) -> None:
    parameters = load_parameters(folder / "dataset.toml", {})
    with tempfile.TemporaryDirectory() as scratch:
        stores = Path(scratch) / "alone.zarr", Path(scratch) / "heard.zarr"
        for store, settle in zip(stores, (False, True), strict=True):
            witness = WitnessParameters(settle=settle)
            build_store(replace(parameters, witness=witness), store, jobs=jobs)
        measure(folder, *stores)


def measure(folder: Path, alone: Path, heard: Path) -> None:
    before, after = open_store(alone), open_store(heard)
    counts = dict.fromkeys(("tied", "settled", "right before", "right after", "untied"), 0)
    touched, accused, spared = [], [], []
    for first, second in zip(StoredRecords(before), StoredRecords(after), strict=True):
        asset, again = before.asset(first.asset_id), after.asset(first.asset_id)
        truth = read_truth(folder / "truth" / f"{first.asset_id}.npz").material
        share = float((again.material == truth)[again.valid].mean())
        (accused if second.judgement.contradicted else spared).append(share)
        tied = [first.alignment.transform, *(p.transform for p in first.alignment.placements)]
        labels = np.stack(
            [
                sample(
                    asset.field, places_of(asset.latents.centres, t), first.parameters.sample
                ).material
                for t in tied
            ]
        )
        shared = (labels != UNANNOTATED).all(axis=0) & asset.valid & again.valid
        labels = labels[:, shared]
        if (labels != labels[0]).mean(axis=1).max() <= HARMLESS:
            counts["untied"] += 1
            if second.first_pass is not None:
                touched.append((first.asset_id, second.judgement.contradicted, share))
            continue
        best = (labels == truth[shared]).mean(axis=1).max() - LEEWAY
        counts["tied"] += 1
        counts["settled"] += second.alignment.settled_by is not None
        counts["right before"] += (asset.material == truth)[shared].mean() >= best
        counts["right after"] += (again.material == truth)[shared].mean() >= best
    print(*(f"{name}: {count}" for name, count in counts.items()), sep="\n")
    print(f"untied, touched: {len(touched)}")
    for asset_id, contradicted, share in touched:
        what = "contradicted" if contradicted else "settled"
        print(f"    {asset_id} {what}, {share:.3f} of its labels right")
    print("right labels of contradicted assets:", *(f"{share:.3f}" for share in sorted(accused)))
    print("the least of all others:", *(f"{share:.3f}" for share in sorted(spared)[:8]))


if __name__ == "__main__":
    if len(sys.argv) not in (2, 4):
        sys.exit(__doc__)
    main(Path(sys.argv[1]), int(sys.argv[3]) if len(sys.argv) == 4 else 1)

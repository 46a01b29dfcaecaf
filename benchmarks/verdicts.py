"""Measure how often a verdict is wrong.

    python benchmarks/verdicts.py DIR [DIR ...]

Each DIR holds pixieverse/, slat/ and truth/, as `slatprep make-demo` writes
them. Three kinds of alignment are judged:

right      an asset under the transform that the default engine finds, within
           1.5 voxels of the truth;
other      the field of one object on the SLAT of another one, under the best
           transform the engine finds for the two;
second     an asset under the best of the placements that the engine polished
           and rejected, more than 3 voxels from the truth.

Printed: the share of each verdict among each kind, and percentiles of the
lower fitness, from which the thresholds were chosen. A right alignment that is
called failed is a false reject; another object's that is called good is a
false accept. The placements of "second" are never an engine's answer; they say
what the fitness alone cannot tell, and why placements that tie are listed.
"""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np

from slatprep.align import align, field
from slatprep.align.quality import measure_quality
from slatprep.bench.align import pairs_with_truth
from slatprep.bench.truth import read_truth
from slatprep.geometry.frames import displacement, places_of
from slatprep.judge import verdict_of
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.readers import read_field, read_latents
from slatprep.sample import sample

OTHERS = 4
"""With so many other objects each asset is paired."""


def main(folders: list[str]) -> None:
    assets = []
    for folder in map(Path, folders):
        for pair, path in pairs_with_truth(folder):
            assets.append((read_field(pair), read_latents(pair), read_truth(path)))
    rng = np.random.default_rng(0)
    verdicts: dict[str, Counter[str]] = defaultdict(Counter)
    lower: dict[str, list[float]] = defaultdict(list)

    def judged(kind: str, material_field, latents, transform) -> None:
        quality = measure_quality(material_field, latents, transform, 1.0)
        annotation = sample(
            material_field, places_of(latents.coords, transform), SampleParameters()
        )
        verdict, _ = verdict_of(quality, float(annotation.valid.mean()))
        verdicts[kind][str(verdict)] += 1
        lower[kind].append(min(quality.fitness, quality.fitness_backward))

    for material_field, latents, truth in assets:
        with _kept_poses() as polished:
            found = align(material_field, latents, AlignParameters())
        if not truth.symmetric:
            apart = displacement(found.transform, truth.transform, latents.coords)
            judged("right" if apart < 1.5 else "wrong", material_field, latents, found.transform)
            wrong = [
                pose
                for pose in polished
                if displacement(pose.transform, truth.transform, latents.coords) > 3
            ]
            if wrong:
                second = max(wrong, key=lambda pose: pose.score)
                judged("second", material_field, latents, second.transform)
        for other in rng.choice(len(assets), OTHERS, replace=False):
            if assets[other][2].name != truth.name:
                others = assets[other][1]
                found = align(material_field, others, AlignParameters())
                judged("other", material_field, others, found.transform)

    print("kind    count   good  doubtful  failed   lower fitness: 1 %    5 %   50 %   95 %   99 %")
    for kind in ("right", "wrong", "other", "second"):
        count = len(lower[kind])
        if count:
            shares = [verdicts[kind][v] / count for v in ("good", "doubtful", "failed")]
            percentiles = np.percentile(lower[kind], [1, 5, 50, 95, 99])
            print(
                f"{kind:<7} {count:5d}  {shares[0]:5.3f}     {shares[1]:5.3f}   {shares[2]:5.3f}"
                f"                 {'  '.join(f'{p:5.3f}' for p in percentiles)}"
            )


@contextmanager
def _kept_poses() -> Iterator[list]:
    """Yield a list to which every pose is added that the default engine polishes."""
    kept: list = []
    polish = field._Pair.polish

    def keep(pair, poses):
        polished = polish(pair, poses)
        kept.extend(polished)
        return polished

    with mock.patch.object(field._Pair, "polish", keep):
        yield kept


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(sys.argv[1:])

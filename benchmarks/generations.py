"""Align two shapes that a generator made of one object, and judge the result.

    python benchmarks/generations.py [--objects 44] [--seeds 901] [--bends 2 3] [--jobs 2]

Both sides of a pair are generated shapes of level 5, each with its own
proportions and its own bend: the first shape, filled, is the PixieVerse field.
With ``--torn`` bites are removed from both, and each gets a lump that the other
lacks, because generators omit parts and invent others.

The true place of a voxel is the voxel of the first shape that shows the same
point of the object. For each bend it prints, over objects that are not symmetric:

apart     95th percentile of the distance between the shapes under the best
          similarity, in voxels, median over pairs;
heading   share of pairs whose rotation is within 45 degrees of the best similarity's;
the verdicts of these pairs, of the other pairs, and of SLATs of other objects.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slatprep.align import align
from slatprep.align.consensus import degrees_between
from slatprep.demo.asset import DemoView, make_asset
from slatprep.demo.difficulty import LEVELS
from slatprep.geometry.deformation import map_of
from slatprep.geometry.fill import outside_of
from slatprep.geometry.frames import (
    VOXEL_SIZE,
    nearest_similarity,
    places_of,
    split_transform,
    voxel_centres,
)
from slatprep.geometry.voxels import boundary, occupancy_of
from slatprep.judge import judge
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.records import MaterialField, StructuredLatents
from slatprep.sample import sample

WRONG_HEADING = 45.0
"""Degrees from which on a rotation is another heading."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two generated shapes of one object; `places` are where the second one's voxels truly lie."""

    name: str
    category: str
    field: MaterialField
    latents: StructuredLatents
    material: NDArray[np.uint8]
    places: NDArray[np.float64]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=44, help="of each seed")
    parser.add_argument("--seeds", type=int, nargs="+", default=[901])
    parser.add_argument("--bends", type=float, nargs="+", default=[2.0, 3.0], help="voxels, rms")
    parser.add_argument("--torn", action="store_true", help="bites and lumps on both sides")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    print("| bend | pairs | apart | heading | labels | right | wrong | other |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    with ProcessPoolExecutor(options.jobs) as pool:
        for bend in options.bends:
            tasks = [
                (seed, index, bend, options.torn)
                for seed in options.seeds
                for index in range(options.objects)
            ]
            made = pool.map(make_pair, *zip(*tasks, strict=True))
            pairs = [pair for pair in made if pair is not None]
            others = [_of_other_category(pairs, at) for at in range(len(pairs))]
            rows = list(pool.map(_judge, pairs, pairs))
            false = list(pool.map(_judge, pairs, others))
            right, wrong = ([row for row in rows if row[0] is kind] for kind in (True, False))
            print(
                f"| {bend:g} | {len(rows)} | {np.median([row[1] for row in rows]):.1f} "
                f"| {len(right) / len(rows):.3f} | {np.mean([row[2] for row in right]):.3f} "
                f"| {_verdicts(right)} | {_verdicts(wrong)} | {_verdicts(false)} |",
                flush=True,
            )


def make_pair(seed: int, index: int, bend: float, torn: bool) -> Pair | None:
    """Make a pair; None of a symmetric object, which has no one heading."""
    with patch.dict(LEVELS, {5: replace(LEVELS[5], bend=bend)}):
        asset = make_asset(seed, index, levels=(5,), views=2)
    if asset.symmetric:
        return None
    first, second = asset.views
    occupancy, shell = _filled(first), _filled(second)
    if torn:
        rng = np.random.default_rng([seed, index])
        occupancy, shell = _torn(rng, occupancy), _torn(rng, shell)
    voxels = np.argwhere(occupancy).astype(np.uint8)
    nearest = cKDTree(first.coords.astype(float)).query(voxels)[1]
    field = MaterialField(occupancy, voxels, first.material[nearest], first.properties[nearest])

    coords = second.coords if not torn else np.argwhere(boundary(shell)).astype(np.uint8)
    own = cKDTree(second.coords.astype(float)).query(coords)[1]
    shown = cKDTree(first.places).query(second.places[own])[1]
    latents = StructuredLatents(coords, second.feats[own])
    places = voxel_centres(first.coords)[shown]
    return Pair(asset.name, asset.category, field, latents, second.material[own], places)


def _filled(view: DemoView) -> NDArray[np.bool_]:
    shell = occupancy_of(view.coords)
    return shell | ~outside_of(shell)


def _torn(rng: np.random.Generator, occupancy: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Bite two pieces out of a shape, and add a lump on its skin."""
    index = np.argwhere(np.ones(occupancy.shape, dtype=bool))
    skin = np.argwhere(boundary(occupancy))
    torn = occupancy.copy()
    for full, least, most in ((False, 4.0, 8.0), (False, 4.0, 8.0), (True, 3.0, 6.0)):
        centre, radius = skin[rng.integers(len(skin))], rng.uniform(least, most)
        ball = index[((index - centre) ** 2).sum(axis=1) < radius**2]
        torn[tuple(ball.T)] = full
    return torn if torn.any() else occupancy


def _of_other_category(pairs: Sequence[Pair], at: int) -> Pair:
    count = len(pairs)
    others = (pairs[(at + step) % count] for step in range(count // 5, count + count // 5))
    return next(other for other in others if other.category != pairs[at].category)


def _judge(field_of: Pair, latents_of: Pair) -> tuple[bool, float, float, str]:
    """Return whether the heading is right, how far the shapes are apart, labels, the verdict."""
    field, latents, parameters = field_of.field, latents_of.latents, SampleParameters()
    found = align(field, latents, AlignParameters())
    annotation = sample(field, map_of(found).places(latents.coords), parameters)
    verdict = judge(field, latents, found, annotation, parameters)[0].verdict
    best = nearest_similarity(latents_of.places, latents.centres)
    gaps = np.linalg.norm(places_of(latents.centres, best) - latents_of.places, axis=1) / VOXEL_SIZE
    turn = degrees_between(split_transform(found.transform)[0], split_transform(best)[0])
    labels = float((annotation.material == latents_of.material)[annotation.valid].mean())
    return bool(turn < WRONG_HEADING), float(np.percentile(gaps, 95)), labels, str(verdict)


def _verdicts(rows: Iterable[tuple[bool, float, float, str]]) -> str:
    return count_verdicts(row[3] for row in rows)


def count_verdicts(verdicts: Iterable[str]) -> str:
    """Say how many there are of each."""
    counts = Counter(verdicts)
    return ", ".join(f"{counts[word]} {word}" for word in ("good", "doubtful", "failed"))


if __name__ == "__main__":
    main()

"""Align objects whose annotation has a slab of ground, which no SLAT has, and judge the result.

    python benchmarks/ground.py [--seeds 501] [--levels 1 6 7] [--jobs 2]

Objects are one of each category of the demo, and six that are flat or wide themselves.
They fill the grid, or leave 6 or 10 voxels on each side. Each object is placed, in turn, on

none     nothing;
foot     a disc of 0.9 to 1.4 times the object's radius, 1.5 to 4 voxels thick, as all but thin;
wide     a disc of 1.5 to 2.2 times this radius;
thin     a slab as wide as the grid, a voxel thick;
full     a slab as wide as the grid;
tilted   a slab or a disc (half of each), tilted by 5 to 15 degrees against the object;
rough    a slab of uneven thickness, with holes.

The top of the ground lies up to 1.5 voxels above the object's foot. Its class is any class; in a
quarter of the cases it is one of the object's. Results are for objects that are not symmetric, with
the engine as it is and with an engine that does not look for ground. They are the share of right
placements (within 1.5 voxels of the best similarity), the median displacement, the mean share of
right labels beside that of the true places, and the verdicts of right and wrong placements. Further
results are the verdicts of SLATs of other objects, on the slab `full`, and the wrong placements
that are good, with their labels.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from unittest.mock import patch

import numpy as np
from generations import count_verdicts
from numpy.typing import NDArray
from scipy import ndimage

from slatprep.align import align
from slatprep.align import field as engine
from slatprep.demo import nerf
from slatprep.demo.asset import make_asset
from slatprep.demo.catalogue import CATALOGUE
from slatprep.demo.difficulty import LEVELS
from slatprep.demo.model import DemoObject, Rng, draw, made_of, orient
from slatprep.demo.shapes import Shape, box, capsule, cone, cylinder, ellipsoid
from slatprep.geometry.deformation import map_of
from slatprep.geometry.frames import VOXEL_SIZE, places_of, split_transform, voxel_centres
from slatprep.inspect.score import Truth, TruthScore, compare_with_truth
from slatprep.judge import judge
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.records import MaterialField, StructuredLatents
from slatprep.sample import sample

GROUNDS = ("none", "foot", "wide", "thin", "full", "tilted", "rough")

ROOMS = (2.0, 6.0, 10.0)
"""Voxels that are free on each side of the object."""

FLAT: dict[str, tuple[tuple[str, tuple[Shape, ...]], ...]] = {
    "plate": (
        ("ceramic", (cone((0, 0, 0), (0, 0, 0.09), 0.36, 0.5),)),
        ("flesh", (ellipsoid((0.15, 0.05, 0.1), (0.15, 0.09, 0.09)),)),
        ("steel", (box((-0.1, -0.18, 0.1), (0.26, 0.03, 0.02), orient(0.3)),)),
    ),
    "book": (
        ("leaf", (box((0, 0, 0), (0.5, 0.36, 0.07)),)),
        ("plastic", (box((-0.5, 0, 0), (0.03, 0.38, 0.09)), box((0, 0, 0.07), (0.5, 0.38, 0.02)))),
        ("foam", (box((0.56, 0.2, 0), (0.09, 0.03, 0.012)),)),
    ),
    "table": (
        ("wood", (box((0, 0, 0.45), (0.6, 0.38, 0.03)),)),
        ("wood", tuple(
            capsule((x, y, 0.03), (x, y, 0.45), 0.035) for x in (-0.5, 0.5) for y in (-0.3, 0.3)
        )),
        ("plastic", (box((0.3, 0.28, 0.35), (0.18, 0.08, 0.08)),)),
    ),
    "rug": (
        ("foam", (box((0, 0, 0), (0.55, 0.4, 0.025)),)),
        ("petal", (cylinder((0.2, 0.1, 0), (0.2, 0.1, 0.06), 0.15),)),
    ),
    "skateboard": (
        ("wood", (box((0, 0, 0.12), (0.5, 0.14, 0.03)), box((0.58, 0, 0.16), (0.1, 0.13, 0.03)))),
        ("rubber", tuple(
            cylinder((x, y - 0.03, 0.05), (x, y + 0.03, 0.05), 0.05)
            for x in (-0.35, 0.35) for y in (-0.11, 0.11)
        )),
    ),
    "locomotive": (
        ("steel", (box((0, 0, 0.12), (0.6, 0.13, 0.04)), box((-0.35, 0, 0.28), (0.2, 0.12, 0.14)),
                   cylinder((-0.2, 0, 0.24), (0.4, 0, 0.24), 0.1))),
        ("rubber", tuple(
            cylinder((x, y - 0.03, 0.08), (x, y + 0.03, 0.08), 0.08)
            for x in (-0.4, 0.0, 0.4) for y in (-0.14, 0.14)
        )),
    ),
}  # fmt: skip
"""Objects that are flat or wide: stuffs and shapes of each."""


@dataclass(frozen=True, eq=False)
class Asset:
    """Both sides of a demo object; `up` is the unit vector from its foot in the grid's frame."""

    field: MaterialField
    latents: StructuredLatents
    truth: Truth
    places: NDArray[np.float64]
    up: NDArray[np.float64]
    seed: tuple[int, int, int]


@dataclass(frozen=True)
class Row:
    """What came of one alignment."""

    ground: str
    other: bool
    score: TruthScore | None
    verdict: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[501])
    parser.add_argument("--levels", type=int, nargs="+", default=[1, 6, 7])
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.jobs) as pool:
        assets = make_all(options.seeds, options.levels, pool)
        others = [_other(assets, at) for at in range(len(assets))]
        for looks in (True, False):
            rows = [row for some in pool.map(_rows, assets, others, repeat(looks)) for row in some]
            print("as it is" if looks else "without looking for ground")
            _print(rows)


def make_all(seeds: Iterable[int], levels: Sequence[int], pool: Executor) -> list[Asset]:
    """Make all objects of some seeds and levels, without ground."""
    tasks = [
        (seed, index, level)
        for seed in seeds
        for level in levels
        for index in range(len(CATALOGUE) + len(FLAT))
    ]
    return list(pool.map(make_one, *zip(*tasks, strict=True)))


def make_one(seed: int, index: int, level: int) -> Asset:
    """Make an object of the demo or of `FLAT`, without ground."""
    flat = {name: lambda rng, _, name=name: _model(rng, name) for name in FLAT}
    level_here = replace(LEVELS[level], room=ROOMS[(seed + index + level) % 3], own_boxes=True)
    with (
        patch.dict(CATALOGUE, flat),
        patch.dict(LEVELS, {level: level_here}),
        patch.object(nerf, "GROUND_SHARE", 0.0),
    ):
        made = make_asset(seed, index, levels=(level,))
    (view,) = made.views
    truth = Truth(
        Path(), view.transform, view.material, made.name, level, made.symmetric, view.places
    )
    centres = voxel_centres(view.coords)
    places = places_of(centres, view.transform) if view.places is None else view.places
    return Asset(
        _field(made.occupancy, made.grid),
        StructuredLatents(view.coords, view.feats),
        truth,
        places,
        split_transform(view.transform)[0].T[:, 2],
        (seed, index, level),
    )


def _model(rng: Rng, name: str) -> DemoObject:
    parts = [part for stuff, shapes in FLAT[name] for part in made_of(draw(rng, stuff), *shapes)]
    return DemoObject(name, parts)


def _field(occupancy: NDArray[np.bool_], grid: NDArray[np.float32]) -> MaterialField:
    annotated = occupancy & (grid[..., 3] >= 0) & (grid[..., 3] < 7)
    voxels, rows = np.argwhere(annotated).astype(np.uint8), grid[annotated]
    return MaterialField(occupancy, voxels, rows[:, 3].astype(np.uint8), rows[:, [1, 0, 2]].copy())


def on_ground(asset: Asset, kind: str) -> MaterialField:
    """Return an asset's annotation with ground of one of `GROUNDS`."""
    field = asset.field
    if kind == "none":
        return field
    rng = np.random.default_rng([*asset.seed, GROUNDS.index(kind)])
    normal, places = asset.up, asset.places / VOXEL_SIZE
    middle, foot = places.mean(axis=0), (places @ asset.up).min()
    if kind == "tilted":
        aside, angle = np.cross(normal, rng.normal(size=3)), np.radians(rng.uniform(5.0, 15.0))
        normal = np.cos(angle) * normal + np.sin(angle) * aside / np.linalg.norm(aside)
    base = middle - asset.up * (middle @ asset.up - foot)

    def split(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        height = (points - base) @ normal
        return height, np.linalg.norm(points - base - np.outer(height, normal), axis=1)

    shape = field.occupancy.shape
    cells = voxel_centres(np.argwhere(np.ones(shape, dtype=bool))) / VOXEL_SIZE
    height, away = (values.reshape(shape) for values in split(cells))
    size = float(np.quantile(split(places)[1], 0.95))
    radius = {"foot": rng.uniform(0.9, 1.4), "wide": rng.uniform(1.5, 2.2)}.get(kind, np.inf) * size
    if kind == "tilted" and rng.uniform() < 0.5:
        radius = rng.uniform(1.2, 2.0) * size
    thickness = 1.0 if kind == "thin" else rng.uniform(1.5, 4.0)
    top, bumps = np.full(shape, rng.uniform(0.0, 1.5)), np.zeros(shape)
    slab = away < radius
    if kind == "rough":
        bumps = 0.8 * _noise(rng, 2.0)
        slab &= _noise(rng, 3.0) < 1.2
    slab &= (height <= top + bumps) & (height > top - thickness - bumps) & ~field.occupancy
    voxels = np.argwhere(slab).astype(np.uint8)
    own = rng.integers(len(field.material))
    stuff, properties = field.material[own], field.properties[own]
    if rng.uniform() < 0.75:
        stuff, properties = np.uint8(rng.integers(7)), np.array([5e6, 1600, 0.3], np.float32)
    return MaterialField(
        field.occupancy | slab,
        np.concatenate([field.voxels, voxels]),
        np.concatenate([field.material, np.full(len(voxels), stuff)]),
        np.concatenate([field.properties, np.tile(properties, (len(voxels), 1))]),
    )


def _noise(rng: Rng, sigma: float) -> NDArray[np.float64]:
    noise = ndimage.gaussian_filter(rng.normal(size=(64,) * 3), sigma)
    scaled: NDArray[np.float64] = noise / noise.std()
    return scaled


def _other(assets: Sequence[Asset], at: int) -> Asset:
    differ = [asset for asset in assets if asset.truth.name != assets[at].truth.name]
    return differ[np.random.default_rng(at).integers(len(differ))]


def _rows(asset: Asset, other: Asset, looks: bool) -> list[Row]:
    with patch.object(engine, "find_layers", engine.find_layers if looks else lambda _: []):
        rows = [_row(asset, asset, kind) for kind in GROUNDS]
        return [*rows, _row(asset, other, "full")]


def _row(asset: Asset, owner: Asset, kind: str) -> Row:
    field, latents, parameters = on_ground(asset, kind), owner.latents, SampleParameters()
    found = align(field, latents, AlignParameters())
    annotation = sample(field, map_of(found).places(latents.coords), parameters)
    verdict = str(judge(field, latents, found, annotation, parameters)[0].verdict)
    if owner is not asset:
        return Row(kind, True, None, verdict)
    score = compare_with_truth(asset.truth.name, asset.truth, field, latents, annotation)
    return Row(kind, False, score, verdict)


def _print(rows: Iterable[Row]) -> None:
    print("| ground | count | placed | displaced | labels | true places | right | wrong |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    rows = list(rows)
    for kind in GROUNDS:
        own = [(r.score, r) for r in rows if r.ground == kind and r.score and not r.score.symmetric]
        scores = [score for score, _ in own]
        right, wrong = ([r for score, r in own if score.placed is flag] for flag in (True, False))
        print(
            f"| {kind} | {len(own)} | {len(right) / len(own):.3f} "
            f"| {np.median([s.displacement for s in scores]):.2f} "
            f"| {np.mean([s.label_accuracy for s in scores]):.3f} "
            f"| {np.mean([s.truth_own for s in scores]):.3f} "
            f"| {_verdicts(right)} | {_verdicts(wrong)} |"
        )
    print(f"other objects: {_verdicts([row for row in rows if row.other])}")
    sure = [(r.score, r) for r in rows if r.score and not r.score.symmetric and r.verdict == "good"]
    wrong = [f"{s.name} {s.label_accuracy:.2f}" for s, _ in sure if not s.placed]
    print(f"wrong and good, with their labels: {', '.join(wrong)}", flush=True)


def _verdicts(rows: Iterable[Row]) -> str:
    return count_verdicts(row.verdict for row in rows)


if __name__ == "__main__":
    main()

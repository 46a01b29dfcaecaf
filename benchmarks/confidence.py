"""Collect figures of right and wrong placements, for the calibration of confidence.

    python benchmarks/confidence.py table.npz [--assets 14] [--levels 0 1 2 3 4 5 6 7]
                                    [--seeds 101 102] [--jobs 2]
    python benchmarks/confidence.py table.npz --generations [--assets 33] [--seeds 911 912]
    python benchmarks/confidence.py table.npz --ground [--seeds 521]
    python benchmarks/confidence.py table.npz --lumps [--assets 28] [--seeds 1011]
    python benchmarks/confidence.py table.npz --dataset DIR ... [--real]

The default engine aligns demo assets of each level, pairs of generated shapes of one object
(`generations.py`), objects on slabs of ground (`ground.py`), pairs that differ by lumps
(`lumps.py`), or the assets of datasets with a truth. Each row of the table is one alignment:

own      an asset's field on its own SLAT, as the engine places it;
heading  the same, but the engine cannot see placements within 3 voxels of the right placement,
         so that it finds what it would find after missing it;
other    an asset's field on the SLAT of another object.

Each row has the truth ``placed``, the share of right labels, and
`slatprep.judge.evidence.FIGURES`. ``placed`` means within 1.5 voxels of the best similarity; for
real pairs, whose differences blur the truth, within 30 degrees and 4 voxels; it is false for
another object. An even choice of the row's valid voxels has ``voxel_*``: figures, whether the class
is right, and the row.

`benchmarks/calibrate.py` fits to some tables and tests on others. Objects with different seeds are
different objects.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from generations import make_pair
from ground import GROUNDS, make_all, on_ground
from lumps import make_lumpy_pairs
from numpy.typing import NDArray

from slatprep.align import field as engine
from slatprep.align.consensus import degrees_between
from slatprep.demo import make_demo
from slatprep.geometry.deformation import map_of
from slatprep.geometry.frames import VOXEL_SIZE, nearest_similarity, split_transform, voxel_centres
from slatprep.inspect.score import (
    SUCCESS_DISPLACEMENT,
    Truth,
    TruthScore,
    compare_with_truth,
    read_truth,
)
from slatprep.judge import measure_ambiguity
from slatprep.judge.ambiguity import HARMLESS
from slatprep.judge.evidence import evidence_of, surroundings_of
from slatprep.parameters import (
    AlignParameters,
    BuildParameters,
    PixieverseSource,
    SampleParameters,
    SlatSource,
)
from slatprep.readers import discover, read_field, read_latents
from slatprep.records import Alignment, MaterialField, StructuredLatents
from slatprep.sample import sample

HIDDEN = 3.0
"""Placements this near to the right one [voxel] are hidden in kind ``heading``."""

VOXELS = 500
"""Voxels of a row that the table has."""

GENERATIONS, BENDS = 8, (1.5, 3.5)
"""The number that stands for pairs of generated shapes, and how far each is bent [voxel, rms]."""

GROUND = 9
"""The number that stands for objects on ground."""

LUMPS, VARIANTS = 10, 3
"""The number that stands for pairs that differ by lumps, and pairs of one object."""

REAL, REAL_TURN, REAL_APART = 11, 30.0, 4.0
"""The number that stands for real pairs; where their placement is right [degrees, voxel]."""

Asset = tuple[str, MaterialField, StructuredLatents, Truth]
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", type=Path, help="where the table goes, an npz")
    parser.add_argument("--dataset", type=Path, nargs="+", help="instead of demo data")
    parser.add_argument("--generations", action="store_true", help="instead of levels")
    parser.add_argument("--ground", action="store_true", help="instead of levels")
    parser.add_argument("--lumps", action="store_true", help="instead of levels")
    parser.add_argument("--real", action="store_true", help="the datasets are of real pairs")
    parser.add_argument("--assets", type=int, default=14, help="of each level and seed")
    parser.add_argument("--levels", type=int, nargs="+", default=list(range(8)))
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102])
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    rows: list[Row] = []
    if options.dataset:
        for folder in options.dataset:
            assets = _read(folder)
            if options.real:
                # Symmetric, or too far apart for anyone to say what is right.
                assets = [_as_real(asset) for asset in assets if not asset[3].symmetric]
            made = _rows_of_all(assets, options.jobs)
            # Objects are left out together with all that are of their family.
            rows += [{"seed": _number_of(row["family"]) if options.real else 0} | row
                     for row in made]  # fmt: skip
            write(options.table, rows)
        return
    if options.generations or options.ground or options.lumps:
        options.levels = [
            *([GENERATIONS] * options.generations),
            *([GROUND] * options.ground),
            *([LUMPS] * options.lumps),
        ]
    for level in options.levels:
        for seed in options.seeds:
            if level == GENERATIONS:
                assets = _generations(seed, options.assets, options.jobs)
            elif level == GROUND:
                assets = _on_ground(seed, options.jobs)
            elif level == LUMPS:
                assets = _lumpy(seed, options.assets, options.jobs)
            else:
                assets = _made(seed * 10 + level, options.assets, level, options.jobs)
            rows += [{"seed": seed} | row for row in _rows_of_all(assets, options.jobs)]
            write(options.table, rows)  # What is there is kept if a later level stops.


def _made(seed: int, count: int, level: int, jobs: int) -> list[Asset]:
    with tempfile.TemporaryDirectory() as folder:
        make_demo(folder, count, seed, levels=(level,), jobs=jobs)
        return _read(Path(folder))


def _generations(seed: int, count: int, jobs: int) -> list[Asset]:
    """Make pairs of generated shapes, every second one torn, bent more and less."""
    bends = np.random.default_rng(seed).uniform(*BENDS, count)
    tasks = [(seed, index, float(bend), index % 2 == 1) for index, bend in enumerate(bends)]
    with ProcessPoolExecutor(jobs) as pool:
        pairs = list(pool.map(make_pair, *zip(*tasks, strict=True)))
    assets = []
    for number, pair in enumerate(pairs):
        if pair is not None:
            best = nearest_similarity(pair.places, voxel_centres(pair.latents.coords))
            truth = Truth(
                Path(), best, pair.material, pair.name, GENERATIONS, symmetric=False,
                places=pair.places,
            )  # fmt: skip
            assets.append((f"{seed}-{number}", pair.field, pair.latents, truth))
    return assets


def _lumpy(seed: int, count: int, jobs: int) -> list[Asset]:
    """Make some pairs of each object that differ by lumps."""
    with ProcessPoolExecutor(jobs) as pool:
        tasks = [(seed, index, VARIANTS) for index in range(count)]
        made = list(pool.map(make_lumpy_pairs, *zip(*tasks, strict=True)))
    assets = []
    for number, pair in enumerate(pair for pairs in made for pair in pairs):
        best = nearest_similarity(pair.places, voxel_centres(pair.latents.coords))
        truth = Truth(
            Path(), best, pair.material, pair.name, LUMPS, symmetric=False, places=pair.places
        )
        assets.append((f"{seed}-{number}", pair.field, pair.latents, truth))
    return assets


def _as_real(asset: Asset) -> Asset:
    asset_id, field, latents, truth = asset
    return asset_id, field, latents, replace(truth, level=REAL)


def family_of(name: str) -> str:
    """Return what an object is one of: ``house`` of ``house_chimney:1>3``."""
    return name.partition(":")[0].partition("_")[0]


def _number_of(name: str) -> int:
    return int(hashlib.sha256(name.encode()).hexdigest()[:7], 16)


def _on_ground(seed: int, jobs: int) -> list[Asset]:
    """Put each object of `ground.py` on slabs of every second kind."""
    with ProcessPoolExecutor(jobs) as pool:
        made = make_all([seed], [1, 6, 7], pool)
    return [
        (
            f"{seed}-{number}-{kind}",
            on_ground(asset, kind),
            asset.latents,
            replace(asset.truth, level=GROUND),
        )
        for number, asset in enumerate(made)
        for kind in GROUNDS[1 + number % 2 :: 2]
    ]


def _read(root: Path) -> list[Asset]:
    parameters = BuildParameters(
        pixieverse=PixieverseSource(root=root / "pixieverse"),
        slat=SlatSource(root=root / "slat"),
    )
    return [
        (
            pair.asset_id,
            read_field(pair),
            read_latents(pair),
            read_truth(root / "truth" / f"{pair.asset_id}.npz"),
        )
        for pair in discover(parameters)
    ]


def _rows_of_all(assets: list[Asset], jobs: int) -> list[Row]:
    others = [_other(assets, k) for k in range(len(assets))]
    with ProcessPoolExecutor(jobs) as pool:
        made = list(pool.map(_rows_of, assets, others))
    rows = [row for some in made for row in some]
    placed = [row["placed"] for row in rows if row["kind"] == "own" and not row["symmetric"]]
    print(f"level {rows[0]['level']}: {len(rows)} rows, placed {np.mean(placed):.3f}", flush=True)
    return rows


def _other(assets: list[Asset], k: int) -> Asset:
    """Choose another kind of object for an asset, the same whatever the number of jobs."""
    own = family_of(assets[k][3].name)
    differ = [asset for asset in assets if family_of(asset[3].name) != own]
    return differ[np.random.default_rng([len(assets), k]).integers(len(differ))]


def _rows_of(asset: Asset, other: Asset) -> list[Row]:
    _, field, latents, truth = asset
    found = engine.align(field, latents, AlignParameters())
    rows = [_row("own", asset, asset, found)]
    if not truth.symmetric:
        missed = _align_blind(field, latents, truth)
        rows += [] if missed is None else [_row("heading", asset, asset, missed)]
    found = engine.align(field, other[2], AlignParameters())
    return [*rows, _row("other", asset, other, found)]


class _NothingLeftError(Exception):
    """No placement is left that is not the right one."""


def _align_blind(
    field: MaterialField, latents: StructuredLatents, truth: Truth
) -> Alignment | None:
    """Align with the right placement hidden; None where nothing else is left."""
    rotation, shift, scale = split_transform(truth.transform)
    right = engine.Pose(engine.Similarity(rotation, shift / VOXEL_SIZE, scale))

    class Blind(engine.Pair):
        def distinct(self, poses: Any) -> Any:
            far = self.apart(poses, right) >= HIDDEN
            if not far.any():
                raise _NothingLeftError
            return super().distinct([pose for pose, ok in zip(poses, far, strict=True) if ok])

    with patch.object(engine, "Pair", Blind):
        try:
            return engine.align(field, latents, AlignParameters())
        except _NothingLeftError:
            return None


def _row(kind: str, asset: Asset, owner: Asset, alignment: Alignment) -> Row:
    asset_id, field, _, _ = asset
    latents, truth = owner[2], owner[3]
    annotation = sample(field, map_of(alignment).places(latents.coords), SampleParameters())
    looked_up = field, latents, alignment, annotation
    ambiguity, tied = measure_ambiguity(*looked_up, SampleParameters())
    around = surroundings_of(*looked_up, tied)
    score = compare_with_truth(asset_id, truth, field, latents, annotation)
    valid = np.flatnonzero(annotation.valid)
    chosen = valid[np.linspace(0, len(valid) - 1, min(VOXELS, len(valid))).astype(np.intp)]
    columns = (
        around.others, around.solid, around.distance[:, None], around.moved[:, None],
        around.tied[:, None],
    )  # fmt: skip
    right = annotation.material == truth.material
    apart = _displacement(annotation.place, latents, truth)
    return {
        "name": truth.name,
        "level": truth.level,
        "kind": kind,
        "symmetric": truth.symmetric,
        "family": family_of(truth.name),
        "placed": kind != "other" and _placed(alignment, truth, score),
        "displacement": score.displacement,
        "labels": float(right[valid].mean()) if len(valid) else np.nan,
        "model": str(alignment.model),
        "figures": evidence_of(
            field, latents, alignment, annotation, around, ambiguity.material_share
        ),
        "harmless": bool(alignment.placements) and ambiguity.material_share <= HARMLESS,
        "voxels": np.concatenate(columns, axis=1)[chosen],
        "right": right[chosen],
        "apart": apart[chosen],
    }


def _placed(alignment: Alignment, truth: Truth, score: TruthScore) -> bool:
    if truth.level != REAL:
        return score.displacement < score.similarity_displacement + SUCCESS_DISPLACEMENT
    rotations = [split_transform(one.transform)[0] for one in (alignment, truth)]
    return degrees_between(*rotations) < REAL_TURN and score.displacement < REAL_APART


def _displacement(
    place: NDArray[np.float32], latents: StructuredLatents, truth: Truth
) -> NDArray[np.float64]:
    if truth.places is not None:
        true = truth.places
    else:
        inverse = np.linalg.inv(truth.transform)
        true = latents.centres @ inverse[:3, :3].T + inverse[:3, 3]
    apart: NDArray[np.float64] = np.linalg.norm(place - true, axis=1) / VOXEL_SIZE
    return apart


def write(path: Path, rows: list[Row]) -> None:
    """Write rows as an npz: an array a column, and those of the voxels one after another."""
    per_voxel = ("voxels", "right", "apart")
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0].keys() - per_voxel}
    counts = [len(row["right"]) for row in rows]
    columns["voxel_row"] = np.repeat(np.arange(len(rows)), counts)
    columns |= {f"voxel_{name}": np.concatenate([row[name] for row in rows]) for name in per_voxel}
    np.savez_compressed(path, allow_pickle=False, **columns)


if __name__ == "__main__":
    main()

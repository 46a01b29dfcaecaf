"""Measure verdicts and stated errors for datasets at the extremes.

    python benchmarks/ends.py [--assets 126] [--seed 61] [--levels 5 6 7] [--jobs 2]

Datasets of demo objects: one asset, ten, all, all with a fifth of the SLATs shuffled among
themselves, all with all SLATs shuffled, and the same number of balls. For each it prints the number
of assets, of wrong pairs, of good and of failed assets, and of wrong pairs that are good. It also
prints how many of the latter show two objects of one category, and what the decoys state.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from shutil import copytree

import numpy as np

from slatprep.demo.asset import make_asset
from slatprep.demo.catalogue import CATALOGUE
from slatprep.demo.write import write_annotated, write_slat
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.pipeline.dataset import build_store
from slatprep.pipeline.decoys import measure_errors
from slatprep.pipeline.measured import told_of
from slatprep.records import RESOLUTION
from slatprep.store import open_store

BALL = list(CATALOGUE).index("sport_balls")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--assets", type=int, default=126)
    parser.add_argument("--seed", type=int, default=61)
    parser.add_argument("--levels", type=int, nargs="+", default=[5, 6, 7])
    parser.add_argument("--only", nargs="+", default=[], help="names of datasets")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        mixed, balls = Path(scratch, "mixed"), Path(scratch, "balls")
        ids = make(mixed, range(options.assets), options)
        made = dict(zip(ids, order(options), strict=True))
        numbers = range(BALL, BALL + len(CATALOGUE) * options.assets, len(CATALOGUE))
        all_wanted = not options.only
        wants_balls = all_wanted or "balls alone" in options.only
        ball_ids = make(balls, numbers, options) if wants_balls else []
        rng = np.random.default_rng(options.seed)
        fifth = sorted(rng.choice(ids, len(ids) // 5, replace=False).tolist())
        print("| dataset | assets | wrong pairs | good | failed | wrong ones good | decoys say |")
        print("| --- " * 7 + "|")
        for name, source, chosen, wrong in (
            ("one asset", mixed, ids[:1], []),
            ("ten assets", mixed, ids[:10], []),
            ("all", mixed, ids, []),
            ("a fifth of the pairs shuffled", mixed, ids, fifth),
            ("all pairs shuffled", mixed, ids, ids),
            ("balls alone", balls, ball_ids, []),
        ):
            if not (all_wanted or name in options.only):
                continue
            shuffled = dict(zip(wrong, [*wrong[1:], *wrong[:1]], strict=True))
            out = Path(scratch, name.replace(" ", "-"))
            pairs = {one: shuffled.get(one, one) for one in chosen}
            alike = {
                one
                for one, slat in shuffled.items()
                if (made[one] - made[slat]) % len(CATALOGUE) == 0
            }
            print(row(name, source, pairs, alike, out, options.jobs), flush=True)


def make(root: Path, numbers: Iterable[int], options: argparse.Namespace) -> list[str]:
    """Make assets; return their ids in random order."""
    tasks = [(root, options.seed, number, tuple(options.levels)) for number in numbers]
    with ProcessPoolExecutor(options.jobs) as pool:
        ids = list(pool.map(make_one, *zip(*tasks, strict=True)))
    return [ids[k] for k in order(options)]


def order(options: argparse.Namespace) -> list[int]:
    """Return the order in which assets are chosen."""
    order: list[int] = np.random.default_rng(options.seed).permutation(options.assets).tolist()
    return order


def make_one(root: Path, seed: int, number: int, levels: tuple[int, ...]) -> str:
    asset = make_asset(seed, number, levels=levels)
    write_annotated(root / "pixieverse", asset, "pixieverse", RESOLUTION)
    write_slat(root / "slat", asset, "npz", "id", "trellis")
    return asset.object_id


def row(
    name: str, source: Path, slat_of: dict[str, str], alike: set[str], out: Path, jobs: int
) -> str:
    """Pair grids with SLATs as told, build, measure; return a row of the table."""
    (out / "slat").mkdir(parents=True)
    for asset_id, slat in slat_of.items():
        (out / "slat" / f"{asset_id}.npz").hardlink_to(source / "slat" / f"{slat}.npz")
        copytree(source / "pixieverse" / asset_id, out / "pixieverse" / asset_id)
    parameters = BuildParameters(
        pixieverse=PixieverseSource(root=out / "pixieverse"), slat=SlatSource(root=out / "slat")
    )
    build_store(parameters, out / "s.zarr", jobs=jobs)
    store = open_store(out / "s.zarr")
    if len(store) > 1:
        measure_errors(store, jobs=jobs)
    verdicts = dict(zip(store.ids, map(str, store.column("verdict")), strict=True))
    wrong = [one for one, slat in slat_of.items() if one != slat]
    count = list(verdicts.values()).count
    good = [one for one in wrong if verdicts.get(one) == "good"]
    told = "; ".join(told_of(store))
    return (f"| {name} | {len(store)} | {len(wrong)} | {count('good')} | {count('failed')} "
            f"| {len(good)} ({len(alike & set(good))}) | {told} |")  # fmt: skip


if __name__ == "__main__":
    main()

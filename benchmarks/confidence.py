"""Gather what the engine measures of right and of wrong placements, for a calibration.

    python benchmarks/confidence.py figures.csv [--assets 28] [--levels 0 1 2 3 4 5 6 7]
                                    [--seeds 101 102] [--others 2] [--jobs 2]

Demo assets of each level are made and aligned through the Python API. Each line of the
table is one alignment:

own        an asset's field on its own SLAT, as the engine places it;
other      an asset's field on the SLAT of another object;
placement  an asset's field on its own SLAT under one of the alignment's other
           placements, where that lies more than 1.5 voxels off.

Columns: seed, level, name, asset, object (the SLAT's), symmetric, held_out and kind; then
the truth, ``placed`` (within 1.5 voxels of the best similarity; never for another
object), ``displacement``, ``best_similarity`` and ``labels`` (the share of right ones);
then every number that the records of alignment, ambiguity and annotation have, named by
its path. A number that an alignment does not have is empty: of a "placement" these are
all but the quality and the lookup, since its other figures would be the best one's.

Objects are held out, not alignments: the second half of the seeds of each level is the
held-out one, and no object of it occurs in the first half, in whatever kind.
Symmetric objects are kept, and marked: their displacement says nothing.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import math
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from slatprep.align.ambiguity import measure_ambiguity
from slatprep.parallel import single_threaded

from slatprep.align import align
from slatprep.align.deformation import map_of
from slatprep.align.quality import judge, measure_quality
from slatprep.bench.truth import SUCCESS_DISPLACEMENT, Truth, compare_with_truth, read_truth
from slatprep.demo import make_demo
from slatprep.geometry.frames import split_transform
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

_FEW = 4
"""Tuples and arrays of up to so many numbers are columns; of longer ones only the length is."""

_NOT_FIGURES = {"transform", "candidates", "placements", "sources", "settled_by"}

Asset = tuple[str, MaterialField, StructuredLatents, Truth]
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", type=Path, help="where the table goes; .csv or .npz")
    parser.add_argument("--assets", type=int, default=28, help="of each level and seed")
    parser.add_argument("--levels", type=int, nargs="+", default=list(range(8)))
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102])
    parser.add_argument("--others", type=int, default=2, help="other objects an asset")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    if options.table.suffix not in (".csv", ".npz"):
        parser.error(f"{options.table}: expected a name that ends in .csv or .npz")
    rows: list[Row] = []
    for level in options.levels:
        for number, seed in enumerate(options.seeds):
            held_out = 2 * number >= len(options.seeds)
            with tempfile.TemporaryDirectory() as folder:
                make_demo(
                    folder, options.assets, seed * 10 + level, levels=(level,), jobs=options.jobs
                )
                assets = _read(Path(folder))
            made = Parallel(n_jobs=options.jobs)(
                delayed(_rows_of)(assets[k], _others(assets, k, options.others))
                for k in range(len(assets))
            )
            about = {"seed": seed, "level": level, "held_out": int(held_out)}
            rows.extend(about | row for some in made for row in some)
        _report(level, [row for row in rows if row["level"] == level])
        write(options.table, rows)  # what is there is kept if a later level stops


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


def _others(assets: list[Asset], k: int, count: int) -> list[Asset]:
    """Choose other kinds of object for an asset, the same whatever the number of jobs."""
    differ = [asset for asset in assets if asset[3].name != assets[k][3].name]
    chosen = np.random.default_rng([len(assets), k]).permutation(len(differ))[:count]
    return [differ[i] for i in chosen]


def _rows_of(asset: Asset, others: list[Asset]) -> list[Row]:
    asset_id, field, latents, truth = asset
    with single_threaded():
        found = align(field, latents, AlignParameters())
        rows = [_row("own", asset_id, field, latents, found, truth)]
        for placement in found.placements:
            elsewhere = replace(
                found,
                transform=placement.transform,
                quality=measure_quality(field, latents, placement.transform, found.quality.radius),
            )
            row = _row("placement", asset_id, field, latents, elsewhere, truth)
            if not row["placed"]:
                rows.append(_only_quality(row))
        for other_id, _, other, _ in others:
            found = align(field, other, AlignParameters())
            rows.append(_row("other", asset_id, field, other, found, None) | {"object": other_id})
    return [{"name": truth.name} | row for row in rows]


def _row(
    kind: str,
    asset_id: str,
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    truth: Truth | None,
) -> Row:
    annotation = sample(field, map_of(alignment).places(latents.coords), SampleParameters())
    ambiguity = measure_ambiguity(field, latents, alignment, annotation, SampleParameters())
    valid = annotation.valid
    verdict, _ = judge(alignment.quality, float(valid.mean()), ambiguity)
    row: Row = {
        "asset": asset_id,
        "object": asset_id,
        "symmetric": int(truth is not None and truth.symmetric),
        "kind": kind,
        "placed": 0,
        "displacement": math.nan,
        "best_similarity": math.nan,
        "labels": math.nan,
    }
    if truth is not None:
        # A lookup through a deformation says where it went; any other by the transform.
        looked_up = {"places": place} if (place := _places(annotation)) is not None else {}
        score = compare_with_truth(
            asset_id,
            truth,
            coords=latents.coords,
            transform=alignment.transform,
            material=annotation.material,
            valid=valid,
            annotated=field.voxels,
            annotated_material=field.material,
            **looked_up,
        )
        row |= {
            "placed": int(
                score.displacement < score.similarity_displacement + SUCCESS_DISPLACEMENT
            ),
            "displacement": score.displacement,
            "best_similarity": score.similarity_displacement,
            "labels": score.label_accuracy,
        }
    row |= {"verdict": str(verdict), "slat_voxels": len(latents.coords)}
    row |= {"scale": split_transform(alignment.transform)[2]}
    row |= {"valid_share": float(valid.mean()), "ties": len(alignment.placements)}
    near = annotation.distance[np.isfinite(annotation.distance)]
    for name, share in (("median", 0.5), ("p90", 0.9)):
        row[f"lookup_distance.{name}"] = float(np.quantile(near, share)) if len(near) else math.nan
    ranked = sorted((c.fitness for c in alignment.candidates), reverse=True)[:3]
    row |= {f"candidates.{rank}": fitness for rank, fitness in enumerate(ranked)}
    row |= dict(_figures("alignment", alignment))
    row |= dict(_figures("ambiguity", ambiguity))
    return row


def _places(annotation: object) -> Any:
    names = {field.name for field in dataclasses.fields(annotation)}  # type: ignore[arg-type]
    return annotation.place if "place" in names else None  # type: ignore[attr-defined]


def _figures(path: str, value: object) -> Iterator[tuple[str, float | str]]:
    """Yield every number and name in a record by its path."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if field.name not in _NOT_FIGURES:
                yield from _figures(f"{path}.{field.name}", getattr(value, field.name))
    elif isinstance(value, bool | int | float | np.integer | np.floating):
        yield path, float(value)
    elif isinstance(value, str):
        yield path, value
    elif isinstance(value, tuple | np.ndarray):
        flat = np.asarray(value).ravel()
        if flat.dtype.kind in "fiub" and len(flat) <= _FEW:
            yield from ((f"{path}.{k}", float(v)) for k, v in enumerate(flat))
        else:
            yield f"{path}.size", float(flat.size)


def _only_quality(row: Row) -> Row:
    """Drop what was measured of the best placement and not of this one."""
    return {
        name: value
        for name, value in row.items()
        if not name.startswith(("alignment.", "ambiguity.", "candidates."))
        or name.startswith("alignment.quality.")
        or name in ("alignment.engine", "alignment.search")
    }


def write(path: Path, rows: list[Row]) -> None:
    """Write rows as a CSV, or as an npz with one array a column (NaN or "" where empty)."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    if path.suffix == ".csv":
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names, lineterminator="\n")
            writer.writeheader()
            writer.writerows(
                {k: "" if isinstance(v, float) and math.isnan(v) else v for k, v in row.items()}
                for row in rows
            )
        return
    columns = {}
    for name in names:
        texts = any(isinstance(row.get(name), str) for row in rows)
        columns[name] = np.array([row.get(name, "" if texts else math.nan) for row in rows])
    np.savez_compressed(path, allow_pickle=False, **columns)


def _report(level: int, rows: list[Row]) -> None:
    own = [row for row in rows if row["kind"] == "own" and not row["symmetric"]]
    right = [row for row in own if row["placed"]]
    verdicts = "  ".join(
        f"{name} {np.mean([row['verdict'] == name for row in right]):.2f}" if right else ""
        for name in ("good", "doubtful", "failed")
    )
    counts = {kind: sum(row["kind"] == kind for row in rows) for kind in ("other", "placement")}
    labels = np.mean([row["labels"] for row in own]) if own else math.nan
    print(
        f"L{level}: {len(own)} own, placed {len(right) / max(len(own), 1):.2f}, "
        f"labels {labels:.3f}; of the placed ones: {verdicts}; "
        f"{counts['other']} other, {counts['placement']} placements",
        flush=True,
    )


if __name__ == "__main__":
    main()

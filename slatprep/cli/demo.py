"""`slatprep make-demo`: procedural assets with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from slatprep.cli.options import (
    NEW_FOLDER,
    POSITIVE,
    ChoiceOf,
    FiniteRange,
    command,
    jobs_option,
    option,
)
from slatprep.cli.output import Output


@command("make-demo")
@click.argument("directory", type=NEW_FOLDER)
@option("--assets", POSITIVE, 25)
@option("--seed", click.IntRange(min=0), 0)
@option("--level", click.IntRange(0, 7), name="levels", multiple=True)
@option("--views", POSITIVE, 1)
@option("--habitual-share", FiniteRange(0, 1), 0.0)
@option("--latents", ChoiceOf("slatprep.demo.latents:LatentKind"), "placeholder")
@option("--source", ChoiceOf("slatprep.demo.sources:Source"), "pixieverse")
@option("--encoder", ChoiceOf("slatprep.demo.latents:Encoder"), "trellis")
@option("--slat-form", ChoiceOf("slatprep.demo.write:SlatForm"), "npz")
@option("--slat-names", ChoiceOf("slatprep.demo.write:SlatNames"), "id")
@option("--results", is_flag=True)
@option("--samples", POSITIVE, 1)
@jobs_option
def make_demo(output: Output, directory: Path, levels: tuple[int, ...], **recipe: Any) -> None:
    """Make procedural assets with known truth in DIRECTORY.

    Writes pixieverse/ (or the folder of another source), slat/ and truth/ in the
    layouts that build-store reads, and dataset.toml, their definition for
    build-store --config. DIRECTORY must be new, empty, or hold the same demo.

    Options
    -------
    --assets: Number of objects; fourteen have every category once.
    --seed: The same seed gives the same bytes.
    --level: Difficulty, 0 (quarter turns) to 4 (warped), 5 (a generated shape), 6 (a NeRF's
        field), 7 (both); may be repeated: assets take the levels in turn. [default: 0 to 4, or 0
        where both sides share a frame]
    --views: SLATs per object.
    --habitual-share: Share of the objects that have one quarter turn in common.
    --latents: Noise with TRELLIS's statistics (placeholder), or latents that depend on the
        material.
    --source: PixieVerse's grids, predictions of 11 or 4 channels, VoMP's or PhysXNet's voxels,
        or plain voxels with ten properties (in HDF5 without classes).
    --encoder: Latents of TRELLIS, SAM 3D Objects, TRELLIS.2 (-512: on a grid of 32^3), or others
        with 16 channels (-128: on a grid of 128^3).
    --slat-form: Files of (N,3) or (N,4) coordinates, HDF5, or one HDF5 for all.
    --slat-names: Name SLATs by object, or by sha256 with a metadata.csv.
    --results: Also write results/: grids as predicted by a method with errors, 12 MB each, for
        `slatprep evaluate --grids`.
    --samples: Annotations of each object; several have errors, part by part, and dataset.toml
        asks for a merge.

    Example
    -------
    slatprep make-demo demo --assets 14 --seed 0
    slatprep make-demo hard --assets 6 --seed 1 --level 3 --level 4
    slatprep make-demo doubts --assets 6 --samples 5
    slatprep make-demo shapes --assets 6 --seed 1 --level 5 --level 6 --level 7
    slatprep make-demo other --assets 4 --seed 2 --source pixie-predictions --slat-form hdf5
    slatprep make-demo vomp --assets 4 --source vomp --encoder trellis2
    """
    from slatprep import demo
    from slatprep.storage.atomic import writing

    if levels:
        recipe["levels"] = tuple(sorted(set(levels)))
    with writing(str(directory), directory.parent), output.progress("demo") as progress:
        summary = demo.make_demo(directory, progress=progress, **recipe)

    def show() -> None:
        title = f"Demo data in {summary.directory}"
        output.table(title, ("category", "objects"), sorted(summary.categories.items()))
        store = f"{summary.directory}.zarr"
        # Also right where `make align` goes on by itself.
        output.note(f"a store of it: slatprep build-store --config {summary.config} --out {store}")
        output.note(f"its score:     slatprep score {store} {summary.directory / 'truth'}")

    output.made(summary, show)

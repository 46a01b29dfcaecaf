"""`slatprep make-demo`: procedural assets with known truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import click

from slatprep.cli.options import ChoiceOf, FiniteRange, Jobs, NewFolder, Positive, Seed
from slatprep.cli.output import Output
from slatprep.cli.signature import Click, command


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """What `slatprep.demo.make_demo` makes.

    Attributes
    ----------
    assets
        Number of objects; fourteen have every category once.
    seed
        The same seed gives the same bytes.
    levels
        Difficulty, 0 (quarter turns) to 4 (warped), 5 (a generated shape), 6 (a NeRF's field), 7
        (both); may be repeated: assets take the levels in turn. [default: 0 to 4, or 0 where both
        sides share a frame]
    views
        SLATs per object.
    habitual_share
        Share of the objects that have one quarter turn in common.
    latents
        Noise with TRELLIS's statistics (placeholder), or latents that depend on the material.
    source
        PixieVerse's grids, predictions of 11 or 4 channels, VoMP's or PhysXNet's voxels, or plain
        voxels with ten properties (in HDF5 without classes).
    encoder
        Latents of TRELLIS, SAM 3D Objects, TRELLIS.2 (-512: on a grid of 32^3), or others with 16
        channels (-128: on a grid of 128^3).
    slat_form
        Files of (N,3) or (N,4) coordinates, HDF5, or one HDF5 for all.
    slat_names
        Name SLATs by object, or by sha256 with a metadata.csv.
    results
        Also write results/: grids as predicted by a method with errors, 12 MB each, for `slatprep
        evaluate --grids`.
    samples
        Annotations of each object; several have errors, part by part, and dataset.toml asks for a
        merge.
    """

    assets: Positive = 25
    seed: Seed = 0
    levels: Annotated[tuple[int, ...], click.IntRange(0, 7), Click("--level")] = ()
    views: Positive = 1
    habitual_share: Annotated[float, FiniteRange(0, 1)] = 0.0
    latents: Annotated[Any, ChoiceOf("slatprep.demo.latents:LatentKind")] = "placeholder"
    source: Annotated[Any, ChoiceOf("slatprep.demo.sources:Source")] = "pixieverse"
    encoder: Annotated[Any, ChoiceOf("slatprep.demo.latents:Encoder")] = "trellis"
    slat_form: Annotated[Any, ChoiceOf("slatprep.demo.write:SlatForm")] = "npz"
    slat_names: Annotated[Any, ChoiceOf("slatprep.demo.write:SlatNames")] = "id"
    results: bool = False
    samples: Positive = 1


@command("make-demo")
def make_demo(output: Output, directory: NewFolder, *, demo: DemoOptions, jobs: Jobs = 1) -> None:
    """Make procedural assets with known truth in DIRECTORY.

    Writes pixieverse/ (or the folder of another source), slat/ and truth/ in the
    layouts that build-store reads, and dataset.toml, their definition for
    build-store --config. DIRECTORY must be new, empty, or hold the same demo.

    Example
    -------
    slatprep make-demo demo --assets 14 --seed 0
    slatprep make-demo hard --assets 6 --seed 1 --level 3 --level 4
    slatprep make-demo doubts --assets 6 --samples 5
    slatprep make-demo shapes --assets 6 --seed 1 --level 5 --level 6 --level 7
    slatprep make-demo other --assets 4 --seed 2 --source pixie-predictions --slat-form hdf5
    slatprep make-demo vomp --assets 4 --source vomp --encoder trellis2
    """
    from slatprep.demo import make_demo as make
    from slatprep.storage.atomic import writing

    chosen = vars(demo) | {"levels": tuple(sorted(set(demo.levels))) or None}
    with writing(str(directory), directory.parent), output.progress("demo") as progress:
        summary = make(directory, **chosen, jobs=jobs, progress=progress)

    def show() -> None:
        title = f"Demo data in {summary.directory}"
        output.table(title, ("category", "objects"), sorted(summary.categories.items()))
        store = f"{summary.directory}.zarr"
        # Also right where `make align` goes on by itself.
        output.note(f"a store of it: slatprep build-store --config {summary.config} --out {store}")
        output.note(f"its score:     slatprep score {store} {summary.directory / 'truth'}")

    output.made(summary, show)

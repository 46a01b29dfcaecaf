"""`slatprep extract-slat` and `decode-slat`: images to latents, latents to Gaussians."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from slatprep.cli.latents import LatentsReader, standardised_option
from slatprep.cli.options import FILE, NEW_FOLDER, PlaceType, command, option
from slatprep.cli.output import Output
from slatprep.errors import InputError

if TYPE_CHECKING:
    from slatprep.records import Place

_Command = TypeVar("_Command", bound=Callable[..., object])


def _model_options(command: _Command) -> _Command:
    """Add the options for TRELLIS's model and its device."""
    options = (
        option("--model", text="Repository of the model, or its folder.",
               default="microsoft/TRELLIS-image-large"),
        option("--revision", text="Revision of the model.  [default: newest]", metavar="COMMIT"),
        option("--device", text="Where to run it.", default="cuda"),
    )  # fmt: skip
    return functools.reduce(lambda decorated, add: add(decorated), reversed(options), command)


@command("extract-slat")
@click.argument("images", nargs=-1, required=True, type=FILE)
@option("--out", NEW_FOLDER, required=True)
@option("--seed", click.IntRange(min=0), (42,), name="seeds", multiple=True)
@option("--by-folder", is_flag=True)
@_model_options
@option("--no-preprocess", is_flag=True)
def extract_slat(
    output: Output,
    images: tuple[Path, ...],
    out: Path,
    seeds: tuple[int, ...],
    by_folder: bool,
    model: str,
    revision: str | None,
    device: str,
    no_preprocess: bool,
) -> None:
    """Turn IMAGES into structured latents with TRELLIS's image pipeline.

    Every image and seed gives <id>.npz, or <id>/<view>.npz if there are
    views, in the form that build-store reads, and a JSON beside it with
    image, seed, model and revision. Existing files are kept, so that a stopped
    run can be continued. TRELLIS itself must be installed.

    Options
    -------
    --out: Folder of the latents, which build-store takes as --slat.
    --seed: Seed of the sampling; may be repeated, each seed gives a view.
    --by-folder: Images are named <id>/<view>, not <id>.
    --no-preprocess: The background is removed already, and the images are cropped.

    Example
    -------
    slatprep extract-slat renders/*.png --out slat
    slatprep extract-slat renders/*/*.png --by-folder --out slat --seed 0 --seed 1
    """
    from slatprep import extract as work

    extractions = work.list_extractions(images, out, seeds, by_folder)
    session = work.load_session(model, revision, device)
    done, problems = [], []
    with output.progress("extract-slat") as progress:
        results = work.extract(session, extractions, preprocess=not no_preprocess)
        for number, result in enumerate(results):
            if isinstance(result, InputError):
                problems.append(str(result))
                output.problem(f"slatprep: {result}")
            else:
                done.append(result)
            progress(number + 1, len(extractions))
    counts = {
        "extracted": sum(not result.kept for result in done),
        "kept": sum(result.kept for result in done),
        "failed": len(problems),
        "voxels": sum(result.voxels for result in done),
    }

    document = {"path": out, "model": session.model, **counts, "problems": problems}
    output.made(document, lambda: output.record(f"Latents in {out}", counts), complete=not problems)


@command("decode-slat")
@click.argument("source", type=PlaceType(path_type=Path, exists=True))
@option("--out", NEW_FOLDER, required=True)
@option("--asset", metavar="ID", name="assets", multiple=True)
@standardised_option
@_model_options
def decode_slat(
    output: Output,
    source: Place,
    out: Path,
    assets: tuple[str, ...],
    standardised: str,
    model: str,
    revision: str | None,
    device: str,
) -> None:
    """Decode the structured latents of SOURCE to Gaussians with TRELLIS's decoder.

    SOURCE is a SLAT (npz or HDF5), a folder of them, or a store. Each asset
    gives <id>.ply, as TRELLIS saves Gaussians, to which `slatprep transfer`
    gives materials. TRELLIS itself must be installed.

    Options
    -------
    --out: Folder of the Gaussians; files of other assets are kept.
    --asset: Decode only this asset; may be repeated.

    Example
    -------
    slatprep decode-slat slat/cup.npz --out gaussians
    slatprep decode-slat data/demo.zarr --asset 5f61cc --out gaussians
    """
    from slatprep import extract as work
    from slatprep.records import TRELLIS
    from slatprep.storage.names import file_name

    read = LatentsReader(output, source, assets, TRELLIS, standardised)
    session = work.load_session(model, revision, device)
    begin, decoded = time.perf_counter(), 0
    with output.progress("decode-slat") as progress:
        for latents in read:
            path = out / f"{file_name(read.done[-1])}.ply"
            try:
                work.decode_gaussians(session, latents, path)
                decoded += 1
            except InputError as error:
                read.leave_out(error)
            progress(decoded + len(read.problems), len(read.ids))
    counts = {"decoded": decoded, "failed": len(read.problems)}
    document = {"path": out, "model": session.model, **counts, "problems": read.problems,
                "seconds": time.perf_counter() - begin}  # fmt: skip
    output.made(
        document, lambda: output.record(f"Gaussians in {out}", counts), complete=not read.problems
    )

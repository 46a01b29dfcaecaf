"""`slatprep extract-slat`: structured latents of images, by TRELLIS."""

from __future__ import annotations

from pathlib import Path

import click

from slatprep.cli.options import FILE, NEW_FOLDER, command, option
from slatprep.cli.output import Output
from slatprep.errors import InputError


@command("extract-slat")
@click.argument("images", nargs=-1, required=True, type=FILE)
@option("--out", NEW_FOLDER, required=True)
@option("--seed", click.IntRange(min=0), (42,), name="seeds", multiple=True)
@option("--by-folder", is_flag=True)
@option("--model", default="microsoft/TRELLIS-image-large")
@option("--revision", metavar="COMMIT")
@option("--device", default="cuda")
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

    Every image and seed gives <id>.npz, or <id>/<view>.npz where there are
    views, in the form that build-store reads, and a JSON beside it that says
    image, seed, model and revision. Existing files are kept, so that a stopped
    run goes on. TRELLIS itself must be installed.

    Options
    -------
    --out: The --slat of build-store.
    --seed: Seed of what is drawn; may be repeated, each seed is a view.
    --by-folder: Images are named <id>/<view>, not <id>.
    --model: Repository of the model, or its folder.
    --revision: Revision of the model. [default: newest]
    --device: Where to run it.
    --no-preprocess: Images are cut out and cropped already.

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

"""`slatprep extract-slat` and `decode-slat`: make latents from images, Gaussians from latents."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from slatprep.cli.options import AssetsOrAll, File, FileOrUrl, NewFolder, Whole
from slatprep.cli.output import Output
from slatprep.cli.signature import Click, command
from slatprep.errors import InputError

if TYPE_CHECKING:
    from slatprep.extract import Session

Standardised = Annotated[
    Literal["auto", "yes", "no"],
    "Whether the latents of files are standardised already; auto: judged by their values.",
]


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """TRELLIS's model and its device.

    Attributes
    ----------
    model
        Repository of the model, or its folder.
    revision : COMMIT
        Revision of the model. [default: newest]
    device
        Device that runs the model. [default: the GPU if there is one]
    """

    model: str = "microsoft/TRELLIS-image-large"
    revision: str | None = None
    device: str | None = None

    def load(self, output: Output) -> Session:
        """Load the model; print its device if --device was not given."""
        from slatprep.extract import load_session

        session = load_session(self.model, self.revision, self.device)
        if self.device is None:
            output.note(f"TRELLIS runs on {session.device}")
        return session


@command("extract-slat")
def extract_slat(
    output: Output,
    images: tuple[File, ...],
    *,
    out: NewFolder,
    seeds: Annotated[tuple[int, ...], Whole(min=0), Click("--seed")] = (42,),
    by_folder: bool = False,
    model: ModelOptions,
    no_preprocess: bool = False,
) -> None:
    """Turn IMAGES into structured latents with TRELLIS's image pipeline.

    Every image and seed gives <id>.npz, or <id>/<view>.npz if there are
    views, in the format that build-store reads, and a JSON beside it with
    image, seed, model and revision. Existing files are kept, so that a stopped
    run can be continued. TRELLIS itself must be installed.

    Parameters
    ----------
    out
        Folder of the latents, which build-store takes as --slat.
    seeds
        Seed of the sampling; may be repeated: each seed gives a view.
    by_folder
        Images are named <id>/<view>, not <id>.
    no_preprocess
        The images already have no background, and are cropped.

    Example
    -------
    slatprep extract-slat renders/*.png --out slat
    slatprep extract-slat renders/*/*.png --by-folder --out slat --seed 0 --seed 1
    """
    from slatprep import extract as work

    extractions = work.list_extractions(images, out, seeds, by_folder)
    session = model.load(output)
    counts = {"extracted": 0, "kept": 0, "failed": 0, "voxels": 0}
    problems = []
    with output.progress("extract-slat") as progress:
        results = work.extract(session, extractions, preprocess=not no_preprocess)
        for number, result in enumerate(results, 1):
            if isinstance(result, InputError):
                counts["failed"] += 1
                problems.append(str(result))
                output.problem(f"slatprep: {result}")
            else:
                counts["kept" if result.kept else "extracted"] += 1
                counts["voxels"] += result.voxels
            progress(number, len(extractions))
    told = {"path": out, "model": session.model, "problems": problems}
    output.counted(f"Latents in {out}", counts, complete=not problems, **told)


@command("decode-slat")
def decode_slat(
    output: Output,
    source: FileOrUrl,
    *,
    out: NewFolder,
    assets: AssetsOrAll = (),
    standardised: Standardised = "auto",
    model: ModelOptions,
) -> None:
    """Decode the structured latents of SOURCE to Gaussians with TRELLIS's decoder.

    SOURCE is a SLAT (npz or HDF5), a folder of SLATs, or a store. Each asset
    gives <id>.ply, in the format of TRELLIS's Gaussians; `slatprep transfer`
    gives them materials. TRELLIS itself must be installed.

    Parameters
    ----------
    out
        Folder of the Gaussians; files of other assets are kept.

    Example
    -------
    slatprep decode-slat slat/cup.npz --out gaussians
    slatprep decode-slat data/demo.zarr --asset 5f61cc --out gaussians
    """
    from slatprep import extract as work
    from slatprep.latents import LatentsReader
    from slatprep.records import TRELLIS
    from slatprep.storage.files import file_name

    read = LatentsReader(source, assets, TRELLIS, standardised, output.note, output.problem)
    session = model.load(output)
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
    told = {"path": out, "model": session.model, "problems": read.problems}
    seconds = time.perf_counter() - begin
    output.counted(
        f"Gaussians in {out}", counts, complete=not read.problems, seconds=seconds, **told
    )

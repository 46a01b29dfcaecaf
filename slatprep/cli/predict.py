"""`slatprep predict`: predict material fields from latents with a trained decoder."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from slatprep.cli import options
from slatprep.cli.latents import LatentsReader, Standardised
from slatprep.cli.output import Output
from slatprep.cli.signature import command
from slatprep.errors import ConfigError, InputError

if TYPE_CHECKING:
    from slatprep.extract import Session
    from slatprep.records import Place

_IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".bmp")


@command()
def predict(
    output: Output,
    source: options.FileOrUrl,
    *,
    checkpoint: options.FileOrFolder,
    out: options.NewFolder,
    assets: options.AssetIds = (),
    gaussians: options.NewFile | None = None,
    seed: options.Seed = 42,
    far: Annotated[Any, options.ChoiceOf("slatprep.particles.transfer:Far")] = "background",
    device: Literal["cpu", "cuda"] | None = None,
    batch_voxels: options.Positive = 65536,
    standardised: Standardised = "auto",
) -> None:
    """Predict material fields of SOURCE with a trained decoder.

    SOURCE is a SLAT (npz or HDF5), a folder of them, a store, or an image,
    whose latents TRELLIS samples if it is installed. Each asset gives
    <id>.npz with coords, properties in [-1,1] and properties_si in Pa,
    kg/m^3 and 1, material, probabilities of the eight classes, ranges, the
    checkpoint's SHA-256 and the seconds of its decoding. `slatprep evaluate`
    and `slatprep transfer --prediction` read these files.
    Needs PyTorch: pip install 'slatprep[train]'.

    Parameters
    ----------
    checkpoint
        best.pt of a run of `slatprep train`, or the folder of the run.
    out
        Folder of the predictions; files of other assets are kept.
    assets
        Predict only this asset; may be repeated.
    gaussians : FILE.ply
        Also decode an image's latents to Gaussians, and write those with their materials.
    seed
        Seed of an image's latents.
    far
        With --gaussians: give far Gaussians class 7 and properties 0, leave them out, or give them
        the nearest material.
    device
        Where to compute. [default: cpu; for an image the GPU if there is one]
    batch_voxels
        Number of voxels up to which assets are decoded together.

    Example
    -------
    slatprep predict latents --checkpoint runs/small --out predictions
    slatprep predict data/demo.zarr --checkpoint runs/small/best.pt --out predictions --device cuda
    slatprep predict cup.png --checkpoint runs/large --out cup --gaussians cup.ply --device cuda
    """
    from slatprep.learn import require_torch

    is_image = source.suffix.lower() in _IMAGES
    require_torch(device or "cpu")
    import torch

    if device is None:
        # TRELLIS needs a GPU.
        device = "cuda" if is_image and torch.cuda.is_available() else "cpu"
        if is_image:
            output.note(f"TRELLIS and the decoder run on {device}")
    from slatprep.learn import predict as work
    from slatprep.learn.published import SECONDS, SECONDS_OF_OTHERS

    if gaussians is not None and not is_image:
        raise ConfigError(
            "--gaussians goes with an image; `slatprep decode-slat` makes Gaussians of latents, "
            "and `slatprep transfer` gives them materials"
        )
    decoder = work.load_checkpoint(checkpoint, device)
    image = _draw(output, source, out, seed, device) if is_image else None
    space = decoder.contents.latents
    if image is not None:
        standardised = "no"  # TRELLIS samples them as its decoders take them.
    read = LatentsReader(output, image.latents if image else source, assets, space, standardised)
    counts = {"predicted": 0, "voxels": 0}
    seconds = {**(image.seconds if image else {}), "read": 0.0, "decode": 0.0, "write": 0.0}
    with output.progress("predict") as progress:
        progress(0, len(read.ids))
        for number, field in enumerate(work.predict(decoder, read, batch_voxels=batch_voxels)):
            begin = time.perf_counter()
            try:
                work.write_prediction(out, read.done[number], field, decoder)
            except InputError as error:
                read.leave_out(error)
            else:
                counts["predicted"] += 1
                counts["voxels"] += len(field.coords)
            seconds["write"] += time.perf_counter() - begin
            seconds["decode"] += field.seconds
            progress(counts["predicted"] + len(read.problems), len(read.ids))
    seconds["read"] = read.seconds
    if image and gaussians is not None and counts["predicted"]:
        begin = time.perf_counter()
        _write_gaussians(output, image, out, gaussians, far)
        seconds["gaussians"] = time.perf_counter() - begin
    about = {"path": out, "checkpoint": decoder.sha256, "size": decoder.size}

    def show() -> None:
        output.record(f"Predictions in {out}", counts)
        each = 1e3 / max(counts["predicted"], 1)
        stages = {**seconds, "in all": sum(seconds.values())}
        columns, shown = ("stage", "seconds", "ms an asset", "SLAT-Phys, s"), 4 if image else 3
        rows = [(name, s, s * each, SECONDS.get(name, ""))[:shown] for name, s in stages.items()]
        output.table("Time", columns[:shown], rows)
        if image:
            others = ", ".join(
                f"{name} {spent:,.0f} s" for name, spent in SECONDS_OF_OTHERS.items()
            )
            output.note(f"SLAT-Phys's times are of an A5000; it prints beside them: {others}")

    document = {**about, **counts, "seconds": seconds, "problems": read.problems}
    output.made(document, show, complete=not read.problems)


@dataclass(frozen=True)
class _Image:
    """Latents of an image: their file, the pipeline that sampled them, and time by stage."""

    latents: Path
    session: Session
    seconds: Mapping[str, float]


def _draw(output: Output, source: Place, out: Path, seed: int, device: str) -> _Image:
    """Sample the latents of an image."""
    from slatprep import extract as work

    session = work.load_session(device=device)
    extractions = work.list_extractions([Path(str(source))], out / "latents", [seed], False)
    (result,) = work.extract(session, extractions)
    if isinstance(result, InputError):
        raise result
    output.note(f"latents: {extractions[0].slat}{', drawn before' if result.kept else ''}")
    return _Image(extractions[0].slat, session, result.seconds)


def _write_gaussians(output: Output, image: _Image, out: Path, path: Path, far: Any) -> None:
    """Decode an image's latents to Gaussians, and give each the material of its voxel."""
    from slatprep.extract import decode_gaussians
    from slatprep.particles import transfer as work
    from slatprep.particles.fields import predicted_field
    from slatprep.particles.read import read_particles
    from slatprep.readers import read_slat
    from slatprep.storage.files import file_name

    plain = out / "gaussians.ply"
    decode_gaussians(image.session, read_slat(image.latents, image.latents.parent), plain)
    field = predicted_field(out / f"{file_name(image.latents.stem)}.npz", None)
    particles = read_particles(plain, "trellis")
    result = work.transfer(particles.in_slat(), field, far=far)
    if result.far:
        count = len(particles.positions)
        output.note(f"{result.far:,} of {count:,} Gaussians have no voxel: {far}")
    work.write_transferred(path, particles, result, max_distance=2.0, in_slat=False)

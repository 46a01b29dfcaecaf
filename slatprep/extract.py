"""Run TRELLIS's image pipeline and save its structured latents as `build-store` reads them.

TRELLIS (https://github.com/microsoft/TRELLIS) is not a dependency: it needs a
GPU, kernels of its own and weights. It is imported when a pipeline is loaded.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.errors import ConfigError, InputError, SlatprepError
from slatprep.readers.patterns import NAME
from slatprep.readers.slat import LATENT_CHANNELS, check_coords
from slatprep.storage.atomic import staged

if TYPE_CHECKING:
    from PIL.Image import Image

MODEL = "microsoft/TRELLIS-image-large"
"""The model of TRELLIS that turns images into structured latents."""

FORMAT = "slatprep-extraction"

_LATENTS = (
    "as TRELLIS's pipeline returns them: multiplied with the model's std and moved by its mean, "
    "the form that its decoders take and its dataset toolkit saves"
)


class Pipeline(Protocol):
    """What is used of ``trellis.pipelines.TrellisImageTo3DPipeline``."""

    sparse_structure_sampler_params: dict[str, Any]
    slat_sampler_params: dict[str, Any]
    slat_normalization: dict[str, Any]

    def preprocess_image(self, input: Image) -> Image:
        """Cut the object out, and crop."""

    def get_cond(self, image: list[Image]) -> dict[str, Any]:
        """Encode images."""

    def sample_sparse_structure(
        self, cond: dict[str, Any], num_samples: int = 1, sampler_params: dict[str, Any] = ...
    ) -> Any:
        """Draw occupied voxels, (N, 4) with a leading batch column."""

    def sample_slat(
        self, cond: dict[str, Any], coords: Any, sampler_params: dict[str, Any] = ...
    ) -> Any:
        """Draw latents on them; returns a sparse tensor with ``coords`` and ``feats``."""


@dataclass(frozen=True)
class Session:
    """A loaded pipeline, the torch it runs on, and what the provenance says of both."""

    pipeline: Pipeline
    torch: Any
    model: dict[str, str]


@dataclass(frozen=True)
class Job:
    """An image, a seed, and where the latents go; paths are those of the npz and its record."""

    image: Path
    seed: int
    slat: Path
    record: Path


@dataclass(frozen=True)
class Extracted:
    """What became of a job: its number of voxels, and whether it had been done before."""

    job: Job
    voxels: int
    kept: bool


def load_session(model: str = MODEL, revision: str | None = None, device: str = "cuda") -> Session:
    """Load TRELLIS's image pipeline.

    Parameters
    ----------
    model : str
        Name of the model's repository, or a folder that holds its files.
    revision : str, optional
        Commit, tag or branch of the repository; by default its main branch.
        The commit that was taken is in the provenance.
    device : str
        The torch device to run on.

    Raises
    ------
    SlatprepError
        If TRELLIS is not installed; the message says what to do.
    ConfigError
        If a folder is given a revision.
    """
    try:
        import torch
        from trellis.pipelines import TrellisImageTo3DPipeline
    except ImportError as error:
        raise SlatprepError(
            f"extract-slat runs TRELLIS, and {error.name or 'a part of it'} is not installed; "
            "install TRELLIS as https://github.com/microsoft/TRELLIS says, on a machine with an "
            "NVIDIA GPU of at least 16 GB, and slatprep into the same environment"
        ) from error
    if Path(model).is_dir():
        if revision is not None:
            raise ConfigError(f"{model} is a folder, which has no revision; leave --revision out")
        folder, taken = Path(model), "local folder"
    else:
        # Fetched by commit first, so that what is recorded is what is loaded.
        from huggingface_hub import snapshot_download

        folder = Path(snapshot_download(model, revision=revision))
        taken = folder.name
    pipeline = TrellisImageTo3DPipeline.from_pretrained(str(folder))
    pipeline.to(torch.device(device))
    about = {"name": model, "revision": taken, "torch": str(torch.__version__)}
    description = folder / "pipeline.json"
    if description.is_file():
        about["pipeline_sha256"] = hashlib.sha256(description.read_bytes()).hexdigest()
    return Session(pipeline, torch, about)


def plan(images: Sequence[Path], out: Path, seeds: Sequence[int], by_folder: bool) -> list[Job]:
    """Name what each image and seed will be saved as.

    Parameters
    ----------
    images : sequence of Path
        The images.
    out : Path
        Folder of the latents, the root that `build-store` takes.
    seeds : sequence of int
        Seeds, each of which gives every image one SLAT.
    by_folder : bool
        Whether an image is named ``<id>/<view>``; otherwise its name is the id.

    Returns
    -------
    list of Job
        ``<id>.npz``, or ``<id>/<view>.npz`` where there are views: folders,
        several seeds, or both (``<view>-seed-<seed>``).

    Raises
    ------
    ConfigError
        If a name cannot be an id, or two images or seeds have one name.
    """
    jobs: dict[Path, Job] = {}
    for image in images:
        folder = image.resolve().parent.name
        object_id, view = (folder, image.stem) if by_folder else (image.stem, "")
        for name in filter(None, (object_id, view)):
            if not NAME.fullmatch(name):
                raise ConfigError(
                    f"{image}: {name!r} cannot be an id or a view; expected letters, digits, "
                    "and . _ - that are not first"
                )
        for seed in seeds:
            of_seed = f"seed-{seed}" if len(seeds) > 1 else ""
            label = "-".join(filter(None, (view, of_seed)))
            stem = f"{object_id}/{label}" if label else object_id
            job = Job(image, seed, out / f"{stem}.npz", out / f"{stem}.json")
            if job.slat in jobs:
                raise ConfigError(
                    f"{image} and {jobs[job.slat].image} would both be {stem}.npz; expected one "
                    "image an id (or --by-folder), and each seed once"
                )
            jobs[job.slat] = job
    return list(jobs.values())


def extract(
    session: Session, jobs: Sequence[Job], *, preprocess: bool = True
) -> Iterator[Extracted | InputError]:
    """Run the pipeline and save latents with their provenance, one job after the other.

    Parameters
    ----------
    session : Session
        The loaded pipeline.
    jobs : sequence of Job
        What `plan` made.
    preprocess : bool
        Whether the pipeline cuts the object out and crops, as it does by
        default; images that are prepared already need it not.

    Yields
    ------
    Extracted or InputError
        What became of each job, or why it gave nothing; the others go on. A
        SLAT whose record says the same image, seed and model is kept.
    """
    for job in jobs:
        try:
            yield _extract(session, job, preprocess)
        except InputError as error:
            yield error


def _extract(session: Session, job: Job, preprocess: bool) -> Extracted:
    data, image = _read_image(job.image)
    pipeline = session.pipeline
    document = {
        "format": FORMAT,
        "format_version": 1,
        "slatprep": metadata.version("slatprep"),
        "image": {"name": job.image.name, "sha256": hashlib.sha256(data).hexdigest()},
        "seed": job.seed,
        "preprocessed": preprocess,
        "model": session.model,
        "sparse_structure_sampler_params": dict(pipeline.sparse_structure_sampler_params),
        "slat_sampler_params": dict(pipeline.slat_sampler_params),
        "slat_normalization": dict(pipeline.slat_normalization),
        "feats": _LATENTS,
    }
    # As it is read again, to be compared with: lists for tuples and arrays.
    text = orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)
    record: dict[str, Any] = orjson.loads(text)
    if job.slat.exists():
        return _kept(job, record)
    coords, feats = _run(session, image, job.seed, preprocess)
    check_coords(coords, job.image)
    if len(coords) == 0 or feats.shape != (len(coords), LATENT_CHANNELS):
        raise InputError(
            job.image,
            f"gave coords {coords.shape} and feats {feats.shape}",
            f"N > 0 voxels with {LATENT_CHANNELS} channels; look at what is in the image",
        )
    if not np.isfinite(feats).all():
        raise InputError(job.image, "gave latents that are not finite", "another seed or image")
    with staged(job.slat) as path, path.open("wb") as stream:
        np.savez(stream, coords=coords, feats=feats)
    record["slat"] = {
        "voxels": len(coords),
        "sha256": hashlib.sha256(job.slat.read_bytes()).hexdigest(),
    }
    with staged(job.record) as path:
        path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return Extracted(job, len(coords), kept=False)


def _run(
    session: Session, image: Image, seed: int, preprocess: bool
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    pipeline = session.pipeline
    # The same calls in the same order as the pipeline's own `run`, which draws
    # the same numbers for a seed, but decodes latents instead of returning them.
    with session.torch.no_grad():
        if preprocess:
            image = pipeline.preprocess_image(image)
        cond = pipeline.get_cond([image])
        session.torch.manual_seed(seed)
        voxels = pipeline.sample_sparse_structure(cond, 1)
        slat = pipeline.sample_slat(cond, voxels)
    return (
        np.ascontiguousarray(slat.coords.detach().cpu().numpy(), dtype=np.int32),
        np.ascontiguousarray(slat.feats.detach().cpu().float().numpy(), dtype=np.float32),
    )


def _kept(job: Job, record: dict[str, Any]) -> Extracted:
    try:
        before = json.loads(job.record.read_text("utf-8"))
        slat = before.pop("slat")
        same = before == record
        intact = hashlib.sha256(job.slat.read_bytes()).hexdigest() == slat["sha256"]
        voxels = int(slat["voxels"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        same = intact = False
        voxels = 0
    if not (same and intact):
        raise InputError(
            job.slat,
            "exists, and its record does not say that it came from this image, seed and model",
            "a new folder, or that you move the file away",
        )
    return Extracted(job, voxels, kept=True)


def _read_image(path: Path) -> tuple[bytes, Image]:
    from PIL import Image, UnidentifiedImageError

    try:
        data = path.read_bytes()
        image = Image.open(io.BytesIO(data))
        image.load()
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError, SyntaxError) as error:
        raise InputError(path, f"cannot be read ({error})", "an image, such as a PNG") from None
    return data, image

"""Run TRELLIS's pipeline: images to structured latents, and latents to Gaussians.

TRELLIS (https://github.com/microsoft/TRELLIS) is not a dependency, since it needs a GPU, its own
CUDA kernels and its weights. It is imported when a pipeline is loaded.
"""

from __future__ import annotations

import hashlib
import io
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from slatprep.errors import ConfigError, InputError
from slatprep.readers.patterns import NAME
from slatprep.readers.slat import check_coords
from slatprep.records import TRELLIS, StructuredLatents
from slatprep.storage.atomic import staged
from slatprep.storage.files import file_digest
from slatprep.trellis_latents import FORMAT, MODELS, move, sample_trellis

if TYPE_CHECKING:
    from PIL.Image import Image

MODEL = MODELS["trellis"]
"""The model of TRELLIS that turns images into structured latents."""

_LATENTS = (
    "as TRELLIS's pipeline returns them: multiplied with the model's std and moved by its mean, "
    "the form that its decoders take and its dataset toolkit saves"
)


@dataclass(frozen=True)
class Session:
    """A loaded pipeline, its torch module, the description of both for the records, its device.

    The pipeline is a ``trellis.pipelines.TrellisImageTo3DPipeline``.
    """

    pipeline: Any
    torch: Any
    model: dict[str, str]
    device: str = ""


@dataclass(frozen=True)
class Extraction:
    """An image, a seed, and the npz for its latents; the record is a JSON beside it."""

    image: Path
    seed: int
    slat: Path

    @property
    def record(self) -> Path:
        """The file with the provenance."""
        return self.slat.with_suffix(".json")


@dataclass(frozen=True)
class Extracted:
    """The result of an extraction: its number of voxels, and whether an existing SLAT was kept.

    `seconds` has the time of each stage; it is empty for a SLAT that was kept.
    """

    voxels: int
    kept: bool
    seconds: Mapping[str, float] = field(default_factory=dict)


def load_session(
    model: str = MODEL, revision: str | None = None, device: str | None = None
) -> Session:
    """Load TRELLIS's image pipeline; by default on the GPU if there is one.

    `model` is a repository or a folder of its files, `revision` a commit, tag or branch of the
    repository. ConfigError if TRELLIS is not installed, the model cannot be loaded, or a folder is
    given a revision.
    """
    with redirect_stdout(sys.stderr):  # TRELLIS prints which kernels it takes when imported.
        try:
            import torch
            from trellis.pipelines import TrellisImageTo3DPipeline
        except ImportError as error:
            raise ConfigError(
                f"TRELLIS draws and decodes latents, and {error.name or 'a part of it'} is not "
                "installed. Install TRELLIS as https://github.com/microsoft/TRELLIS says, and "
                "slatprep into the same environment. It needs an NVIDIA GPU of at least 16 GB"
            ) from error
        local = Path(model).is_dir()
        if local and revision is not None:
            raise ConfigError(f"{model} is a folder, which has no revision; leave --revision out")
        try:
            # Fetched first, so that the commit that is loaded is known.
            folder = Path(model) if local else _fetched(model, revision)
            pipeline = TrellisImageTo3DPipeline.from_pretrained(str(folder))
            device = move(pipeline, torch, device)
        except Exception as error:  # The hub's client, TRELLIS and torch have errors of any type.
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"the model {model} cannot be loaded ({type(error).__name__}: {reason}); expected "
                "a folder of its files or a repository of Hugging Face, a network, a token in "
                "HF_TOKEN if it is gated, and a device that PyTorch has"
            ) from error
        taken = "local folder" if local else folder.name
    about = {"name": model, "revision": taken, "torch": str(torch.__version__)}
    description = folder / "pipeline.json"
    if description.is_file():
        about["pipeline_sha256"] = file_digest(description)
    return Session(pipeline, torch, about, device)


def _fetched(model: str, revision: str | None) -> Path:
    from huggingface_hub import snapshot_download

    return Path(snapshot_download(model, revision=revision))


def list_extractions(
    images: Sequence[Path], out: Path, seeds: Sequence[int], by_folder: bool
) -> list[Extraction]:
    """Name the files for each image and seed, below the root `out` that `build-store` takes.

    They are ``<id>.npz``, or ``<id>/<view>.npz`` if there are views: folders, several seeds, or
    both (``<view>-seed-<seed>``). ConfigError if a name cannot be an id, or occurs twice.
    """
    listed: dict[Path, Extraction] = {}
    for image in images:
        names = [image.resolve().parent.name, image.stem] if by_folder else [image.stem]
        for name in names:
            if not NAME.fullmatch(name):
                raise ConfigError(
                    f"{image}: {name!r} cannot be an id or a view; expected letters, digits, "
                    "and . _ - that are not first"
                )
        object_id, *view = names
        for seed in seeds:
            label = "-".join([*view, *([f"seed-{seed}"] if len(seeds) > 1 else [])])
            stem = f"{object_id}/{label}" if label else object_id
            slat = out / f"{stem}.npz"
            if slat in listed:
                raise ConfigError(
                    f"{image} and {listed[slat].image} would both be {stem}.npz; expected one "
                    "image an id (or --by-folder), and each seed once"
                )
            listed[slat] = Extraction(image, seed, slat)
    return list(listed.values())


def extract(
    session: Session, extractions: Iterable[Extraction], *, preprocess: bool = True
) -> Iterator[Extracted | InputError]:
    """Run the pipeline, and save latents with their provenance, one image and seed at a time.

    Without `preprocess` the images must be cropped and without background. Yields the result of
    each, or its error, which does not stop the others. An existing SLAT is kept if its record has
    the same image, seed, model and settings; versions of slatprep and torch may differ.
    """
    for extraction in extractions:
        try:
            yield _extract(session, extraction, preprocess)
        except InputError as error:
            yield error


def decode_gaussians(session: Session, latents: StructuredLatents, path: Path) -> None:
    """Decode latents to Gaussians and save them as TRELLIS does; replace an existing file.

    Standardised latents are converted back, since the decoder takes them as the pipeline samples
    them. InputError if TRELLIS cannot decode them.
    """
    from trellis.modules.sparse import SparseTensor

    torch, device = session.torch, session.pipeline.device
    coords = np.insert(latents.coords.astype(np.int32), 0, 0, axis=1)
    space = replace(TRELLIS, standardised=latents.standardised)
    with _named(path, f"decode its {len(coords)} voxels"), torch.no_grad():
        slat = SparseTensor(
            feats=torch.tensor(space.as_encoded(latents.feats), device=device),
            coords=torch.from_numpy(coords).to(device),
        )
        (gaussians,) = session.pipeline.decode_slat(slat, ["gaussian"])["gaussian"]
    with staged(path) as file:
        gaussians.save_ply(str(file))


@contextmanager
def _named(path: Path, what: str) -> Iterator[None]:
    """Raise errors of TRELLIS and torch as InputError with the file; keep prints off stdout.

    RuntimeError means no memory left, ValueError that `preprocess_image` finds no foreground.
    """
    try:
        with redirect_stdout(sys.stderr):
            yield
    except (RuntimeError, ValueError, IndexError) as error:
        raise InputError(
            path,
            f"TRELLIS could not {what} ({type(error).__name__}: {' '.join(str(error).split())})",
            "an image with a foreground, or latents of TRELLIS, and enough memory on the GPU",
        ) from error


def _extract(session: Session, extraction: Extraction, preprocess: bool) -> Extracted:
    data, image = _read_image(extraction.image)
    pipeline = session.pipeline
    document = {
        "format": FORMAT,
        "format_version": 1,
        "slatprep": metadata.version("slatprep"),
        "image": {"name": extraction.image.name, "sha256": hashlib.sha256(data).hexdigest()},
        "seed": extraction.seed,
        "preprocessed": preprocess,
        "model": session.model,
        "sparse_structure_sampler_params": dict(pipeline.sparse_structure_sampler_params),
        "slat_sampler_params": dict(pipeline.slat_sampler_params),
        "slat_normalization": dict(pipeline.slat_normalization),
        "feats": _LATENTS,
    }
    # Through JSON and back, to equal a record that was read: lists for tuples and arrays.
    text = orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)
    record: dict[str, Any] = orjson.loads(text)
    if extraction.slat.exists():
        return _kept(extraction, record)
    with _named(extraction.image, "make latents of it"):
        coords, feats, seconds = sample_trellis(
            pipeline, session.torch, image, extraction.seed, preprocess
        )
    check_coords(coords, extraction.image)
    if len(coords) == 0 or feats.shape != (len(coords), TRELLIS.channels):
        raise InputError(
            extraction.image,
            f"gave coords {coords.shape} and feats {feats.shape}",
            f"N > 0 voxels with {TRELLIS.channels} channels; look at what is in the image",
        )
    if not np.isfinite(feats).all():
        raise InputError(
            extraction.image, "gave latents that are not finite", "another seed or image"
        )
    with staged(extraction.slat) as path:
        with path.open("wb") as stream:
            np.savez(stream, coords=coords, feats=feats)
        record["slat"] = {"voxels": len(coords), "sha256": file_digest(path)}
        # The record comes first: without it, a run that goes on would refuse the SLAT.
        with staged(extraction.record) as about:
            about.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return Extracted(len(coords), kept=False, seconds=seconds)


def _kept(extraction: Extraction, record: dict[str, Any]) -> Extracted:
    try:
        before = json.loads(extraction.record.read_text("utf-8"))
        slat = before.pop("slat")
        if (
            _asked_for(before) == _asked_for(record)
            and file_digest(extraction.slat) == slat["sha256"]
        ):
            return Extracted(int(slat["voxels"]), kept=True)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass  # A record that cannot be read does not identify the file either.
    raise InputError(
        extraction.slat,
        "exists, and its record does not say that it came from this image, seed and model",
        "a new folder, or that you move the file away",
    )


def _asked_for(record: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of a record that must be equal for a SLAT to be kept: no versions."""
    model = {name: value for name, value in record["model"].items() if name != "torch"}
    rest = {name: value for name, value in record.items() if name not in ("slatprep", "feats")}
    return rest | {"model": model}


def _read_image(path: Path) -> tuple[bytes, Image]:
    from PIL import Image

    try:
        data = path.read_bytes()
        image = Image.open(io.BytesIO(data))
        image.load()
    except Exception as error:  # Pillow's formats raise errors of any type.
        raise InputError(path, f"cannot be read ({error})", "an image, such as a PNG") from None
    return data, image

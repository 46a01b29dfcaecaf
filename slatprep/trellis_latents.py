"""Latents of images by TRELLIS, TRELLIS.2 or SAM 3D Objects: one file that runs alone.

TRELLIS's set-up makes a Python 3.10, in which slatprep cannot be installed. Copy this file there
and run it. It needs numpy and the packages that the generator's set-up installs:

    python trellis_latents.py images/*.png --out slat
    python trellis_latents.py images/*.png --out slat --generator trellis2 --pipeline 1024
    python trellis_latents.py images/*.png --out slat --generator sam3d

Each image gives <id>.npz, or <id>/seed-<seed>.npz with several seeds, as `slatprep build-store`
reads them. `slatprep extract-slat` makes the same calls in a Python 3.11 with TRELLIS.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

if __name__ == "__main__" and (Path(__file__).parent / "inspect").is_dir():
    sys.path[0] = str(Path.cwd())  # Not slatprep's folder: its `inspect` hides Python's.

import numpy as np

STAGES = ("image", "sparse structure", "SLAT")
"""Timed stages: background removal and image encoder; occupied voxels; their latents."""

FORMAT = "slatprep-extraction"

Sampled = tuple[np.ndarray, np.ndarray, dict[str, float]]
"""coords (N, 4) int32 with the batch column first, feats (N, C) float32, seconds by stage."""

MODELS = {"trellis": "microsoft/TRELLIS-image-large", "trellis2": "microsoft/TRELLIS.2-4B"}


class Stages(dict[str, float]):
    """The seconds of each of `STAGES` that has ended."""

    def __init__(self, torch: Any, device: Any) -> None:
        self.torch, self.device, self.begin = torch, device, time.perf_counter()

    def end(self) -> None:
        """End a stage and keep its seconds; wait for kernels, which run asynchronously."""
        if str(self.device).startswith("cuda"):
            self.torch.cuda.synchronize()
        now = time.perf_counter()
        self[STAGES[len(self)]] = now - self.begin
        self.begin = now


def sample_trellis(pipeline: Any, torch: Any, image: Any, seed: int, preprocess: bool) -> Sampled:
    """Sample by TRELLIS's `TrellisImageTo3DPipeline`.

    The calls and their order are those of the pipeline's `run`, so that a seed gives the same
    numbers; `run` itself does not return the latents.
    """
    stages = Stages(torch, pipeline.device)
    with torch.no_grad():
        if preprocess:
            image = pipeline.preprocess_image(image)
        cond = pipeline.get_cond([image])
        stages.end()
        torch.manual_seed(seed)
        voxels = pipeline.sample_sparse_structure(cond, 1)
        stages.end()
        slat = pipeline.sample_slat(cond, voxels)
        stages.end()
    return *arrays_of(slat), stages


def sample_trellis2(
    pipeline: Any, torch: Any, image: Any, seed: int, preprocess: bool, kind: str = "1024"
) -> Sampled:
    """Sample the shape latents of TRELLIS.2's `Trellis2ImageTo3DPipeline`.

    The calls and their order are those of its `run` for the pipeline types 512 (a grid of 32^3)
    and 1024 (64^3), up to the texture.
    """
    stages = Stages(torch, pipeline.device)
    with torch.no_grad():
        if preprocess:
            image = pipeline.preprocess_image(image)
        torch.manual_seed(seed)
        coarse = pipeline.get_cond([image], 512)
        cond = coarse if kind == "512" else pipeline.get_cond([image], 1024)
        stages.end()
        voxels = pipeline.sample_sparse_structure(coarse, {"512": 32, "1024": 64}[kind], 1)
        stages.end()
        model = pipeline.models["shape_slat_flow_model_" + kind]
        slat = pipeline.sample_shape_slat(cond, model, voxels)
        stages.end()
    return *arrays_of(slat), stages


def sample_sam3d(inference: Any, torch: Any, image: Any, seed: int) -> Sampled:
    """Sample by SAM 3D Objects' `Inference` of its notebook; the image's alpha is the mask.

    Its pipeline returns Gaussians and meshes. It passes the latents to `decode_slat`.
    """
    pipeline, seen = inference._pipeline, []
    decode = pipeline.decode_slat

    def watching(slat: Any, *rest: Any, **options: Any) -> Any:
        seen.append(arrays_of(slat))
        return decode(slat, *rest, **options)

    pixels = np.array(image.convert("RGBA"))
    begin = time.perf_counter()
    pipeline.decode_slat = watching
    try:
        inference(pixels[..., :3], pixels[..., 3] > 127, seed=seed)
    finally:
        pipeline.decode_slat = decode
    if len(seen) != 1:
        raise ValueError(f"decode_slat was called {len(seen)} times; expected once")
    return *seen[0], {"all": time.perf_counter() - begin}


def arrays_of(slat: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return coords (N, 4) int32 and feats (N, C) float32 of a sparse tensor."""
    return (
        np.ascontiguousarray(slat.coords.detach().cpu().numpy(), dtype=np.int32),
        np.ascontiguousarray(slat.feats.detach().cpu().float().numpy(), dtype=np.float32),
    )


def extract(
    sample: Callable[[Any, int], Sampled],
    images: list[Path],
    out: Path,
    seeds: list[int],
    about: dict[str, Any],
) -> int:
    """Write the latents of each image and seed; return how many failed.

    Existing files stay; one that is not of this image, seed and `about` counts as failed.
    """
    from PIL import Image

    failed = 0
    for path in images:
        for seed in seeds:
            name = path.stem if len(seeds) == 1 else f"{path.stem}/seed-{seed}"
            slat = out / (name + ".npz")
            try:
                data = path.read_bytes()
                image_of = {"name": path.name, "sha256": hashlib.sha256(data).hexdigest()}
                asked = {"image": image_of, "seed": seed, **about}
                if slat.exists():
                    before = json.loads(slat.with_suffix(".json").read_text("utf-8"))
                    if asked != {key: before.get(key) for key in asked}:
                        raise ValueError(f"{slat} is of another image, seed or model; move it away")
                    print(f"{slat}: is there already", file=sys.stderr)
                    continue
                with Image.open(path) as image, redirect_stdout(sys.stderr):
                    image.load()
                    coords, feats, seconds = sample(image, seed)
                if len(coords) == 0 or not np.isfinite(feats).all():
                    raise ValueError("no voxels, or latents that are not finite")
            except Exception as error:  # No foreground, no memory left, ...: the others go on.
                print(f"{path}: {type(error).__name__}: {error}", file=sys.stderr)
                failed += 1
                continue
            slat.parent.mkdir(parents=True, exist_ok=True)
            part = slat.with_suffix(".part")
            with part.open("wb") as stream:
                np.savez(stream, coords=coords, feats=feats)
            record = {
                "format": FORMAT,
                "format_version": 1,
                **asked,
                "slat": {
                    "voxels": len(coords),
                    "sha256": hashlib.sha256(part.read_bytes()).hexdigest(),
                },
                "seconds": seconds,
            }
            slat.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", "utf-8")
            part.replace(slat)
            print(f"{slat}: {len(coords)} voxels", file=sys.stderr)
    return failed


def move(pipeline: Any, torch: Any, device: str | None) -> str:
    """Move a pipeline to a device, by default the GPU if there is one; return which it is."""
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    pipeline.to(torch.device(device))
    return device


def load(options: argparse.Namespace) -> Callable[[Any, int], Sampled]:
    """Load the generator, and return a function that samples an image with a seed."""
    with redirect_stdout(sys.stderr):
        import torch

        preprocess = not options.no_preprocess
        if options.generator == "sam3d":
            sys.path.append("notebook")  # In SAM 3D Objects' checkout.
            from inference import Inference  # type: ignore[import-not-found]

            loaded = Inference(options.model or "checkpoints/hf/pipeline.yaml", compile=False)
            return lambda image, seed: sample_sam3d(loaded, torch, image, seed)
        if options.generator == "trellis2":
            from trellis2.pipelines import Trellis2ImageTo3DPipeline as Pipeline
        else:
            from trellis.pipelines import TrellisImageTo3DPipeline as Pipeline
        pipeline = Pipeline.from_pretrained(options.model or MODELS[options.generator])
        print(f"runs on {move(pipeline, torch, options.device)}", file=sys.stderr)
    if options.generator == "trellis2":
        kind = options.pipeline
        return lambda image, seed: sample_trellis2(pipeline, torch, image, seed, preprocess, kind)
    return lambda image, seed: sample_trellis(pipeline, torch, image, seed, preprocess)


def main(words: list[str] | None = None) -> int:
    """Parse the options and extract; return the exit code, 1 if an image failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("images", nargs="+", type=Path, help="images, each named <id>")
    add("--out", type=Path, required=True, help="folder of the latents")
    add("--seed", type=int, action="append", help="may be repeated [42]")
    add("--generator", choices=("trellis", "trellis2", "sam3d"), default="trellis")
    add("--pipeline", choices=("512", "1024"), default="1024", help="of trellis2 [1024]")
    add("--model", help="repository or folder of the model; of sam3d its pipeline.yaml")
    add("--device", help="[the GPU if there is one]")
    add("--no-preprocess", action="store_true", help="images are cropped, without background")
    options = parser.parse_args(words)
    stems = [path.stem for path in options.images]
    if len(set(stems)) != len(stems):
        parser.error("two images have one name")
    about = {
        "generator": options.generator,
        "model": {"name": options.model or MODELS.get(options.generator, "")},
        "preprocessed": not options.no_preprocess,
        **({"pipeline": options.pipeline} if options.generator == "trellis2" else {}),
    }
    sample = load(options)
    return 1 if extract(sample, options.images, options.out, options.seed or [42], about) else 0


if __name__ == "__main__":
    sys.exit(main())

"""Our side of the extraction, against an object with the interface of TRELLIS's pipeline.

The stand-in draws from a generator that `manual_seed` seeds, as torch's does,
so that order and number of the calls matter as they do with the real one.
"""

import contextlib
import hashlib
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support import commands
from support.synthetic import make_asset

from slatprep import extract as work
from slatprep.errors import ConfigError, InputError

MEAN, STD = [0.5] * 8, [2.0] * 8


class Tensor:
    """As much of a torch tensor as latents are read by."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def detach(self) -> "Tensor":
        return self

    cpu = float = detach

    def numpy(self) -> np.ndarray:
        return self.values


class Torch(ModuleType):
    """Seeds, and knows whether gradients are off."""

    def __init__(self) -> None:
        super().__init__("torch")
        self.__version__ = "2.0"
        self.rng, self.gradients = np.random.default_rng(), True
        self.cuda = SimpleNamespace(is_available=lambda: self.gpu, synchronize=lambda: None)
        self.gpu = True

    def manual_seed(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    @contextlib.contextmanager
    def no_grad(self) -> Any:
        self.gradients = False
        yield
        self.gradients = True

    def device(self, name: str) -> str:
        return f"device {name}"


class Pipeline:
    """TRELLIS's interface; the object in the image is an L of `voxels` voxels."""

    device = "cpu"

    def __init__(self, torch: Torch, voxels: int | None = None) -> None:
        self.torch, self.voxels, self.seen = torch, voxels, []
        self.sparse_structure_sampler_params = {"steps": 12, "cfg_strength": 7.5}
        self.slat_sampler_params = {"steps": 12, "cfg_strength": 3.0, "cfg_interval": [0.5, 1.0]}
        self.slat_normalization = {"mean": MEAN, "std": STD}

    def to(self, device: str) -> None:
        self.device = device

    def preprocess_image(self, input: Image.Image) -> Image.Image:
        self.seen.append("cropped")
        return input.resize((518, 518))

    def get_cond(self, image: list[Image.Image]) -> dict[str, Any]:
        assert not self.torch.gradients
        self.seen.append(image[0].size)
        self.torch.rng.normal(size=3)  # what is drawn before the seed is set must not matter
        return {"cond": float(np.asarray(image[0]).mean()), "neg_cond": 0.0}

    def sample_sparse_structure(
        self, cond: dict, num_samples: int = 1, sampler_params: dict | None = None
    ) -> np.ndarray:
        assert num_samples == 1 and not sampler_params and not self.torch.gradients
        coords = make_asset(0).coords[: self.voxels]
        return np.insert(self.torch.rng.permutation(coords).astype(np.int64), 0, 0, axis=1)

    def sample_slat(
        self, cond: dict, coords: np.ndarray, sampler_params: dict | None = None
    ) -> Any:
        drawn = self.torch.rng.normal(size=(len(coords), 8)) + cond["cond"]
        feats = drawn * STD + MEAN
        return SimpleNamespace(coords=Tensor(coords), feats=Tensor(feats))


@pytest.fixture
def session() -> work.Session:
    torch = Torch()
    return work.Session(Pipeline(torch), torch, {"name": "m", "revision": "abc"})


@pytest.fixture
def images(tmp_path: Path) -> list[Path]:
    paths = []
    for number, name in enumerate(("cup", "bear")):
        paths.append(tmp_path / "images" / f"{name}.png")
        paths[-1].parent.mkdir(exist_ok=True)
        Image.new("RGB", (40, 30), (50 * number, 10, 10)).save(paths[-1])
    return paths


def run(session: work.Session, images: list[Path], out: Path, *seeds: int) -> list[Any]:
    return list(work.extract(session, work.list_extractions(images, out, list(seeds), False)))


def test_latents_and_their_record_are_what_the_pipeline_returns(session, images, tmp_path):
    [result] = run(session, images[:1], tmp_path / "slat", 7)
    with np.load(tmp_path / "slat" / "cup.npz") as saved:
        coords, feats = saved["coords"], saved["feats"]
    assert (coords.dtype, feats.dtype) == (np.int32, np.float32)
    # What a person who calls the pipeline by hand after seeding it would get.
    torch = Torch()
    pipeline = Pipeline(torch)
    with torch.no_grad():
        cond = pipeline.get_cond([pipeline.preprocess_image(Image.open(images[0]))])
        torch.manual_seed(7)
        slat = pipeline.sample_slat(cond, pipeline.sample_sparse_structure(cond))
    np.testing.assert_array_equal(coords, slat.coords.numpy())
    np.testing.assert_array_equal(feats, slat.feats.numpy().astype(np.float32))
    assert result.voxels == len(coords) and session.pipeline.seen == ["cropped", (518, 518)]
    # And how to do it again.
    record = json.loads((tmp_path / "slat" / "cup.json").read_text("utf-8"))
    assert record["seed"] == 7 and record["model"] == {"name": "m", "revision": "abc"}
    assert record["slat_normalization"] == {"mean": MEAN, "std": STD}
    assert record["sparse_structure_sampler_params"]["cfg_strength"] == 7.5
    for key, file in (("image", images[0]), ("slat", tmp_path / "slat" / "cup.npz")):
        assert record[key]["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()


def test_same_seed_gives_the_same_bytes_and_is_not_drawn_twice(session, images, tmp_path):
    for folder in ("a", "b"):
        run(session, images, tmp_path / folder, 3)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    calls = len(session.pipeline.seen)
    again = run(session, images, tmp_path / "a", 3)
    assert all(result.kept for result in again) and len(session.pipeline.seen) == calls
    other = run(session, images, tmp_path / "a", 4)
    assert all(isinstance(result, InputError) for result in other)
    assert (tmp_path / "a" / "cup.npz").read_bytes() == (tmp_path / "b" / "cup.npz").read_bytes()


def test_names(tmp_path):
    images = [tmp_path / "bear" / "front.png", tmp_path / "bear" / "side.png"]

    def names(seeds: list[int], by_folder: bool) -> list[str]:
        listed = work.list_extractions(images, tmp_path, seeds, by_folder)
        return [one.slat.relative_to(tmp_path).as_posix() for one in listed]

    assert names([1], False) == ["front.npz", "side.npz"]
    assert names([1], True) == ["bear/front.npz", "bear/side.npz"]
    assert names([1, 2], False)[:2] == ["front/seed-1.npz", "front/seed-2.npz"]
    assert names([1, 2], True)[1] == "bear/front-seed-2.npz"
    with pytest.raises(ConfigError, match="would both be"):
        work.list_extractions([images[0], tmp_path / "cup" / "front.png"], tmp_path, [1], False)
    with pytest.raises(ConfigError, match="cannot be an id"):
        work.list_extractions([tmp_path / ".hidden.png"], tmp_path, [1], False)


class Strict(Pipeline):
    """Prints, and finds the box of the foreground as TRELLIS's `preprocess_image` does."""

    def preprocess_image(self, input: Image.Image) -> Image.Image:
        print("[ATTENTION] Using backend: flash_attn")
        np.min(np.argwhere(np.array(input)[..., 0] > 20)[:, 1])
        return super().preprocess_image(input)


class Full(Pipeline):
    """Has no memory left for the first image."""

    def sample_slat(self, cond: dict, coords: np.ndarray, *rest: Any) -> Any:
        if self.seen.count((518, 518)) == 1:
            raise RuntimeError("CUDA out of memory")
        return super().sample_slat(cond, coords, *rest)


@pytest.mark.parametrize(("kind", "said"), [
    (Pipeline, "cannot be read"),
    (Full, "TRELLIS could not make latents of it (RuntimeError: CUDA out"),
    (Strict, "TRELLIS could not make latents of it (ValueError: zero-size"),
])  # fmt: skip
def test_a_bad_image_does_not_stop_the_others(kind, said, images, tmp_path, capsys):
    if kind is Pipeline:
        images[0].write_bytes(b"no image")
    torch = Torch()
    bad, good = run(work.Session(kind(torch), torch, {}), images, tmp_path / "slat", 0)
    assert isinstance(bad, InputError) and f"cup.png: {said}" in str(bad) and good.voxels > 0
    assert [path.name for path in (tmp_path / "slat").glob("*.npz")] == ["bear.npz"]
    printed = capsys.readouterr()
    assert printed.out == "" and ("[ATTENTION]" in printed.err) == (kind is Strict)
    empty = work.Session(Pipeline(torch, voxels=0), torch, {})
    [nothing] = run(empty, images[1:], tmp_path / "none", 0)
    assert isinstance(nothing, InputError) and not (tmp_path / "none" / "bear.npz").exists()


@pytest.mark.parametrize("command", ["extract-slat", "decode-slat"])
def test_without_trellis_the_command_says_what_to_install(command, images, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trellis.pipelines", None)
    asset = make_asset(0)
    np.savez(tmp_path / "cup.npz", coords=asset.coords, feats=asset.feats)
    source = images[0] if command == "extract-slat" else tmp_path / "cup.npz"
    told = commands.refused(command, source, "--out", tmp_path / "slat")
    assert len(told.splitlines()) == 1
    assert "Install TRELLIS as https://github.com/microsoft/TRELLIS says" in told
    assert not (tmp_path / "slat").exists()


@pytest.mark.parametrize("gpu", [True, False])
def test_command_loads_one_commit_of_the_model(gpu, images, tmp_path, monkeypatch):
    torch, commit = Torch(), "0123abcd"
    torch.gpu = gpu
    pipeline, asked = Pipeline(torch), []

    def snapshot_download(name: str, revision: str | None) -> str:
        asked.append((name, revision))
        return str(tmp_path / commit)

    def from_pretrained(path: str) -> Pipeline:
        print("[SPARSE] Backend: spconv, Attention: flash_attn")
        asked.append(path)
        return pipeline

    loader = SimpleNamespace(from_pretrained=from_pretrained)
    fakes = {
        "torch": torch,
        "trellis": ModuleType("trellis"),
        "trellis.pipelines": SimpleNamespace(TrellisImageTo3DPipeline=loader),
        "huggingface_hub": SimpleNamespace(snapshot_download=snapshot_download),
    }
    for name, module in fakes.items():
        monkeypatch.setitem(sys.modules, name, module)
    words = ("--out", tmp_path / "slat", "--json", "--revision", "v1", "--no-preprocess")
    result = commands.run("extract-slat", *images, *words)
    document = json.loads(result.stdout)
    assert document["model"]["revision"] == commit and document["extracted"] == 2
    assert asked == [("microsoft/TRELLIS-image-large", "v1"), str(tmp_path / commit)]
    # What TRELLIS prints never comes between the lines of the document.
    device = "cuda" if gpu else "cpu"
    assert "[SPARSE]" in result.stderr and f"TRELLIS runs on {device}" in result.stderr
    assert pipeline.device == f"device {device}" and "cropped" not in pipeline.seen

"""Extraction in both files, against an object with the interface of TRELLIS's pipeline."""

import ast
import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import Mock, call

import numpy as np
import pytest
import torch
from PIL import Image, PngImagePlugin
from support import commands
from support.synthetic import make_asset

from slatprep import extract as work
from slatprep import trellis_latents
from slatprep.errors import ConfigError, InputError
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import discover, read_latents

MEAN, STD = [0.5] * 8, [2.0] * 8


class Pipeline:
    """TRELLIS's interface; the object in the image is an L of `voxels` voxels."""

    device = "cpu"
    sparse_structure_sampler_params: ClassVar = {"steps": 12, "cfg_strength": 7.5}
    slat_sampler_params: ClassVar = {"steps": 12, "cfg_strength": 3.0, "cfg_interval": [0.5, 1.0]}
    slat_normalization: ClassVar = {"mean": MEAN, "std": STD}

    def __init__(self, voxels: int | None = None) -> None:
        self.voxels, self.seen = voxels, []

    def to(self, device: torch.device) -> None:
        self.device = device

    def preprocess_image(self, input: Image.Image) -> Image.Image:
        self.seen.append("cropped")
        return input.resize((518, 518))

    def get_cond(self, image: list[Image.Image]) -> dict[str, Any]:
        assert not torch.is_grad_enabled()
        self.seen.append(image[0].size)
        torch.rand(3)  # what is drawn before the seed is set must not matter
        return {"cond": float(np.asarray(image[0]).mean()), "neg_cond": 0.0}

    def sample_sparse_structure(self, cond, num_samples=1, sampler_params=None) -> torch.Tensor:
        assert num_samples == 1 and not sampler_params and not torch.is_grad_enabled()
        coords = torch.from_numpy(make_asset(0).coords[: self.voxels].astype(np.int64))
        return torch.nn.functional.pad(coords[torch.randperm(len(coords))], (1, 0))

    def sample_slat(self, cond: dict, coords: torch.Tensor, sampler_params=None) -> Any:
        drawn = torch.randn(len(coords), 8) + cond["cond"]
        return SimpleNamespace(coords=coords, feats=drawn * torch.tensor(STD) + torch.tensor(MEAN))


@pytest.fixture
def session() -> work.Session:
    return work.Session(Pipeline(), torch, {"name": "m", "revision": "abc"})


def with_trellis(monkeypatch: pytest.MonkeyPatch, from_pretrained: Any, download: Any) -> None:
    """Install TRELLIS and the hub's library, of which these functions are asked."""
    loader = SimpleNamespace(from_pretrained=from_pretrained)
    fakes = {
        "trellis": ModuleType("trellis"),
        "trellis.pipelines": SimpleNamespace(TrellisImageTo3DPipeline=loader),
        "huggingface_hub": SimpleNamespace(snapshot_download=download),
    }
    for name, module in fakes.items():
        monkeypatch.setitem(sys.modules, name, module)


def has_gpu(monkeypatch: pytest.MonkeyPatch, has: bool) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)


@pytest.fixture
def images(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / f"{name}.png" for name in ("cup", "bear")]
    for number, path in enumerate(paths):
        Image.new("RGBA", (12, 10), (50 * number, 10, 10, 255)).save(path)
    return paths


def run(session: work.Session, images: list[Path], out: Path, *seeds: int) -> list[Any]:
    return list(work.extract(session, work.list_extractions(images, out, list(seeds), False)))


def test_latents_and_their_record_are_what_the_pipeline_returns(session, images, tmp_path):
    [result] = run(session, images[:1], tmp_path / "slat", 7)
    with np.load(tmp_path / "slat" / "cup.npz") as saved:
        coords, feats = saved["coords"], saved["feats"]
    assert (coords.dtype, feats.dtype) == (np.int32, np.float32)
    # What a person who calls the pipeline by hand after seeding it would get.
    pipeline = Pipeline()
    with torch.no_grad():
        cond = pipeline.get_cond([pipeline.preprocess_image(Image.open(images[0]))])
        torch.manual_seed(7)
        slat = pipeline.sample_slat(cond, pipeline.sample_sparse_structure(cond))
    np.testing.assert_array_equal(coords, slat.coords.numpy())
    np.testing.assert_array_equal(feats, slat.feats.numpy())
    assert result.voxels == len(coords) and session.pipeline.seen == ["cropped", (518, 518)]
    # And how to do it again.
    record = json.loads((tmp_path / "slat" / "cup.json").read_text("utf-8"))
    assert record["seed"] == 7 and record["model"] == {"name": "m", "revision": "abc"}
    assert record["slat_normalization"] == {"mean": MEAN, "std": STD}
    assert record["sparse_structure_sampler_params"]["cfg_strength"] == 7.5
    for key, file in (("image", images[0]), ("slat", tmp_path / "slat" / "cup.npz")):
        assert record[key]["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()


def test_a_seed_gives_its_bytes_and_is_drawn_once(session, images, tmp_path, monkeypatch):
    for folder in ("a", "b"):
        run(session, images, tmp_path / folder, 3)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    calls = len(session.pipeline.seen)
    again = run(session, images, tmp_path / "a", 3)
    assert all(result.kept for result in again) and len(session.pipeline.seen) == calls
    renewed = replace(session, model=session.model | {"torch": "9.9"})
    assert all(result.kept for result in run(renewed, images, tmp_path / "a", 3))
    monkeypatch.setattr(work.metadata, "version", lambda name: "9.9")
    assert all(result.kept for result in run(session, images, tmp_path / "a", 3))
    another = replace(session, model=session.model | {"revision": "def"})
    other = run(session, images, tmp_path / "a", 4) + run(another, images, tmp_path / "a", 3)
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


def test_a_run_that_stopped_before_its_latents_goes_on(session, images, tmp_path, monkeypatch):
    put, staged = [], work.staged

    @contextmanager
    def noted(path: Path) -> Iterator[Path]:
        with staged(path) as made:
            yield made
        put.append(path.name)

    monkeypatch.setattr(work, "staged", noted)
    run(session, images[:1], tmp_path / "slat", 3)
    assert put == ["cup.json", "cup.npz"]
    (tmp_path / "slat" / "cup.npz").unlink()  # The record is written first.
    [result] = run(session, images[:1], tmp_path / "slat", 3)
    assert not result.kept and (tmp_path / "slat" / "cup.npz").is_file()


def with_text_chunk(path: Path, size: int) -> None:
    """Write a PNG whose text is longer than Pillow takes, for which it raises ValueError."""
    about = PngImagePlugin.PngInfo()
    about.add_text("note", "a" * size, zip=True)
    Image.new("RGB", (2, 2)).save(path, pnginfo=about)


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
        with_text_chunk(images[0], 2**21)
    bad, good = run(work.Session(kind(), torch, {}), images, tmp_path / "slat", 0)
    assert isinstance(bad, InputError) and f"cup.png: {said}" in str(bad) and good.voxels > 0
    assert [path.name for path in (tmp_path / "slat").glob("*.npz")] == ["bear.npz"]
    printed = capsys.readouterr()
    assert printed.out == "" and ("[ATTENTION]" in printed.err) == (kind is Strict)
    empty = work.Session(Pipeline(voxels=0), torch, {})
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
    has_gpu(monkeypatch, gpu)
    commit, pipeline, asked = "0123abcd", Pipeline(), []

    def snapshot_download(name: str, revision: str | None) -> str:
        asked.append((name, revision))
        return str(tmp_path / commit)

    def from_pretrained(path: str) -> Pipeline:
        print("[SPARSE] Backend: spconv, Attention: flash_attn")
        asked.append(path)
        return pipeline

    with_trellis(monkeypatch, from_pretrained, snapshot_download)
    words = ("--out", tmp_path / "slat", "--json", "--revision", "v1", "--no-preprocess")
    result = commands.run("extract-slat", *images, *words)
    document = json.loads(result.stdout)
    assert document["model"]["revision"] == commit and document["extracted"] == 2
    assert asked == [("microsoft/TRELLIS-image-large", "v1"), str(tmp_path / commit)]
    # What TRELLIS prints never comes between the lines of the document.
    device = "cuda" if gpu else "cpu"
    assert "[SPARSE]" in result.stderr and f"TRELLIS runs on {device}" in result.stderr
    assert pipeline.device == torch.device(device) and "cropped" not in pipeline.seen


@pytest.mark.parametrize("error", [OSError("401 gated"), KeyError("x"), ValueError("a/b/c")])
def test_a_model_that_cannot_be_loaded_is_told(error, images, tmp_path, monkeypatch):
    with_trellis(monkeypatch, Mock(side_effect=error), lambda name, revision: str(tmp_path))
    words = ("--model", "no/such", "--out", tmp_path / "o")
    told = commands.refused("extract-slat", images[0], *words)
    assert len(told.splitlines()) == 1
    assert f"the model no/such cannot be loaded ({type(error).__name__}: {error})" in told


SOURCE = Path(trellis_latents.__file__)


def test_it_is_python_3_10_and_imports_nothing_of_ours():
    tree = ast.parse(SOURCE.read_text("utf-8"), feature_version=(3, 10))
    nodes = list(ast.walk(tree))
    plain = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    named = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    modules = {name.partition(".")[0] for name in [*plain, *named]}
    brought = {"numpy", "PIL", "torch", "trellis", "trellis2", "inference"}
    assert modules <= brought | set(sys.stdlib_module_names), modules
    # Names that Python 3.11 added to modules used here.
    assert "tomllib" not in modules and "StrEnum" not in SOURCE.read_text("utf-8")


def test_it_runs_where_slatprep_lies_and_with_what_lies_where_it_is_run(tmp_path):
    # Beside it is slatprep's `inspect`, and a checkout of TRELLIS is not installed.
    (tmp_path / "trellis").mkdir()
    (tmp_path / "trellis" / "__init__.py").write_text("raise RuntimeError('TRELLIS of here')")
    (tmp_path / "torch.py").touch()
    Image.new("RGB", (2, 2)).save(tmp_path / "cup.png")
    words = [sys.executable, str(SOURCE), "cup.png", "--out", "slat"]
    ran = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert "RuntimeError: TRELLIS of here" in ran.stderr


def test_it_writes_what_extract_slat_writes_and_build_store_reads(images, tmp_path, monkeypatch):
    has_gpu(monkeypatch, True)

    class Printing(Pipeline):
        def preprocess_image(self, input: Any) -> Any:
            print("[SPARSE] Backend: spconv")
            if np.array(input)[0, 0, 0] == 0:
                raise ValueError("zero-size array to reduction operation minimum")
            return super().preprocess_image(input)

    pipeline = Printing()
    with_trellis(monkeypatch, lambda name: pipeline, None)
    words = [*map(str, images), "--out", str(tmp_path / "slat"), "--seed", "7"]
    assert trellis_latents.main(words) == 1  # The cup has no foreground; the bear is done.
    assert sorted(path.name for path in (tmp_path / "slat").iterdir()) == ["bear.json", "bear.npz"]
    assert pipeline.device == torch.device("cuda")
    run(work.Session(Pipeline(), torch, {}), images[1:], tmp_path / "b", 7)
    with np.load(tmp_path / "slat" / "bear.npz") as one, np.load(tmp_path / "b/bear.npz") as two:
        for name in ("coords", "feats"):
            np.testing.assert_array_equal(one[name], two[name])
            assert one[name].dtype == two[name].dtype
    assert trellis_latents.main(words) == 1  # The bear is kept.
    calls = len(pipeline.seen)
    assert trellis_latents.main([*words[1:-1], "8"]) == 1  # It is of another seed.
    assert len(pipeline.seen) == calls
    record = json.loads((tmp_path / "slat" / "bear.json").read_text())
    assert record["seed"] == 7 and record["model"]["name"] == "microsoft/TRELLIS-image-large"
    grid = tmp_path / "pixieverse" / "bear" / "sample_0" / "material_grid.npy"
    grid.parent.mkdir(parents=True)
    np.save(grid, np.zeros((64, 64, 64, 4), np.float32))
    source = PixieverseSource(tmp_path / "pixieverse")
    (pair,) = discover(BuildParameters(source, SlatSource(tmp_path / "slat")))
    assert len(read_latents(pair).coords) == record["slat"]["voxels"]


@pytest.mark.parametrize(("kind", "side"), [("512", 32), ("1024", 64)])
def test_trellis2_is_called_in_the_order_of_its_run(kind, side, images, monkeypatch):
    """As `Trellis2ImageTo3DPipeline.run`: preprocess, seed, conditions, voxels, shape latents."""
    coords, image = torch.zeros((5, 4), dtype=torch.int64), Image.open(images[0])
    flows = {f"shape_slat_flow_model_{name}": f"f{name}" for name in ("512", "1024")}
    run = Mock(device="cpu", models=flows)
    run.preprocess_image.side_effect = lambda image: image
    run.get_cond.side_effect = lambda image, resolution: resolution
    run.sample_sparse_structure.return_value = coords
    run.sample_shape_slat.return_value = SimpleNamespace(coords=coords, feats=torch.ones(5, 32))
    monkeypatch.setattr(torch, "manual_seed", run.seed)
    found, feats, seconds = trellis_latents.sample_trellis2(run, torch, image, 3, True, kind)
    assert run.mock_calls == [
        call.preprocess_image(image),
        call.seed(3),
        *(call.get_cond([image], side) for side in ((512, 1024) if kind == "1024" else (512,))),
        call.sample_sparse_structure(512, side, 1),
        call.sample_shape_slat(int(kind), f"f{kind}", coords),
    ]
    assert found.dtype == np.int32 and feats.shape == (5, 32) and feats.dtype == np.float32
    assert set(seconds) == set(trellis_latents.STAGES)


def test_latents_of_sam3d_are_what_it_hands_to_its_decoder(images):
    feats = torch.full((4, 8), 2.0, dtype=torch.bfloat16)  # which numpy does not have
    slat = SimpleNamespace(coords=torch.ones(4, 4), feats=feats)
    decoded: list[Any] = []

    class Sam3D:
        def decode_slat(self, slat: Any, formats: list[str]) -> dict[str, Any]:
            decoded.append(formats)
            return {"gaussian": ["g"]}

    class Inference:
        _pipeline = Sam3D()

        def __call__(self, image: np.ndarray, mask: np.ndarray, seed: int | None = None) -> Any:
            assert image.shape == (10, 12, 3) and mask.shape == (10, 12) and mask.dtype == bool
            return self._pipeline.decode_slat(slat, ["gaussian"])

    inference = Inference()
    coords, feats, _ = trellis_latents.sample_sam3d(inference, torch, Image.open(images[0]), 1)
    assert coords.shape == (4, 4) and (feats == 2.0).all() and decoded == [["gaussian"]]
    assert inference._pipeline.decode_slat.__name__ == "decode_slat"  # as it was

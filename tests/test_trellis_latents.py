"""The file that runs alone, in TRELLIS's own Python 3.10: syntax, imports, calls, and output."""

import ast
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import Mock, call

import numpy as np
import pytest
from PIL import Image
from test_extract import Pipeline, Tensor, Torch

from slatprep import extract, trellis_latents
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import discover, read_latents

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


@pytest.fixture
def images(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / f"{name}.png" for name in ("cup", "bear")]
    for number, path in enumerate(paths):
        Image.new("RGBA", (12, 10), (50 * number, 1, 1, 255)).save(path)
    return paths


@pytest.fixture
def torch(monkeypatch: pytest.MonkeyPatch) -> Torch:
    torch = Torch()
    monkeypatch.setitem(sys.modules, "torch", torch)
    return torch


def test_it_writes_what_extract_slat_writes_and_build_store_reads(
    images, torch, tmp_path, monkeypatch
):
    class Printing(Pipeline):
        def preprocess_image(self, input: Any) -> Any:
            print("[SPARSE] Backend: spconv")
            if np.array(input)[0, 0, 0] == 0:
                raise ValueError("zero-size array to reduction operation minimum")
            return super().preprocess_image(input)

    pipeline = Printing(torch)
    module = SimpleNamespace(
        TrellisImageTo3DPipeline=SimpleNamespace(from_pretrained=lambda name: pipeline)
    )
    monkeypatch.setitem(sys.modules, "trellis", ModuleType("trellis"))
    monkeypatch.setitem(sys.modules, "trellis.pipelines", module)
    words = [*map(str, images), "--out", str(tmp_path / "slat"), "--seed", "7"]
    assert trellis_latents.main(words) == 1  # The cup has no foreground; the bear is done.
    made = sorted(path.name for path in (tmp_path / "slat").iterdir())
    assert made == ["bear.json", "bear.npz"]
    assert pipeline.device == "device cuda"
    session = extract.Session(Pipeline(torch), torch, {})
    list(extract.extract(session, extract.list_extractions(images[1:], tmp_path / "b", [7], False)))
    with np.load(tmp_path / "slat" / "bear.npz") as one, np.load(tmp_path / "b/bear.npz") as two:
        for name in ("coords", "feats"):
            np.testing.assert_array_equal(one[name], two[name])
            assert one[name].dtype == two[name].dtype
    record = json.loads((tmp_path / "slat" / "bear.json").read_text())
    assert record["seed"] == 7 and record["model"]["name"] == "microsoft/TRELLIS-image-large"
    grid = tmp_path / "pixieverse" / "bear" / "sample_0" / "material_grid.npy"
    grid.parent.mkdir(parents=True)
    np.save(grid, np.zeros((64, 64, 64, 4), np.float32))
    source = PixieverseSource(tmp_path / "pixieverse")
    (pair,) = discover(BuildParameters(source, SlatSource(tmp_path / "slat")))
    assert len(read_latents(pair).coords) == record["slat"]["voxels"]


@pytest.mark.parametrize(("kind", "side"), [("512", 32), ("1024", 64)])
def test_trellis2_is_called_in_the_order_of_its_run(kind, side, images, torch):
    """As `Trellis2ImageTo3DPipeline.run`: preprocess, seed, conditions, voxels, shape latents."""
    coords, image = Tensor(np.zeros((5, 4), np.int64)), Image.open(images[0])
    flows = {f"shape_slat_flow_model_{name}": f"f{name}" for name in ("512", "1024")}
    run = Mock(device="cpu", models=flows)
    run.preprocess_image.side_effect = lambda image: image
    run.get_cond.side_effect = lambda image, resolution: resolution
    run.sample_sparse_structure.return_value = coords
    run.sample_shape_slat.return_value = SimpleNamespace(
        coords=coords, feats=Tensor(np.ones((5, 32)))
    )
    torch.manual_seed = run.seed
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


def test_latents_of_sam3d_are_what_it_hands_to_its_decoder(images, torch):
    slat = SimpleNamespace(coords=Tensor(np.ones((4, 4))), feats=Tensor(np.full((4, 8), 2.0)))
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

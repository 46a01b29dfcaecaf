"""The comparison of engines: same cases, and no more engines than there are packages for."""

import importlib.util
from importlib.machinery import ModuleSpec
from pathlib import Path

import cpd
import engines as bench
import numpy as np
import pytest
from click.testing import CliRunner
from support.deformed import MOVES, occupancy
from support.shapes import field_of, surface_latents

from slatprep.demo import make_demo
from slatprep.errors import SlatprepError
from slatprep.geometry.frames import VOXEL_SIZE, voxel_centres


def without(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    find = importlib.util.find_spec

    def found(name: str, package: str | None = None) -> ModuleSpec | None:
        return None if name in packages else find(name, package)

    monkeypatch.setattr(bench, "find_spec", found)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("demo")
    make_demo(root, assets=1, seed=2, levels=(0,))
    return root


def test_engines_that_are_not_installed_are_left_out_and_named(demo, monkeypatch):
    without(monkeypatch, "pycpd", "small_gicp", "open3d")
    assert bench.installed_engines() == ("field",)
    # It compiles all kernels anew, twice: `make bench` does that.
    monkeypatch.setattr(bench, "_start_up", lambda engine: (1.0, 9.0))
    arguments = ["--data", str(demo), "--repeats", "1"]
    result = CliRunner().invoke(bench.main, arguments)
    assert result.exit_code == 0, result.output
    assert "field" in result.stdout
    for engine in bench.ENGINES[1:]:
        assert f"{engine}: not installed, left out (pip install 'slatprep[" in result.stderr


def test_an_engine_that_is_asked_for_and_not_installed_says_what_to_install(demo, monkeypatch):
    without(monkeypatch, "pycpd")
    with pytest.raises(SlatprepError, match=r"pycpd.*pip install 'slatprep\[bench\]'"):
        bench.bench_align(demo, engines=["cpd-affine"])


def test_drift_finds_a_stretched_shape_and_bends_one(monkeypatch):
    pytest.importorskip("pycpd")
    for name, fewer in (("START", (100, 15)), ("FINAL", (400, 30))):
        monkeypatch.setattr(cpd, f"{name}_POINTS", fewer[0])
        monkeypatch.setattr(cpd, f"{name}_STEPS", fewer[1])
    off = {}
    field = field_of(occupancy(lambda points: points))
    for name, deformable in (("long", False), ("bent", False), ("bent", True)):
        latents = surface_latents(occupancy(MOVES[name]))
        places = cpd.cpd_places(field, latents, deformable)
        true_places = MOVES[name](voxel_centres(latents.coords))
        apart = np.linalg.norm(places - true_places, axis=1) / VOXEL_SIZE
        off[name, deformable] = float(np.median(apart))
    assert off["long", False] < 1.0
    assert off["bent", True] < off["bent", False]

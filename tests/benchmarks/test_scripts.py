"""What `make bench` lists can be run, and compares the same cases read in the same way."""

import ast
import importlib.util
import json
import subprocess
import symtable
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path

import bench
import cpd
import engines
import numpy as np
import pytest
import reading as read
from click.testing import CliRunner
from support.deformed import MOVES, occupancy
from support.shapes import field_of, surface_latents

from slatprep.demo import make_demo
from slatprep.errors import SlatprepError
from slatprep.geometry.frames import VOXEL_SIZE, voxel_centres
from slatprep.store import open_store

ROOT = Path(__file__).parents[2]


def test_tables_of_the_page_are_two_cells_wide_and_none_is_empty():
    one = {"wall [s]": 1.5, "files": None, "runs": [1, [2, 3]], "at": [{"cpu": 4}, {"cpu": 5}]}
    assert list(bench.shown(one))[2:] == [
        "| wall [s] | 1.5 |", "| files | - |", "| runs | 1, 2, 3 |", "| at | cpu 4; cpu 5 |",
    ]  # fmt: skip
    rows = list(bench.shown([{"step": "build", "files": 3}, {"step": "read", "CPU [s]": 0.2}]))
    assert rows == [
        "| step | figures |", "| --- | --- |", "| build | files 3 |", "| read | CPU [s] 0.2 |",
    ]  # fmt: skip
    assert "null" not in (ROOT / "docs" / "benchmarks.md").read_text("utf-8")


def test_every_measurement_names_a_script_and_a_page_that_are_there():
    for one in bench.MEASUREMENTS:
        program, script, *_ = one.command.split()
        assert program == "python" and (ROOT / script).is_file(), one.name
        assert (ROOT / "docs" / f"{one.page}.md").is_file(), one.name


def test_what_scripts_import_of_each_other_and_of_the_tests_is_there():
    """Read, not run: a script takes seconds to start, and there are two dozen."""
    folders = {"": ROOT / "benchmarks", "support": ROOT / "tests" / "support"}
    names = {
        (package, file.stem): {
            one.get_name()
            for one in symtable.symtable(file.read_text(), file.name, "exec").get_symbols()
            if one.is_assigned() or one.is_imported()
        }
        for package, folder in folders.items()
        for file in folder.glob("*.py")
    }
    seen = 0
    for script in folders[""].glob("*.py"):
        for node in ast.walk(ast.parse(script.read_text())):
            if isinstance(node, ast.ImportFrom) and not node.level:
                package, _, module = str(node.module).rpartition(".")
                for alias in node.names:
                    if (package, module) in names:
                        assert alias.name in names[package, module], f"{script.name}: {alias.name}"
                        seen += 1
                    elif module in folders:
                        assert (module, alias.name) in names, f"{script.name}: {alias.name}"
                        seen += 1
    assert seen > 20


def without(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    find = importlib.util.find_spec

    def found(name: str, package: str | None = None) -> ModuleSpec | None:
        return None if name in packages else find(name, package)

    monkeypatch.setattr(engines, "find_spec", found)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("demo")
    make_demo(root, assets=1, seed=2, levels=(0,))
    return root


def test_engines_that_are_not_installed_are_left_out_and_named(demo, monkeypatch):
    without(monkeypatch, "pycpd", "small_gicp", "open3d")
    assert engines.installed_engines() == ("field",)
    # It compiles all kernels anew, twice: `make bench` does that.
    monkeypatch.setattr(engines, "_start_up", lambda engine: (1.0, 9.0))
    result = CliRunner().invoke(engines.main, ["--data", str(demo), "--repeats", "1"])
    assert result.exit_code == 0, result.output
    assert "field" in result.stdout
    for engine in engines.ENGINES[1:]:
        assert f"{engine}: not installed, left out (pip install 'slatprep[" in result.stderr


def test_an_engine_that_is_asked_for_and_not_installed_says_what_to_install(demo, monkeypatch):
    without(monkeypatch, "pycpd")
    with pytest.raises(SlatprepError, match=r"pycpd.*pip install 'slatprep\[bench\]'"):
        engines.bench_align(demo, engines=["cpd-affine"])


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


def test_every_way_reads_every_asset_alike(mixed_build, tmp_path):
    store = open_store(mixed_build.store)
    read.write_forms(store.path, tmp_path, len(store))
    (tmp_path / "store").symlink_to(store.path)
    for way in read.WAYS[:5]:
        reader = way.open(tmp_path)
        for row, asset in enumerate(store):
            arrays = reader(row)
            assert np.array_equal(arrays["coords"], asset.coords)
            assert np.array_equal(arrays["feats"], asset.feats)
            assert np.array_equal(arrays["properties"], asset.properties, equal_nan=True)


def test_damage_is_found_healed_or_without_meaning():
    """The short version of ``benchmarks/damage.py``: no flipped bit and no gross damage harms."""
    script = str(ROOT / "benchmarks" / "damage.py")
    command = [sys.executable, script, "--flips", "150", "--stores", "30", "--seed", "4"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["harm"] == 0
    outcomes = ("found by verify", "healed by the next build", "without meaning",
                "costs the next build some hashing")  # fmt: skip
    assert sum(told.get(outcome, 0) for outcome in outcomes) == told["flips"] == 150
    assert sum(count for name, count in told.items() if ": exit code" in name) == 30

"""What `make bench` lists can be run: every script is there, with what others import of it."""

import ast
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    spec = importlib.util.spec_from_file_location("bench", ROOT / "benchmarks" / "bench.py")
    assert spec is not None and spec.loader is not None
    bench = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "bench", bench)
    spec.loader.exec_module(bench)
    return bench


def test_tables_of_the_page_are_two_cells_wide_and_none_is_empty(bench):
    one = {"wall [s]": 1.5, "files": None, "runs": [1, [2, 3]], "at": [{"cpu": 4}, {"cpu": 5}]}
    assert list(bench.shown(one))[2:] == [
        "| wall [s] | 1.5 |", "| files | - |", "| runs | 1, 2, 3 |", "| at | cpu 4; cpu 5 |",
    ]  # fmt: skip
    rows = list(bench.shown([{"step": "build", "files": 3}, {"step": "read", "CPU [s]": 0.2}]))
    assert rows == [
        "| step | figures |", "| --- | --- |", "| build | files 3 |", "| read | CPU [s] 0.2 |",
    ]  # fmt: skip
    text = (ROOT / "docs" / "benchmarks.md").read_text("utf-8")
    assert "null" not in text


def test_every_measurement_names_a_script_and_a_page_that_are_there(bench):
    for one in bench.MEASUREMENTS:
        program, script, *_ = one.command.split()
        assert program == "python" and (ROOT / script).is_file(), one.name
        assert (ROOT / "docs" / f"{one.page}.md").is_file(), one.name


def test_what_scripts_import_of_each_other_and_of_the_tests_is_there():
    """Read, not run: a script takes seconds to start, and there are two dozen."""
    folders = {"": ROOT / "benchmarks", "support": ROOT / "tests" / "support"}
    names = {
        (package, file.stem): {
            name.id if isinstance(name, ast.Name) else getattr(name, "name", "")
            for node in ast.parse(file.read_text()).body
            for name in ast.walk(node)
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

"""What `make bench` lists can be run: every script that it names is there."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_every_measurement_names_a_script_and_a_page_that_are_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    spec = importlib.util.spec_from_file_location("bench", ROOT / "benchmarks" / "bench.py")
    assert spec is not None and spec.loader is not None
    bench = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "bench", bench)
    spec.loader.exec_module(bench)
    for one in bench.MEASUREMENTS:
        program, script, *_ = one.command.split()
        assert program == "slatprep" or (ROOT / script).is_file(), one.name
        assert (ROOT / "docs" / f"{one.page}.md").is_file(), one.name

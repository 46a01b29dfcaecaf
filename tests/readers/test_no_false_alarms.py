"""No demo data looks like a mistake: of all sources, of several samples, and at every level."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, get_args

import pytest

from slatprep import demo
from slatprep.demo import make_demo
from slatprep.demo.sources import Source
from slatprep.parameters.files import load_parameters
from slatprep.readers import discover, read_field


@pytest.fixture(scope="module", autouse=True)
def made_once() -> Iterator[None]:
    """Sources differ in how the same assets are written."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(demo, "make_asset", cache(demo.make_asset))
        yield


def alarms(folder: Path, assets: int, seed: int, **options: Any) -> list[str]:
    """Return what is said of the plausibility of demo data."""
    make_demo(folder, assets, seed, **options)
    pairs = discover(load_parameters(folder / "dataset.toml"))
    assert len(pairs) == assets
    said = [text for pair in pairs for one in pair.annotations for text in read_field(one).warnings]
    return [text for text in said if "plausib" in text or "look like" in text]


@pytest.mark.parametrize("source", get_args(Source))
def test_sources_of_the_demo_raise_no_alarm(tmp_path, source):
    assert alarms(tmp_path / "demo", 3, 3, source=source) == []


def test_every_category_in_samples_that_err_raises_no_alarm(tmp_path):
    # Of seed 77, a soft and light part is called metal by mistake.
    assert alarms(tmp_path / "demo", 14, 77, levels=(0,), samples=4) == []


def test_hard_levels_raise_no_alarm(tmp_path):
    assert alarms(tmp_path / "demo", 3, 5, levels=(5, 6, 7)) == []

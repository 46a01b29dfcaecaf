"""The page about other sources: its adapter is run as a package that somebody installed."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.installed import package
from support.synthetic import make_asset

from slatprep import build_store, load_parameters, open_store
from slatprep.readers import adapters
from slatprep.readers.voxels import _parsed

PAGE = (Path(__file__).parents[2] / "docs" / "adapters.md").read_text("utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.S | re.M)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install the page's adapter: a module, and what a package's metadata say."""
    name, value = re.findall(r'^(\w+) = "(mine:\w+)"$', "\n".join(blocks("toml")), re.M)[0]
    modules, points = {"mine": blocks("python")[0]}, f"[slatprep.sources]\n{name} = {value}\n"
    with package(tmp_path / "site", "mine", modules, points, monkeypatch):
        yield


@pytest.mark.usefixtures("installed")
def test_the_adapter_of_the_page_builds_a_store(tmp_path):
    assert len(blocks("python")[0].splitlines()) <= 45
    (tmp_path / "points").mkdir()
    (tmp_path / "slat").mkdir()
    asset = make_asset(1)
    voxels = np.argwhere(asset.grid[..., 3] != 7)
    points = (voxels + 0.5) / 64 - 0.5
    conductivity = 10.0 ** (voxels[:, 0] / 16)
    rows = np.column_stack([points, np.full(len(voxels), 800.0), conductivity])
    header = "x,y,z,density,conductivity"
    np.savetxt(tmp_path / "points" / "a.csv", rows, "%.9g", ",", header=header, comments="")
    (tmp_path / "points" / "b.csv").write_text(f"{header}\n1,2\n")
    for name in "ab":
        np.savez(tmp_path / "slat" / f"{name}.npz", coords=asset.coords, feats=asset.feats)
    config = tmp_path / "dataset.toml"
    config.write_text(
        '[pixieverse]\nroot = "points"\nadapter = "points"\n[slat]\nroot = "slat"\n'
        '[sample]\nmethod = "nearest"\n'
    )
    summary = build_store(load_parameters(config), tmp_path / "s.zarr")
    assert summary.statuses == {"ok": 1, "failed": 1, "skipped": 0}
    assert "x,y,z,density,conductivity" in summary.problems[0][1]
    (stored,) = open_store(tmp_path / "s.zarr")
    assert stored.store.attributes["property_units"] == ["kg/m^3", "W/(m K)"]
    places = np.asarray(stored.place, np.float64) * 64 + 31.5
    _, used = cKDTree(voxels).query(places)
    np.testing.assert_allclose(stored.properties_si[:, 1], conductivity[used], rtol=1e-5)


def test_the_dataset_definition_and_the_description_of_the_page_are_valid(tmp_path):
    for folder in ("gvm", "latents"):
        (tmp_path / folder).mkdir()
    (tmp_path / "dataset.toml").write_text(blocks("toml")[0])
    assert load_parameters(tmp_path / "dataset.toml").pixieverse.adapter == "vomp"
    (text,) = blocks("json")
    said = _parsed(text.encode(), "page")
    assert [one.name for one in said.table] == [p["name"] for p in json.loads(text)["properties"]]


def test_the_page_names_every_source_adapter():
    for name in adapters.SOURCES:
        assert f"| `{name}` |" in PAGE

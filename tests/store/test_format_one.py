"""A store of format 1 is read as before; what it lacked follows from what it has."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import zarr
from click.testing import CliRunner
from support.format_one import write_format_one
from support.synthetic import Dataset

from slatprep.cli.commands import slatprep
from slatprep.export import export_store
from slatprep.inspect.verify import verify_store
from slatprep.pipeline.dataset import BuildSummary, build_store, plan_build
from slatprep.store import open_store


@pytest.fixture
def old(mixed_build: BuildSummary, tmp_path: Path) -> Path:
    assert mixed_build.store is not None
    write_format_one(mixed_build.store, tmp_path / "old.zarr")
    return tmp_path / "old.zarr"


def test_it_reads_as_the_same_store(old: Path, mixed_build: BuildSummary) -> None:
    assert "place" not in zarr.open_group(old, mode="r")["voxel"]
    store, new = open_store(old), open_store(mixed_build.store)
    assert (store.format_version, new.format_version) == (1, 2)
    for before, after in zip(store, new, strict=True):
        for name in ("coords", "feats", "properties", "material", "valid", "distance"):
            assert getattr(before, name).tobytes() == getattr(after, name).tobytes()
        # Format 1 looked up at the inverse of the transform.
        points = np.ones((len(before.coords), 4))
        points[:, :3] = (before.coords + 0.5) / 64 - 0.5
        expected = np.linalg.solve(before.transform, points.T).T[:, :3]
        assert before.place.dtype == np.float32
        assert np.abs(before.place - expected).max() < 1e-6
        assert np.isnan(before.confidence).all() and np.isnan(before.columns["confidence"])
        assert store.read(before.index, ["place"])["place"].tobytes() == before.place.tobytes()


def test_it_is_sound(old: Path) -> None:
    assert verify_store(old).findings == ()


def test_its_damage_is_found(old: Path) -> None:
    zarr.open_group(old, mode="r+", use_consolidated=False)["voxel/distance"][4] = 2.5
    findings = verify_store(old).findings
    assert {f.file.split("/c/")[0] for f in findings} == {"voxel/distance"}


def test_commands_take_it(old: Path, tmp_path: Path) -> None:
    for command in (
        ["info", old],
        ["check-alignment", "--store", old, "--worst", "2", "--picture", tmp_path / "pictures"],
        ["report", old, "--out", tmp_path / "report.html"],
        ["verify", old],
    ):
        result = CliRunner().invoke(slatprep, [str(word) for word in command])
        assert result.exit_code == 0, result.output
    export_store(old, tmp_path / "wds", "webdataset")
    export_store(old, tmp_path / "all.h5", "hdf5")


def test_a_build_makes_it_anew_and_says_why(
    old: Path, mixed: Dataset, mixed_build: BuildSummary
) -> None:
    plan = {asset.asset_id: asset for asset in plan_build(mixed.parameters(), old).assets}
    assert plan["cup"].action == "align"
    assert plan["cup"].reason == "the store has format 1, and 2 is written"
    build_store(mixed.parameters(), old)
    assert json.loads((old / "zarr.json").read_text())["attributes"]["format_version"] == 2
    assert verify_store(old).findings == ()
    assert mixed_build.store is not None
    assert (old / "zarr.json").read_bytes() == (mixed_build.store / "zarr.json").read_bytes()

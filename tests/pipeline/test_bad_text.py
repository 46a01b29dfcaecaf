"""Names and texts that are not UTF-8 cost their own asset at most, and no traceback."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from support.trees import records_of

from slatprep.cli.commands import slatprep
from slatprep.errors import ConfigError, StoreError
from slatprep.inspect.verify import verify_store
from slatprep.parameters import PairingParameters
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import build_store
from slatprep.store import open_store
from slatprep.store.records import StoredRecords

BAD = os.fsdecode(b"b\xff")


def slat_name(root: Path) -> None:
    (root / "slat" / f"{BAD}.npz").write_bytes((root / "slat/a.npz").read_bytes())


def grid_folder(root: Path) -> None:
    (root / "pixieverse" / "c").rename(root / "pixieverse" / BAD)


def sample_folder(root: Path) -> None:
    (root / "pixieverse/c/sample_0").rename(root / "pixieverse/c" / f"sample_{BAD}")


BAD_NAMES = {"SLAT": slat_name, "grid": grid_folder, "sample": sample_folder}


@pytest.mark.parametrize("case", BAD_NAMES)
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_name_that_is_not_utf_8_costs_its_asset_alone(make_dataset, tmp_path, case, jobs):
    dataset = make_dataset("a", "c")
    BAD_NAMES[case](dataset.root)
    summary = build_store(dataset.parameters(), tmp_path / "s.zarr", jobs=jobs)
    assert "a" in open_store(summary.store).ids
    assert any("b\\udcff" in reason for _, reason in summary.problems)
    json.dumps(summary.problems).encode()
    assert len(records_of(summary.records)) == sum(summary.statuses.values())
    again = build_store(dataset.parameters(), tmp_path / "s.zarr")
    assert again.build_id == summary.build_id


def test_a_sample_whose_name_is_not_utf_8_is_left_out_of_those_that_are_merged(
    make_dataset, tmp_path
):
    dataset = make_dataset("a")
    samples = dataset.root / "pixieverse/a"
    shutil.copytree(samples / "sample_0", samples / f"sample_{BAD}")
    parameters = dataset.parameters("pixie")
    parameters = replace(parameters, pixieverse=replace(parameters.pixieverse, samples="merge"))
    summary = build_store(parameters, tmp_path / "s.zarr")
    assert summary.statuses == {"ok": 1, "failed": 0, "skipped": 0}
    used, left_out = StoredRecords(open_store(summary.store)).of("a").merged
    assert (used.sample, used.left_out, left_out.sample) == ("0", "", "b\\udcff")
    assert "is no UTF-8" in left_out.left_out
    assert verify_store(summary.store).ok


def test_a_category_that_is_no_text_is_written_out(make_dataset, tmp_path):
    dataset = make_dataset("a")
    categories = tmp_path / "categories.json"
    categories.write_text('{"a": {"obj_class": "x\\ud800y"}}')
    parameters = replace(dataset.parameters(), pairing=PairingParameters(categories=categories))
    summary = build_store(parameters, tmp_path / "s.zarr")
    assert open_store(summary.store).column("category").tolist() == ["x\\ud800y"]


BOUNDS = {
    "half a pair": np.array(["\ud800"]),
    "beyond Unicode": np.array([0x7FFFFFFF], np.uint32).view("<U1"),
}


@pytest.mark.parametrize("case", BOUNDS)
def test_bounds_that_are_no_text_are_left_out(make_dataset, tmp_path, case):
    dataset = make_dataset("a")
    np.savez(
        dataset.root / "pixieverse/a/clip_features.npz",
        model=BOUNDS[case],
        min_bounds=np.full(3, -0.5, np.longdouble),
        max_bounds=np.full(3, 0.5, ">f8"),
    )
    summary = build_store(dataset.parameters(), tmp_path / "s.zarr")
    record = records_of(summary.records)["a"]
    assert record["bounds"] == {"min_bounds": [-0.5] * 3, "max_bounds": [0.5] * 3}
    assert "[model] is no text; left out" in record["warnings"][0]


def test_a_store_cannot_have_a_name_that_is_not_utf_8(make_dataset, tmp_path):
    dataset = make_dataset("a")
    with pytest.raises(StoreError, match=r"b\\udcff: .*UTF-8"):
        build_store(dataset.parameters(), tmp_path / BAD)
    assert not (tmp_path / BAD).exists()
    command = ["build-store", "--pixieverse", str(dataset.root / "pixieverse")]
    command += ["--slat", str(dataset.root / "slat"), "--out", str(tmp_path / BAD)]
    result = CliRunner().invoke(slatprep, command)
    assert result.exit_code == 2
    assert "UTF-8" in result.output
    assert not [path for path in tmp_path.iterdir() if path != dataset.root]


def test_a_root_that_is_not_utf_8_is_named(tmp_path):
    folder = tmp_path / BAD
    (folder / "slat").mkdir(parents=True)
    config = folder / "d.toml"
    config.write_text('[pixieverse]\nroot = "slat"\n[slat]\nroot = "slat"\n')
    with pytest.raises(ConfigError, match=r"pixieverse\.root: .*b\\udcff/slat.*UTF-8"):
        load_parameters(config)

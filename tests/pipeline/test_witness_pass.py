"""A build's pass that compares labels with latents, which carry material or nothing."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from support.trees import records_beside, tree

from slatprep.demo import make_demo
from slatprep.inspect.check import check_alignment
from slatprep.inspect.verify import verify_store
from slatprep.parameters import BuildParameters, ConsensusParameters, WitnessParameters
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.store import open_store

HEARD = WitnessParameters(settle=True)


@pytest.fixture(scope="module")
def telling(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BuildParameters]:
    """Make assets whose latents carry material; another object's labels are put on one."""
    root = tmp_path_factory.mktemp("telling")
    make_demo(root, assets=35, seed=3, levels=(0,), latents="material")
    # The classes of one object, metal and stationary alone, become others: its labels are wrong.
    first = sorted((root / "pixieverse").iterdir())[0]
    file = first / "sample_0" / "material_grid.npy"
    grid = np.load(file)
    known = (grid[..., 3] >= 0) & (grid[..., 3] < 7)
    grid[known, 3] = (grid[known, 3] + 2) % 7
    np.save(file, grid)
    return root, load_parameters(root / "dataset.toml", {})


@pytest.fixture(scope="module")
def stores(telling: tuple[Path, BuildParameters]) -> tuple[Path, Path]:
    root, parameters = telling
    alone, heard = root / "alone.zarr", root / "heard.zarr"
    told: list[str] = []
    build_store(parameters, alone, note=told.append)
    assert not any("witness" in line for line in told)
    copied(alone, heard)
    build_store(replace(parameters, witness=HEARD), heard, note=told.append)
    (root / "told").write_text(told[-1])
    return alone, heard


def copied(store: Path, to: Path) -> Path:
    """Copy a store and its records: what is built on it need not be aligned again."""
    shutil.copytree(store.with_suffix(".manifests"), to.with_suffix(".manifests"))
    return Path(shutil.copytree(store, to))


def right_labels(root: Path, store: Path) -> dict[str, float]:
    shares = {}
    for asset in open_store(store):
        truth = np.load(root / "truth" / f"{asset.asset_id}.npz")
        valid = asset.valid
        shares[asset.asset_id] = float((asset.material == truth["material"])[valid].mean())
    return shares


def mislabelled(root: Path) -> str:
    return sorted(path.name for path in (root / "pixieverse").iterdir())[0]


def test_ties_that_change_labels_are_settled_right_and_recorded(telling, stores):
    root = telling[0]
    alone, heard = map(records_beside, stores)
    before, after = (right_labels(root, store) for store in stores)
    settled = [key for key, record in heard.items() if record["alignment"]["settled_by"]]
    differing = [k for k, r in alone.items() if r["judgement"]["ambiguity"]["material_share"] > 0.3]
    assert differing
    assert set(differing) <= set(settled)
    for asset_id in settled:
        entry = heard[asset_id]["alignment"]
        assert entry["settled_by"]["probability"] >= 0.95
        assert after[asset_id] > 0.95
        assert heard[asset_id]["first_pass"]["alignment"] == alone[asset_id]["alignment"]
        judgement = heard[asset_id]["judgement"]
        assert judgement["confidence"] >= 0.9
        if asset_id in differing:
            assert judgement["right_placement"] <= entry["settled_by"]["probability"]
            assert judgement["verdict"] == "good"
            assert alone[asset_id]["judgement"]["verdict"] == "doubtful"
    assert any(before[asset_id] < 0.9 for asset_id in settled)
    moved = sum(heard[k]["alignment"]["transform"] != alone[k]["alignment"]["transform"]
                for k in settled)  # fmt: skip
    told = (root / "told").read_text()
    assert f"of {len(settled)} ties that latents decide {moved} were given another" in told
    assert told.endswith("contradict the labels of 1 assets")


def test_assets_without_a_tie_keep_every_byte_but_those_that_are_contradicted(telling, stores):
    alone, heard = map(records_beside, stores)
    wrong = mislabelled(telling[0])
    assert [key for key, record in heard.items() if record["judgement"]["contradicted"]] == [wrong]
    assert alone[wrong]["judgement"]["verdict"] == "good"
    assert heard[wrong]["judgement"]["verdict"] != "good"
    assert "latents contradict" in heard[wrong]["judgement"]["reasons"][0]
    assert heard[wrong]["alignment"] == alone[wrong]["alignment"]
    groups = [zarr.open_group(store, mode="r") for store in stores]
    for row, asset_id in enumerate(alone):
        if heard[asset_id]["first_pass"] is None:
            assert heard[asset_id] == alone[asset_id]
            first, last = groups[0]["asset/offset"][row : row + 2]
            for name in ("properties", "material", "valid", "confidence", "place"):
                ours, theirs = (group[f"voxel/{name}"][first:last] for group in groups)
                np.testing.assert_array_equal(ours, theirs)


def test_the_summary_names_assets_whose_labels_are_contradicted(telling, stores):
    root, parameters = telling
    again = build_store(replace(parameters, witness=HEARD), stores[1])  # nothing to do
    assert again.contradicted == (mislabelled(root),)
    assert build_store(parameters, stores[0]).contradicted == ()


def test_a_store_that_heard_latents_is_sound(stores):
    assert verify_store(stores[1]).findings == ()
    store = open_store(stores[1])
    assert all(check_alignment(store, asset_id).consistent for asset_id in store.ids)


def test_it_is_undone_by_building_without_it_and_the_same_for_any_jobs(telling, stores, tmp_path):
    _, parameters = telling
    store = tmp_path / "store.zarr"
    build_store(replace(parameters, witness=HEARD), store, jobs=2)
    assert tree(store) == tree(stores[1])
    plan = plan_build(parameters, store)
    assert {asset.action for asset in plan.assets} == {"reuse"}
    build_store(parameters, store)
    assert tree(store) == tree(stores[0])


def test_with_a_consensus_before_it_the_record_goes_back_to_the_first_pass(
    telling, stores, tmp_path
):
    both = replace(telling[1], witness=HEARD, consensus=ConsensusParameters(settle=True))
    store = copied(stores[0], tmp_path / "store.zarr")
    build_store(both, store)
    alone = records_beside(stores[0])
    for asset_id, record in records_beside(store).items():
        if record["first_pass"]:
            assert record["first_pass"]["alignment"] == alone[asset_id]["alignment"]
            assert record["first_pass"]["key"] == alone[asset_id]["key"]


def test_latents_that_carry_nothing_change_nothing(tmp_path):
    make_demo(tmp_path, assets=28, seed=3, levels=(0,), latents="placeholder")
    parameters = load_parameters(tmp_path / "dataset.toml", {})
    alone, heard = tmp_path / "alone.zarr", tmp_path / "heard.zarr"
    build_store(parameters, alone)
    told: list[str] = []
    copied(alone, heard)
    summary = build_store(replace(parameters, witness=HEARD), heard, note=told.append)
    assert summary.contradicted == () and told[-1].endswith("latents are not used")
    assert all(record["first_pass"] is None for record in records_beside(heard).values())
    before, after = (zarr.open_group(store, mode="r") for store in (alone, heard))
    for name, array in before["voxel"].arrays():
        np.testing.assert_array_equal(array[:], after[f"voxel/{name}"][:])

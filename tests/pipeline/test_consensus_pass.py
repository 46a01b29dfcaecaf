"""A build's second pass, on demo data with a planted common rotation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from support.trees import records_beside, tree

from slatprep.demo import make_demo
from slatprep.inspect.check import check_alignment
from slatprep.inspect.score import score_against_truth
from slatprep.judge import THRESHOLDS
from slatprep.parameters import BuildParameters, ConsensusParameters
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.store import open_store


@pytest.fixture(scope="module")
def habitual(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BuildParameters]:
    """Make fourteen assets, one a category, that all have one quarter turn in common."""
    root = tmp_path_factory.mktemp("habitual")
    make_demo(root, assets=14, seed=5, levels=(0,), habitual_share=1.0)
    return root, load_parameters(root / "dataset.toml", {})


@pytest.fixture(scope="module")
def stores(habitual: tuple[Path, BuildParameters]) -> tuple[Path, Path]:
    root, parameters = habitual
    alone, together = root / "alone.zarr", root / "together.zarr"
    build_store(parameters, alone)
    build_store(replace(parameters, consensus=ConsensusParameters(settle=True)), together)
    return alone, together


def test_more_symmetric_assets_are_placed_right_and_no_other_changes(habitual, stores):
    truth = habitual[0] / "truth"
    before, after = (score_against_truth(store, truth).assets for store in stores)
    symmetric = [k for k, score in enumerate(before) if score.symmetric]
    right = [sum(scores[k].displacement < 1.5 for k in symmetric) for scores in (before, after)]
    assert len(symmetric) >= 2
    assert right[1] == len(symmetric)
    assert right[0] < right[1]
    accuracy = [
        np.mean([scores[k].label_accuracy for k in symmetric]) for scores in (before, after)
    ]
    assert accuracy[1] >= accuracy[0]

    alone, together = map(records_beside, stores)
    groups = [zarr.open_group(store, mode="r") for store in stores]
    for row, asset_id in enumerate(alone):
        if not alone[asset_id]["alignment"]["placements"]:
            assert together[asset_id]["alignment"] == alone[asset_id]["alignment"]
            first, last = groups[0]["asset/offset"][row : row + 2]
            for name in ("properties", "material", "valid", "distance"):
                np.testing.assert_array_equal(
                    groups[0][f"voxel/{name}"][first:last], groups[1][f"voxel/{name}"][first:last]
                )


def test_what_was_settled_is_recorded_and_can_be_undone(stores):
    alone, together = map(records_beside, stores)
    settled = [k for k, record in together.items() if record["alignment"]["settled_by"]]
    assert settled
    for asset_id in settled:
        entry = together[asset_id]["alignment"]
        assert entry["settled_by"]["agreeing"] >= 5
        assert 0 < entry["settled_by"]["probability"] < 1
        if entry["transform"] == alone[asset_id]["alignment"]["transform"]:
            continue
        assert entry["placements"][0]["transform"] == alone[asset_id]["alignment"]["transform"]
        assert together[asset_id]["first_pass"]["alignment"] == alone[asset_id]["alignment"]
    assert not any(record["alignment"]["settled_by"] for record in alone.values())


def test_the_store_alone_gives_the_verdicts_on_ties(stores):
    for path in stores:
        store = open_store(path)
        assert (store.column("ambiguity") > THRESHOLDS.good_ambiguity).any()
        for asset_id, given in zip(store.ids, store.column("verdict"), strict=True):
            check = check_alignment(store, asset_id)
            assert check.consistent and check.verdict == given


def test_building_without_it_brings_the_first_placements_back(habitual, stores, tmp_path):
    _, parameters = habitual
    with_it = replace(parameters, consensus=ConsensusParameters(settle=True))
    store = tmp_path / "store.zarr"
    build_store(with_it, store, jobs=2)
    assert tree(store) == tree(stores[1])  # whatever the jobs
    plan = plan_build(parameters, store)
    assert {asset.action for asset in plan.assets} == {"reuse"}  # no asset is aligned again
    build_store(parameters, store)
    assert tree(store) == tree(stores[0])
    build_store(with_it, store)
    assert tree(store) == tree(stores[1])


def test_a_settled_store_that_is_built_again_is_found_unchanged(habitual, stores):
    with_it = replace(habitual[1], consensus=ConsensusParameters(settle=True))
    times = {path: path.stat().st_mtime_ns for path in stores[1].rglob("*")}
    build_store(with_it, stores[1])
    assert {path: path.stat().st_mtime_ns for path in stores[1].rglob("*")} == times

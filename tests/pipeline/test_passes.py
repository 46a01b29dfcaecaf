"""The passes over a whole dataset: the consensus, and the witness of telling latents."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from support.trees import copied, inodes, records_beside, tree

from slatprep import load_parameters, make_demo, open_store, subset_store
from slatprep.errors import amount
from slatprep.inspect.check import check_alignment
from slatprep.inspect.score import score_against_truth
from slatprep.inspect.verify import verify_store
from slatprep.judge import THRESHOLDS
from slatprep.parameters import BuildParameters, ConsensusParameters, WitnessParameters
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.pipeline.decoys import measure_errors
from slatprep.pipeline.measured import told_of
from slatprep.pipeline.notices import shared_rotation
from slatprep.pipeline.passes import apply_consensus
from slatprep.pipeline.plan import Crew
from slatprep.pipeline.rows import NextStore, Row, SourceStore
from slatprep.store.records import ERRORS, manifests_of

SETTLED = ConsensusParameters(settle=True)
HEARD = WitnessParameters(settle=True)


def assert_same_labels(stores: tuple[Path, Path], row: int) -> None:
    """Hold what one asset was given in one store against what it has in the other."""
    groups = [zarr.open_group(store, mode="r") for store in stores]
    first, last = groups[0]["asset/offset"][row : row + 2]
    for name in ("properties", "material", "valid", "distance", "confidence", "place"):
        ours, theirs = (group[f"voxel/{name}"][first:last] for group in groups)
        np.testing.assert_array_equal(ours, theirs)


@pytest.fixture(scope="module")
def habitual(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BuildParameters]:
    """Make fourteen assets, one a category, that all have one quarter turn in common."""
    root = tmp_path_factory.mktemp("habitual")
    make_demo(root, assets=14, seed=5, levels=(0,), habitual_share=1.0)
    return root, load_parameters(root / "dataset.toml", {})


@pytest.fixture(scope="module")
def agreed(habitual: tuple[Path, BuildParameters]) -> tuple[Path, Path]:
    root, parameters = habitual
    alone, together = root / "alone.zarr", root / "together.zarr"
    build_store(parameters, alone)
    build_store(replace(parameters, consensus=SETTLED), copied(alone, together))
    return alone, together


def test_more_symmetric_assets_are_placed_right_and_no_other_changes(habitual, agreed):
    before, after = (score_against_truth(store, habitual[0] / "truth").assets for store in agreed)
    symmetric = [k for k, score in enumerate(before) if score.symmetric]
    right = [sum(scores[k].displacement < 1.5 for k in symmetric) for scores in (before, after)]
    assert len(symmetric) >= 2
    assert right[1] == len(symmetric)
    assert right[0] < right[1]
    accuracy = [np.mean([each[k].label_accuracy for k in symmetric]) for each in (before, after)]
    assert accuracy[1] >= accuracy[0]

    alone, together = map(records_beside, agreed)
    for row, asset_id in enumerate(alone):
        if not alone[asset_id]["alignment"]["placements"]:
            assert together[asset_id]["alignment"] == alone[asset_id]["alignment"]
            assert_same_labels(agreed, row)


@pytest.mark.parametrize("objects", [1, 4])
def test_assets_of_few_objects_share_no_rotation(objects):
    """Five objects are needed, and a column of the rows says which they are of."""
    columns = {"transform": np.eye(4), "verdict": "good", "n_placements": 0}
    rows = [Row(f"{k}", 1, columns=columns | {"object_id": f"{k % objects}"}) for k in range(40)]
    told: list[str] = []
    assert apply_consensus(rows, None, Crew(1, note=told.append)) is rows
    assert told == ["consensus: too few objects share a rotation; 0 tied ones stay"]


def test_what_was_settled_is_recorded_and_can_be_undone(agreed):
    alone, together = map(records_beside, agreed)
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


def test_decoys_outlive_a_pass_that_places_their_assets_anew(agreed, tmp_path):
    """A decoy is a grid with another object's SLAT, and neither of them has changed."""
    store = copied(agreed[0], tmp_path / "store.zarr")
    aligned: list[tuple[int, ...]] = []
    first = measure_errors(open_store(store), decoys=14, progress=lambda *at: aligned.append(at))
    assert len(aligned) == len(first.decoys) >= 10
    settled = copied(agreed[1], tmp_path / "settled.zarr")
    shutil.copy(manifests_of(store) / ERRORS, manifests_of(settled) / ERRORS)
    assert any("first_pass" in record for record in records_beside(settled).values())
    assert told_of(open_store(settled))[-1].startswith("measured before the last update")
    after = measure_errors(open_store(settled), decoys=14, progress=lambda *at: aligned.append(at))
    assert len(aligned) == len(first.decoys), "all were taken over"
    assert [one.keys for one in after.decoys] == [one.keys for one in first.decoys]


def test_the_store_alone_gives_the_verdicts_on_ties(agreed):
    for path in agreed:
        store = open_store(path)
        assert (store.column("ambiguity") > THRESHOLDS.good_ambiguity).any()
        for asset_id, given in zip(store.ids, store.column("verdict"), strict=True):
            check = check_alignment(store, asset_id)
            assert check.consistent and check.verdict == given


def test_building_without_it_brings_the_first_placements_back(habitual, agreed, tmp_path):
    _, parameters = habitual
    with_it = replace(parameters, consensus=SETTLED)
    store = tmp_path / "store.zarr"
    settled = build_store(with_it, store, jobs=2)
    assert tree(store) == tree(agreed[1])  # whatever the jobs, and what was there
    plan = plan_build(parameters, store)
    assert {asset.action for asset in plan.assets} == {"reuse"}  # no asset is aligned again
    unsettled = build_store(parameters, store)
    assert tree(store) == tree(agreed[0])
    assert not any("--consensus" in text for text in settled.warnings)
    (advice,) = (text for text in unsettled.warnings if "--consensus" in text)
    sure = open_store(store).column("ambiguity") <= THRESHOLDS.good_ambiguity
    assert advice.startswith(f"{(~sure).sum()} of {len(sure)} assets have other placements")
    assert "other objects share a rotation" in advice
    # It is for assets that were read now.
    taken = SourceStore(open_store(store))
    rows = [Row(name, 1, store=0, row=row) for row, name in enumerate(taken.ids)]
    how = taken.normalization, taken.contents, taken.build, parameters.store
    assert list(shared_rotation(NextStore(rows, (taken,), *how))) == []


def test_a_subset_that_is_built_again_is_settled_by_its_own_assets(habitual, agreed, tmp_path):
    root, (alone, together) = habitual[0], map(records_beside, agreed)
    moved = next(name for name, record in together.items() if record["first_pass"])
    shutil.copytree(root / "pixieverse" / moved, tmp_path / "pixieverse" / moved)
    (tmp_path / "slat").mkdir()
    shutil.copy(root / "slat" / f"{moved}.npz", tmp_path / "slat")
    own = {"pixieverse": {"root": tmp_path / "pixieverse"}, "slat": {"root": tmp_path / "slat"}}
    given = {"normalize": {"ranges": "pixie"}, "consensus": {"settle": True}}
    of_all, of_own = (load_parameters(root / "dataset.toml", g) for g in (given, given | own))
    whole, out = copied(agreed[1], tmp_path / "whole.zarr"), tmp_path / "out.zarr"
    build_store(of_all, whole)
    subset_store(whole, out, [moved])
    assert records_beside(out)[moved]["alignment"] == together[moved]["alignment"]
    build_store(of_own, out)
    assert records_beside(out)[moved]["alignment"] == alone[moved]["alignment"]


@pytest.fixture(scope="module")
def telling(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BuildParameters]:
    """Make assets whose latents carry material; another object's labels are put on one."""
    root = tmp_path_factory.mktemp("telling")
    make_demo(root, assets=28, seed=3, levels=(0,), latents="material")
    # The classes of one object, metal and stationary alone, become others: its labels are wrong.
    file = root / "pixieverse" / mislabelled(root) / "sample_0" / "material_grid.npy"
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


def right_labels(root: Path, store: Path) -> dict[str, float]:
    shares = {}
    for asset in open_store(store):
        truth = np.load(root / "truth" / f"{asset.asset_id}.npz")
        shares[asset.asset_id] = float((asset.material == truth["material"])[asset.valid].mean())
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
        assert entry["settled_by"]["probability"] >= 0.95 and after[asset_id] > 0.95
        assert heard[asset_id]["first_pass"]["alignment"] == alone[asset_id]["alignment"]
        judgement = heard[asset_id]["judgement"]
        assert judgement["confidence"] >= 0.9
        if asset_id in differing:
            assert judgement["right_placement"] <= entry["settled_by"]["probability"]
            assert judgement["verdict"] == "good"
            assert alone[asset_id]["judgement"]["verdict"] == "doubtful"
        check = check_alignment(stores[1], asset_id)
        (figure,) = [one for one in check.figures if one.name == "ambiguity"]
        right = entry["settled_by"]["probability"]
        assert check.settled_by == {"latents": right}
        assert (figure.threshold_text, figure.passes) == ("settled", None)
        told = f"settled by latents, right with a probability of {right:.1%}: other placements"
        assert told in check.words[-1] and not check.reasons
    assert any(before[asset_id] < 0.9 for asset_id in settled)
    moved = sum(heard[k]["alignment"]["transform"] != alone[k]["alignment"]["transform"]
                for k in settled)  # fmt: skip
    told = (root / "told").read_text()
    assert f"latents decide {amount(len(settled), 'tie')}, of which {moved} took another" in told
    assert told.endswith("contradict the labels of 1 asset")


def test_assets_without_a_tie_keep_every_byte_but_those_that_are_contradicted(telling, stores):
    alone, heard = map(records_beside, stores)
    wrong = mislabelled(telling[0])
    assert [key for key, record in heard.items() if record["judgement"]["contradicted"]] == [wrong]
    assert alone[wrong]["judgement"]["verdict"] == "good"
    assert heard[wrong]["judgement"]["verdict"] != "good"
    assert "latents contradict" in heard[wrong]["judgement"]["reasons"][0]
    assert heard[wrong]["alignment"] == alone[wrong]["alignment"]
    for row, asset_id in enumerate(alone):
        if heard[asset_id]["first_pass"] is None:
            assert heard[asset_id] == alone[asset_id]
            assert_same_labels(stores, row)


def test_the_summary_names_assets_whose_labels_are_contradicted(telling, stores):
    root, parameters = telling
    before = inodes(stores[1])
    again = build_store(replace(parameters, witness=HEARD), stores[1])  # nothing to do
    assert inodes(stores[1]) == before
    assert again.contradicted == (mislabelled(root),)
    assert build_store(parameters, stores[0]).contradicted == ()


def test_a_store_that_heard_latents_is_sound(stores):
    assert verify_store(stores[1]).findings == ()
    store = open_store(stores[1])
    assert all(check_alignment(store, asset_id).consistent for asset_id in store.ids)


def test_it_is_undone_by_building_without_it_and_the_same_for_any_jobs(telling, stores, tmp_path):
    _, parameters = telling
    store = copied(stores[0], tmp_path / "store.zarr")
    build_store(replace(parameters, witness=HEARD), store, jobs=2)
    assert tree(store) == tree(stores[1])
    assert {asset.action for asset in plan_build(parameters, store).assets} == {"reuse"}
    build_store(parameters, store)
    assert tree(store) == tree(stores[0])


def test_after_a_consensus_the_record_goes_back_to_the_first_pass(telling, stores, tmp_path):
    both = replace(telling[1], witness=HEARD, consensus=SETTLED)
    store = copied(stores[0], tmp_path / "store.zarr")
    build_store(both, store)
    alone = records_beside(stores[0])
    for asset_id, record in records_beside(store).items():
        if record["first_pass"]:
            assert record["first_pass"]["alignment"] == alone[asset_id]["alignment"]
            assert record["first_pass"]["key"] == alone[asset_id]["key"]


def test_latents_that_carry_nothing_change_nothing(habitual, agreed, tmp_path):
    told: list[str] = []
    heard = copied(agreed[0], tmp_path / "heard.zarr")
    summary = build_store(replace(habitual[1], witness=HEARD), heard, note=told.append)
    assert summary.contradicted == ()
    assert "fit their labels best; too few, so latents are not used" in told[-1]
    assert all(record["first_pass"] is None for record in records_beside(heard).values())
    for row in range(len(open_store(heard))):
        assert_same_labels((agreed[0], heard), row)

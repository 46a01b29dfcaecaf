"""Scores against truth, on stores whose figures can be worked out by hand."""

from pathlib import Path

import numpy as np
import pytest
import zarr
from support.commands import document, run
from support.synthetic import SMALL_SHARDS

from slatprep.errors import InputError
from slatprep.geometry.frames import make_transform
from slatprep.inspect.score import TruthScore, score_against_truth, summarise
from slatprep.records import PIXIEVERSE, Normalization, PropertyRange
from slatprep.store.writer import create_store, finish_store

# A rod of two materials along x in the PixieVerse frame.
ROD = np.array([[x, 32, 32] for x in range(20, 40)])
ROD_MATERIAL = np.where(ROD[:, 0] < 30, 1, 5).astype(np.uint8)


def write_store(path: Path, assets: dict[str, dict[str, np.ndarray]]) -> None:
    """Write what a score reads; all else is as in a store that nothing was written to."""
    rows = [assets[asset_id] for asset_id in sorted(assets)]
    counts = [len(row["coords"]) for row in rows]
    create_store(path, len(rows), sum(counts), SMALL_SHARDS)
    root = zarr.open_group(path, mode="r+", use_consolidated=False)
    values = {
        "asset/id": np.array(sorted(assets), dtype=object),
        "asset/offset": np.array([0, *np.cumsum(counts)]),
        "asset/transform": np.stack([row["transform"] for row in rows]),
        "voxel/coords": np.concatenate([row["coords"] for row in rows]),
        "voxel/material": np.concatenate([row["material"] for row in rows]),
        "voxel/valid": np.concatenate([row["valid"] for row in rows]),
        "voxel/place": np.concatenate([places_of(row) for row in rows]),
        "grid/material": np.stack([row["grid"] for row in rows]),
    }
    with zarr.config.set({"array.write_empty_chunks": True}):
        for name, array in root.members(max_depth=None):
            if isinstance(array, zarr.Array):
                array[...] = values.get(name, array.fill_value)
    ranges = tuple(PropertyRange(one.name, False, 0.0, 1.0) for one in PIXIEVERSE.properties)
    build = {"parameters": {"align": {"radius": 1.0}, "sample": {}}, "versions": {}}
    finish_store(path, Normalization(ranges, "dataset"), "0" * 64, build)


def places_of(row: dict[str, np.ndarray]) -> np.ndarray:
    """Return where the inverse of the row's transform puts its voxels, unless it says where."""
    if "place" in row:
        return row["place"]
    centres = (row["coords"] + 0.5) / 64 - 0.5
    transform = row["transform"]
    return (centres - transform[:3, 3]) @ np.linalg.inv(transform[:3, :3]).T


def rod_asset(**changes: np.ndarray) -> dict[str, np.ndarray]:
    grid = np.full((64, 64, 64), 7, np.uint8)
    grid[tuple(ROD.T)] = ROD_MATERIAL
    asset = {
        "coords": ROD,
        "transform": np.eye(4),
        "material": ROD_MATERIAL,
        "valid": np.ones(len(ROD), dtype=bool),
        "grid": grid,
    }
    return asset | changes


def write_truth(folder: Path, asset_id: str, **changes: object) -> None:
    folder.mkdir(exist_ok=True)
    truth = {
        "transform": np.eye(4),
        "material": ROD_MATERIAL,
        "name": "rod",
        "level": 1,
        "symmetric": False,
    }
    np.savez(folder / f"{asset_id}.npz", **(truth | changes))


def scored(folder: Path, asset: dict[str, np.ndarray], **truth: object) -> TruthScore:
    """Score a store of one asset against its truth."""
    write_store(folder / "s.zarr", {"a": asset})
    write_truth(folder / "truth", "a", **truth)
    (score,) = score_against_truth(folder / "s.zarr", folder / "truth").assets
    return score


def test_exact_alignment_scores_zero_and_one(tmp_path):
    write_store(tmp_path / "s.zarr", {"a": rod_asset()})
    write_truth(tmp_path / "truth", "a")
    report = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth")
    assert report.assets == (TruthScore("a", "rod", 1, False, 0.0, 1.0, 1.0, 1.0, 0.0, 1.0),)
    assert report.missing == ()


def test_shift_by_two_voxels_is_a_displacement_of_two(tmp_path):
    shift = np.eye(4)
    shift[0, 3] = 2 / 64
    assert scored(tmp_path, rod_asset(transform=shift)).displacement == pytest.approx(2.0)


def test_displacement_is_measured_in_the_pixieverse_frame(tmp_path):
    # The SLAT is twice as large, so a shift by two of its voxels is one of the grid's.
    double, shifted = np.diag([2.0, 2.0, 2.0, 1.0]), np.diag([2.0, 2.0, 2.0, 1.0])
    shifted[1, 3] = 2 / 64
    score = scored(tmp_path, rod_asset(transform=shifted), transform=double)
    assert score.displacement == pytest.approx(1.0)


def test_wrong_and_missing_labels_both_count(tmp_path):
    material, valid = ROD_MATERIAL.copy(), np.ones(len(ROD), dtype=bool)
    material[:3] = 6
    valid[3:5] = False
    score = scored(tmp_path, rod_asset(material=material, valid=valid))
    assert score.label_accuracy == pytest.approx(15 / 20)
    assert score.truth_own == 1.0
    assert score.valid_share == pytest.approx(18 / 20)


def test_voxels_without_an_answer_are_not_asked(tmp_path):
    # Four voxels more lie off the rod's end: two within 2 voxels, two beyond.
    longer = np.array([[x, 32, 32] for x in range(20, 44)])
    true_material = np.concatenate([ROD_MATERIAL, np.full(4, 5)]).astype(np.uint8)
    stored = np.concatenate([ROD_MATERIAL, [0, 5, 0, 0]]).astype(np.uint8)
    asset = rod_asset(coords=longer, material=stored, valid=np.arange(24) < 23)
    score = scored(tmp_path, asset, material=true_material)
    assert score.label_accuracy == pytest.approx(21 / 22)
    assert score.valid_share == pytest.approx(23 / 24)


def test_unannotated_voxels_are_no_answer(tmp_path):
    grid = rod_asset()["grid"].copy()
    grid[20:26, 32, 32] = 255
    score = scored(tmp_path, rod_asset(grid=grid))
    assert score.truth_own == 1.0  # x = 24, 25 ask their neighbour at 26; the rest is not asked


def test_level_figures_leave_symmetric_assets_out():
    scores = [
        TruthScore("a", "", 0, False, 0.1, 1.0, 1.0, 1.0, 0.0, 1.0),
        TruthScore("b", "", 0, False, 0.3, 0.8, 0.9, 0.5, 0.0, 0.9),
        TruthScore("c", "", 0, False, 1.5, 0.6, 0.8, 0.6, 0.0, 0.8),
        TruthScore("d", "", 0, True, 40.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        TruthScore("e", "", 3, True, 40.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ]
    (level,) = summarise(scores)
    assert (level.level, level.assets) == (0, 3)
    assert level.success == pytest.approx(2 / 3)  # 1.5 itself is not below 1.5
    assert level.displacement_median == 0.3
    assert level.label_accuracy == pytest.approx(0.8)
    assert level.truth_own == pytest.approx(0.9)
    assert level.valid_share == pytest.approx(0.7)


def test_right_is_within_a_voxel_and_a_half_of_the_best_similarity():
    scores = [
        TruthScore("a", "", 5, False, 3.4, 0.9, 1.0, 1.0, 2.0, 0.95),
        TruthScore("b", "", 5, False, 3.5, 0.9, 1.0, 1.0, 2.0, 0.85),
        TruthScore("c", "", 5, False, 0.2, 0.9, 1.0, 1.0, 4.0, 0.81),
    ]
    (level,) = summarise(scores)
    assert level.success == pytest.approx(2 / 3)
    assert level.similarity_displacement == 2.0
    assert level.similarity_accuracy == pytest.approx(0.87)


# A rod that a generator stretched to twice its length: SLAT voxel x truly lies at x / 2 + 15.
LONG = np.array([[x, 32, 32] for x in range(10, 50)])
LONG_PLACES = np.column_stack([(LONG[:, 0] + 0.5) / 2 + 15, np.full((40, 2), 32.5)]) / 64 - 0.5
LONG_MATERIAL = np.where(LONG_PLACES[:, 0] * 64 + 32 < 30, 1, 5).astype(np.uint8)


def write_long_truth(folder: Path, **changes: object) -> None:
    truth = {"material": LONG_MATERIAL, "places": LONG_PLACES, "level": 5}
    write_truth(folder, "a", **(truth | changes))


def long_asset(**changes: np.ndarray) -> dict[str, np.ndarray]:
    looked_up = {"coords": LONG, "material": LONG_MATERIAL, "valid": np.ones(40, dtype=bool)}
    return rod_asset(**(looked_up | changes))


def test_displacement_is_from_the_true_places(tmp_path):
    write_store(tmp_path / "s.zarr", {"a": long_asset()})
    write_long_truth(tmp_path / "truth")
    (score,) = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth").assets
    # The identity leaves voxel x at x + 0.5 where x / 2 + 15.25 is right.
    apart = np.abs(LONG[:, 0] + 0.5 - (LONG[:, 0] + 0.5) / 2 - 15)
    assert score.displacement == pytest.approx(apart.mean())
    assert score.similarity_displacement == pytest.approx(apart.mean())
    assert score.label_accuracy == 1.0
    assert score.truth_own == 1.0
    # The identity asks the rod of 20 voxels from 20 to 39, which changes at 30 as well.
    assert score.similarity_accuracy == pytest.approx(1.0)
    write_long_truth(tmp_path / "truth", transform=make_transform(np.eye(3), (5 / 64, 0, 0)))
    (score,) = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth").assets
    # Back by five voxels, voxels 30 to 34 ask for the other material.
    assert score.similarity_accuracy == pytest.approx(35 / 40)
    assert score.truth_own == 1.0
    assert score.displacement == pytest.approx(apart.mean())
    moved = np.abs(LONG[:, 0] + 0.5 - 5 - (LONG[:, 0] + 0.5) / 2 - 15)
    assert score.similarity_displacement == pytest.approx(moved.mean())


def test_places_of_the_store_are_what_counts(tmp_path):
    rod_places = (ROD + 0.5) / 64 - 0.5 + [0.0, 0.0, 3 / 64]
    aside = np.array([0.0, 1 / 64, 0.0])
    assets = {"a": long_asset() | {"place": LONG_PLACES + aside}}
    write_store(tmp_path / "s.zarr", assets | {"b": rod_asset(place=rod_places)})
    write_long_truth(tmp_path / "truth")
    write_truth(tmp_path / "truth", "b")
    first, second = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth").assets
    assert first.displacement == pytest.approx(1.0, abs=1e-5)
    assert second.displacement == pytest.approx(3.0, abs=1e-5)
    assert second.similarity_displacement == 0.0


def test_places_that_do_not_fit_are_named(tmp_path):
    write_store(tmp_path / "s.zarr", {"a": long_asset()})
    write_long_truth(tmp_path / "truth", places=LONG_PLACES[:-1])
    with pytest.raises(InputError, match=r"a\.npz: places has shape \(39, 3\)"):
        score_against_truth(tmp_path / "s.zarr", tmp_path / "truth")


def test_a_printed_score_fits_a_terminal(tmp_path):
    write_store(tmp_path / "s.zarr", {"a": long_asset(), "b": rod_asset()})
    write_long_truth(tmp_path / "truth")
    write_truth(tmp_path / "truth", "b")
    words = ("score", tmp_path / "s.zarr", tmp_path / "truth")
    lines = run(*words).output.splitlines()
    assert max(map(len, lines)) <= 80
    assert [line[:2] for line in lines].count("L5") == 2
    (level,) = [entry for entry in document(*words)["levels"] if entry["level"] == 5]
    assert level["similarity_displacement"] == pytest.approx(level["displacement_median"])


def test_assets_without_row_or_truth(tmp_path):
    write_store(tmp_path / "s.zarr", {"a": rod_asset(), "b": rod_asset()})
    write_truth(tmp_path / "truth", "b")
    write_truth(tmp_path / "truth", "c")
    report = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth")
    assert [score.asset_id for score in report.assets] == ["b"]
    assert report.missing == ("c",)


def test_truth_that_does_not_fit_is_named(tmp_path):
    write_store(tmp_path / "s.zarr", {"a": rod_asset()})
    with pytest.raises(InputError, match="no truth"):
        score_against_truth(tmp_path / "s.zarr", tmp_path)
    write_truth(tmp_path / "truth", "a", material=ROD_MATERIAL[:-1])
    with pytest.raises(InputError, match=r"a\.npz: material has shape \(19,\)"):
        score_against_truth(tmp_path / "s.zarr", tmp_path / "truth")
    np.savez(tmp_path / "truth" / "a.npz", transform=np.eye(4))
    with pytest.raises(InputError, match=r"a\.npz: .*material"):
        score_against_truth(tmp_path / "s.zarr", tmp_path / "truth")
    (tmp_path / "truth" / "a.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(InputError, match=r"a\.npz: cannot be read"):
        score_against_truth(tmp_path / "s.zarr", tmp_path / "truth")

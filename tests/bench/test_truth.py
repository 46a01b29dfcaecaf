"""Scores against truth, on stores whose figures can be worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr

from slatprep.bench.truth import TruthScore, score_against_truth, summarise
from slatprep.errors import InputError

# A rod of two materials along x in the PixieVerse frame.
ROD = np.array([[x, 32, 32] for x in range(20, 40)])
ROD_MATERIAL = np.where(ROD[:, 0] < 30, 1, 5).astype(np.uint8)


def write_store(path: Path, assets: dict[str, dict[str, np.ndarray]]) -> None:
    """Write what a score reads, with zarr alone."""
    ids = sorted(assets)
    rows = [assets[asset_id] for asset_id in ids]
    counts = [len(row["coords"]) for row in rows]
    n = sum(counts)
    root = zarr.create_group(path, zarr_format=3)
    root.attrs.update({"format": "slatprep-store", "format_version": 1})
    arrays: dict[str, np.ndarray] = {
        "asset/offset": np.array([0, *np.cumsum(counts)], dtype=np.int64),
        "asset/transform": np.stack([row["transform"] for row in rows]),
        "voxel/coords": np.concatenate([row["coords"] for row in rows]).astype(np.uint8),
        "voxel/feats": np.zeros((n, 8), np.float32),
        "voxel/properties": np.zeros((n, 3), np.float32),
        "voxel/material": np.concatenate([row["material"] for row in rows]).astype(np.uint8),
        "voxel/valid": np.concatenate([row["valid"] for row in rows]),
        "voxel/distance": np.zeros(n, np.float32),
        "grid/properties": np.zeros((len(ids), 3, 64, 64, 64), np.float32),
        "grid/material": np.stack([row["grid"] for row in rows]),
    }
    for name in ("fitness", "inlier_rmse", "fitness_backward", "inlier_rmse_backward", "overlap",
                 "margin", "ambiguity", "valid_share"):  # fmt: skip
        arrays[f"asset/{name}"] = np.zeros(len(ids))
    arrays["asset/property_ambiguity"] = np.zeros((len(ids), 3))
    for name, array in arrays.items():
        root.create_array(name, data=array, config={"write_empty_chunks": True})
    for name in ("id", "object_id", "view", "category", "engine", "model", "search", "verdict"):
        strings = root.create_array(f"asset/{name}", shape=(len(ids),), dtype=str)
        strings[:] = np.array(ids if name == "id" else [""] * len(ids), dtype=object)


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
    np.savez(folder / f"{asset_id}.npz", **(truth | changes))  # type: ignore[arg-type]


def test_exact_alignment_scores_zero_and_one(tmp_path: Path) -> None:
    write_store(tmp_path / "s.zarr", {"a": rod_asset()})
    write_truth(tmp_path / "truth", "a")
    report = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth")
    assert report.assets == (TruthScore("a", "rod", 1, False, 0.0, 1.0, 1.0, 1.0),)
    assert report.missing == ()


def test_shift_by_two_voxels_is_a_displacement_of_two(tmp_path: Path) -> None:
    shift = np.eye(4)
    shift[0, 3] = 2 / 64
    write_store(tmp_path / "s.zarr", {"a": rod_asset(transform=shift)})
    write_truth(tmp_path / "truth", "a")
    (score,) = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth").assets
    assert score.displacement == pytest.approx(2.0)


def test_displacement_is_measured_in_the_pixieverse_frame(tmp_path: Path) -> None:
    # The SLAT is twice as large, so a shift by two of its voxels is one of the grid's.
    double, shifted = np.diag([2.0, 2.0, 2.0, 1.0]), np.diag([2.0, 2.0, 2.0, 1.0])
    shifted[1, 3] = 2 / 64
    write_store(tmp_path / "s.zarr", {"a": rod_asset(transform=shifted)})
    write_truth(tmp_path / "truth", "a", transform=double)
    (score,) = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth").assets
    assert score.displacement == pytest.approx(1.0)


def test_wrong_and_missing_labels_both_count(tmp_path: Path) -> None:
    material, valid = ROD_MATERIAL.copy(), np.ones(len(ROD), dtype=bool)
    material[:3] = 6
    valid[3:5] = False
    write_store(tmp_path / "s.zarr", {"a": rod_asset(material=material, valid=valid)})
    write_truth(tmp_path / "truth", "a")
    (score,) = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth").assets
    assert score.label_accuracy == pytest.approx(15 / 20)
    assert score.truth_own == 1.0
    assert score.valid_share == pytest.approx(18 / 20)


def test_voxels_without_an_answer_are_not_asked(tmp_path: Path) -> None:
    # Four voxels more lie off the rod's end: two within 2 voxels, two beyond.
    longer = np.array([[x, 32, 32] for x in range(20, 44)])
    true_material = np.concatenate([ROD_MATERIAL, np.full(4, 5)]).astype(np.uint8)
    stored = np.concatenate([ROD_MATERIAL, [0, 5, 0, 0]]).astype(np.uint8)
    asset = rod_asset(coords=longer, material=stored, valid=np.ones(24, dtype=bool))
    write_store(tmp_path / "s.zarr", {"a": asset})
    write_truth(tmp_path / "truth", "a", material=true_material)
    (score,) = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth").assets
    assert score.label_accuracy == pytest.approx(21 / 22)


def test_unannotated_voxels_are_no_answer(tmp_path: Path) -> None:
    grid = rod_asset()["grid"].copy()
    grid[20:26, 32, 32] = 255
    write_store(tmp_path / "s.zarr", {"a": rod_asset(grid=grid)})
    write_truth(tmp_path / "truth", "a")
    (score,) = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth").assets
    assert score.truth_own == 1.0  # x = 24, 25 ask their neighbour at 26; the rest is not asked


def test_level_figures_leave_symmetric_assets_out() -> None:
    scores = [
        TruthScore("a", "", 0, False, 0.1, 1.0, 1.0, 1.0),
        TruthScore("b", "", 0, False, 0.3, 0.8, 0.9, 0.5),
        TruthScore("c", "", 0, False, 1.5, 0.6, 0.8, 0.6),
        TruthScore("d", "", 0, True, 40.0, 0.0, 0.0, 0.0),
        TruthScore("e", "", 3, True, 40.0, 0.0, 0.0, 0.0),
    ]
    (level,) = summarise(scores)
    assert (level.level, level.assets) == (0, 3)
    assert level.success == pytest.approx(2 / 3)  # 1.5 itself is not below 1.5
    assert level.displacement_median == 0.3
    assert level.label_accuracy == pytest.approx(0.8)
    assert level.truth_own == pytest.approx(0.9)
    assert level.valid_share == pytest.approx(0.7)


def test_assets_without_row_or_truth(tmp_path: Path) -> None:
    write_store(tmp_path / "s.zarr", {"a": rod_asset(), "b": rod_asset()})
    write_truth(tmp_path / "truth", "b")
    write_truth(tmp_path / "truth", "c")
    report = score_against_truth(tmp_path / "s.zarr", tmp_path / "truth")
    assert [score.asset_id for score in report.assets] == ["b"]
    assert report.missing == ("c",)


def test_truth_that_does_not_fit_is_named(tmp_path: Path) -> None:
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

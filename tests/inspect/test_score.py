"""Scores against truth, whose figures can be worked out by hand."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from support.commands import document, refused, run
from support.made_store import rewrite
from support.shapes import GRID, annotated, field_of, latents_of

from slatprep import InputError, open_store
from slatprep.geometry.frames import make_transform, places_of
from slatprep.geometry.voxels import occupancy_of
from slatprep.inspect.score import (
    Truth,
    TruthScore,
    compare_with_truth,
    score_against_truth,
    summarise,
)

# A rod of two materials along x in the PixieVerse frame.
ROD = np.array([[x, 32, 32] for x in range(20, 40)])
ROD_MATERIAL = np.where(ROD[:, 0] < 30, 1, 5).astype(np.uint8)
UNMOVED = np.eye(4)
TRUTH = Truth(Path("a.npz"), UNMOVED, ROD_MATERIAL, "rod", 1, False)
FIELD = field_of(occupancy_of(ROD), np.where(GRID[..., 0] < 30, 1, 5))


def scored(truth=TRUTH, coords=ROD, transform=UNMOVED, field=FIELD, **of_annotation) -> TruthScore:
    """Score a rod whose voxels are the SLAT's and labelled right, but for what is said of it."""
    latents = latents_of(coords)
    places = places_of(latents.centres, transform)
    annotation = replace(annotated(truth.material, places), **of_annotation)
    return compare_with_truth("a", truth, field, latents, annotation)


def test_displacement_is_measured_in_the_pixieverse_frame():
    assert scored() == TruthScore("a", "rod", 1, False, 0.0, 1.0, 1.0, 1.0, 0.0, 1.0)
    shift = make_transform(np.eye(3), (2 / 64, 0, 0))
    assert scored(transform=shift).displacement == pytest.approx(2.0)
    # The SLAT is twice as large, so a shift by two of its voxels is one of the grid's.
    double, shifted = np.diag([2.0, 2.0, 2.0, 1.0]), np.diag([2.0, 2.0, 2.0, 1.0])
    shifted[1, 3] = 2 / 64
    score = scored(replace(TRUTH, transform=double), transform=shifted)
    assert score.displacement == pytest.approx(1.0)


def test_wrong_and_missing_labels_both_count():
    material, valid = ROD_MATERIAL.copy(), np.ones(len(ROD), dtype=bool)
    material[:3] = 6
    valid[3:5] = False
    score = scored(material=material, valid=valid)
    assert score.label_accuracy == pytest.approx(15 / 20)
    assert score.truth_own == 1.0
    assert score.valid_share == pytest.approx(18 / 20)


def test_voxels_without_an_answer_are_not_asked():
    # Four voxels more lie off the rod's end: two within 2 voxels, two beyond.
    longer = np.array([[x, 32, 32] for x in range(20, 44)])
    true_material = np.concatenate([ROD_MATERIAL, np.full(4, 5)]).astype(np.uint8)
    stored = np.concatenate([ROD_MATERIAL, [0, 5, 0, 0]]).astype(np.uint8)
    truth = replace(TRUTH, material=true_material)
    score = scored(truth, longer, material=stored, valid=np.arange(24) < 23)
    assert score.label_accuracy == pytest.approx(21 / 22)
    assert score.valid_share == pytest.approx(23 / 24)


def test_unannotated_voxels_are_no_answer():
    rest = replace(FIELD, voxels=FIELD.voxels[6:], material=ROD_MATERIAL[6:])
    score = scored(field=rest)
    assert score.truth_own == 1.0  # x = 24, 25 ask their neighbour at 26; the rest is not asked


def test_level_figures_leave_symmetric_assets_out():
    (level,) = summarise([
        TruthScore("a", "", 5, False, 3.4, 1.0, 1.0, 1.0, 2.0, 0.95),
        TruthScore("b", "", 5, False, 3.5, 0.8, 0.9, 0.5, 2.0, 0.85),
        TruthScore("c", "", 5, False, 0.2, 0.6, 0.8, 0.6, 4.0, 0.81),
        TruthScore("d", "", 5, True, 40.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        TruthScore("e", "", 3, True, 40.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ])  # fmt: skip
    # Right is less than 1.5 above the best similarity: 3.4 and 0.2, and not 3.5.
    expected = {
        "level": 5, "assets": 3, "success": 2 / 3, "displacement_median": 3.4,
        "displacement_p90": 3.48, "label_accuracy": 0.8, "truth_own": 0.9, "valid_share": 0.7,
        "similarity_displacement": 2.0, "similarity_accuracy": 0.87,
    }  # fmt: skip
    assert asdict(level) == pytest.approx(expected)


def test_displacement_is_from_the_true_places():
    # A rod that a generator stretched to twice its length: voxel x truly lies at x / 2 + 15.
    long = np.array([[x, 32, 32] for x in range(10, 50)])
    places = np.column_stack([(long[:, 0] + 0.5) / 2 + 15, np.full((40, 2), 32.5)]) / 64 - 0.5
    material = np.where(places[:, 0] * 64 + 32 < 30, 1, 5).astype(np.uint8)
    truth = replace(TRUTH, material=material, places=places)
    # The identity leaves voxel x at x + 0.5 where x / 2 + 15.25 is right, and asks the rod of 20
    # voxels from 20 to 39, which changes at 30 as well; back by five, 30 to 34 ask for the other.
    apart = (long[:, 0] + 0.5) / 2 - 15
    for back, accuracy in ((0, 1.0), (5, 35 / 40)):
        there = make_transform(np.eye(3), (back / 64, 0, 0))
        score = scored(replace(truth, transform=there), long)
        assert score.displacement == pytest.approx(np.abs(apart).mean())
        assert score.similarity_displacement == pytest.approx(np.abs(apart - back).mean())
        assert score.label_accuracy == score.truth_own == 1.0
        assert score.similarity_accuracy == pytest.approx(accuracy)
    aside = scored(truth, long, place=np.add(places, [0.0, 1 / 64, 0.0]))
    assert aside.displacement == pytest.approx(1.0)


# -- of a store -----------------------------------------------------------------


def write_truth(store: Path, folder: Path, asset_id: str, **changes: object) -> None:
    """Write what the store says of an asset as its truth, but for changes; None leaves out."""
    folder.mkdir(exist_ok=True)
    asset = open_store(store).asset(asset_id)
    truth = {"transform": asset.transform, "material": asset.material, "name": "L", "level": 5}
    said = truth | {"symmetric": False} | changes
    kept = {name: value for name, value in said.items() if value is not None}
    np.savez(folder / f"{asset_id}.npz", **kept)


def test_places_and_labels_of_the_store_are_what_counts(copy, tmp_path):
    asset = open_store(copy).asset("ant")
    material = asset.material.copy()
    material[:7] = 6
    rewrite(copy, "voxel/place", slice(0, len(material)), asset.place + np.float32([0, 0, 3 / 64]))
    rewrite(copy, "voxel/valid", slice(10, 14), False)
    write_truth(copy, tmp_path / "truth", "ant", material=material)
    write_truth(copy, tmp_path / "truth", "dog", places=open_store(copy).asset("dog").place)
    one, other = score_against_truth(copy, tmp_path / "truth").assets
    assert one.displacement == pytest.approx(3.0, abs=1e-4)
    assert one.similarity_displacement == 0.0
    count = len(material)
    assert one.valid_share == pytest.approx(1 - 4 / count)
    assert one.label_accuracy == pytest.approx(1 - 11 / count)
    assert other.displacement == 0.0 and other.label_accuracy == 1.0


def test_a_printed_score_fits_a_terminal_and_tells_of_a_truth_without_a_row(store, tmp_path):
    write_truth(store, tmp_path / "truth", "ant")
    write_truth(store, tmp_path / "truth", "dog", level=1)
    words = ("score", store, tmp_path / "truth")
    lines = run(*words).output.splitlines()
    assert max(map(len, lines)) <= 80
    assert [line[:2] for line in lines].count("L5") == 2
    (tmp_path / "truth" / "dog.npz").rename(tmp_path / "truth" / "nobody.npz")
    found = document(*words, code=1)
    assert [(one["level"], one["assets"]) for one in found["levels"]] == [(5, 1)]
    assert [one["asset_id"] for one in found["assets"]] == ["ant"]
    assert found["missing"] == ["nobody"]
    (tmp_path / "truth" / "ant.npz").unlink()
    told = run(*words, code=1)
    assert told.stdout == "" and told.stderr.count("\n") == 1
    assert "none of its 1 files has the id of an asset of" in told.stderr


@pytest.mark.parametrize(("changes", "told"), [
    ({"material": np.zeros(19, np.uint8)}, r": material has shape \(19,\)"),
    ({"places": np.zeros((19, 3))}, r": places has shape \(19, 3\)"),
    ({"material": None}, ".*material"),
    ({"material": lambda count: np.full(count, "x")}, r": cannot be read \(has dtype"),
    ({"transform": np.zeros((4, 4))}, ".*transform"),
    ({"transform": np.full((4, 4), np.nan)}, ".*transform"),
    ({"transform": np.eye(3)}, r": cannot be read \(has shape \(3, 3\)"),
    ({"name": np.array([{}], object)}, ": cannot be read"),
    ({"level": np.arange(3)}, r": cannot be read \(has shape \(3,\)"),
    ({"places": lambda count: np.full((count, 3), np.nan)}, ".*places"),
    (b"PK\x03\x04 cut off", ": cannot be read"),
])  # fmt: skip
def test_truth_that_is_none_or_does_not_fit_is_named(store, tmp_path, changes, told):
    with pytest.raises(InputError, match="no truth"):
        score_against_truth(store, tmp_path)
    if isinstance(changes, bytes):
        (tmp_path / "ant.npz").write_bytes(changes)
    else:
        count = len(open_store(store).asset("ant").coords)
        arrays = {name: v(count) if callable(v) else v for name, v in changes.items()}
        write_truth(store, tmp_path, "ant", **arrays)
    assert "ant.npz" in refused("score", store, tmp_path, code=1)
    with pytest.raises(InputError, match=rf"ant\.npz{told}"):
        score_against_truth(store, tmp_path)

"""Figures and verdicts on cases worked out by hand."""

import numpy as np
import pytest
from support.shapes import chair, field_of, surface_latents

from slatprep.align.quality import compare, measure_quality
from slatprep.geometry.frames import make_transform
from slatprep.judge import THRESHOLDS, verdict_of
from slatprep.records import Quality, Verdict

LINE = np.array([[i, 30, 30] for i in range(10)], dtype=np.uint8)


def test_a_shift_along_a_line_by_hand():
    # Ten voxels in a row, carried three and a half voxels along: six have a
    # partner half a voxel away, the seventh lies half a voxel past the end.
    transform = make_transform(np.eye(3), [3.5 / 64, 0, 0])
    quality = compare(LINE, LINE, transform, radius=1.0)
    assert quality.fitness == pytest.approx(0.7)
    assert quality.fitness_backward == pytest.approx(0.7)
    assert quality.inlier_rmse == pytest.approx(0.5)
    assert quality.overlap == pytest.approx(0.7)


def test_distances_are_in_voxels_of_the_slat_frame():
    # Twice as large about the cube's centre: neighbours stand two voxels apart,
    # so every second SLAT voxel is half a voxel from a carried one's centre.
    pixieverse = np.array([[i, 31, 31] for i in range(28, 36)], dtype=np.uint8)
    slat = np.array([[i, 31, 31] for i in range(24, 40)], dtype=np.uint8)
    quality = compare(pixieverse, slat, make_transform(np.eye(3), scale=2.0), radius=1.0)
    # (i + 0.5 - 32) * 2 + 32 - 0.5 = 2 i - 31.5: half-way between two in x, and
    # in y and z 31 -> 30.5, half a voxel off the row.
    expected = np.sqrt(3 * 0.25)
    assert quality.inlier_rmse == pytest.approx(expected)
    assert quality.inlier_rmse_backward == pytest.approx(expected)
    assert quality.fitness == quality.fitness_backward == 1.0


def test_the_radius_is_in_voxels_of_the_slat_frame_both_ways():
    # One PixieVerse voxel off is half a SLAT voxel at this scale, and three are one and a half.
    pixieverse = np.array([[32, 32, 32]], dtype=np.uint8)
    for off, near in ((1, 1.0), (3, 0.0)):
        transform = make_transform(
            np.eye(3), [0.5 * off / 64 + 0.25 / 64, 0.25 / 64, 0.25 / 64], 0.5
        )
        quality = compare(pixieverse, pixieverse, transform, radius=1.0)
        assert (quality.fitness, quality.fitness_backward) == (near, near)
        rmse = quality.inlier_rmse, quality.inlier_rmse_backward
        assert rmse == pytest.approx((0.5 * off * near,) * 2)


def test_far_sets_have_no_inlier_and_no_nan():
    quality = compare(LINE, LINE, make_transform(np.eye(3), [0, 0.4, 0]), radius=1.0)
    assert (quality.fitness, quality.inlier_rmse, quality.overlap) == (0.0, 0.0, 0.0)


def test_voxels_inside_the_slat_do_not_count_against_it():
    solid = chair()
    latents = surface_latents(solid)
    inner = np.array([[30, 30, 25]], dtype=np.uint8)  # a wall between two parts
    crowded = type(latents)(
        np.concatenate([latents.coords, inner]), np.zeros((len(latents.coords) + 1, 8), np.float32)
    )
    for either in (latents, crowded):
        quality = measure_quality(field_of(solid), either, np.eye(4), 1.0)
        assert quality.fitness == quality.fitness_backward == quality.overlap == 1.0


def _quality(fitness: float, backward: float = 1.0) -> Quality:
    return Quality(fitness, 0.5, backward, 0.5, 0.9, 1.0)


@pytest.mark.parametrize(
    ("quality", "valid", "ambiguity", "verdict", "word"),
    [
        (_quality(0.95), 1.0, 0.0, Verdict.GOOD, ""),
        (_quality(THRESHOLDS.good_fitness), 1.0, 0.0, Verdict.GOOD, ""),
        (_quality(0.79), 1.0, 0.0, Verdict.DOUBTFUL, "PixieVerse boundary"),
        (_quality(1.0, 0.79), 1.0, 0.0, Verdict.DOUBTFUL, "SLAT boundary"),
        (_quality(1.0, 0.64), 1.0, 0.0, Verdict.FAILED, "SLAT boundary"),
        (_quality(THRESHOLDS.failed_fitness), 1.0, 0.0, Verdict.DOUBTFUL, ""),
        (_quality(0.64), 1.0, 0.0, Verdict.FAILED, "64.0%"),
        (_quality(1.0), 0.79, 0.0, Verdict.DOUBTFUL, "annotation"),
        (_quality(1.0), 1.0, 0.05, Verdict.GOOD, ""),
        (_quality(1.0), 1.0, 0.3, Verdict.DOUBTFUL, "30.0%"),
    ],
)
def test_verdicts(quality, valid, ambiguity, verdict, word):
    given, reasons = verdict_of(quality, valid, ambiguity, ties=1)
    assert given is verdict
    assert word in " ".join(reasons)
    assert bool(reasons) == (verdict is not Verdict.GOOD)

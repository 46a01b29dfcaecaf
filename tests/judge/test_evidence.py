"""The figures that confidence follows from, by hand and by geometry that can be worked out."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.shapes import GRID, aligned, annotated, field_of, latents_of, surface_latents

from slatprep import records
from slatprep.align.agreement import agreement_of
from slatprep.align.figures import measure_figures
from slatprep.align.pose import Similarity
from slatprep.align.residuals import Residuals
from slatprep.align.surface import surface_of
from slatprep.align.warp import Warp
from slatprep.geometry.frames import make_transform
from slatprep.geometry.voxels import occupancy_of
from slatprep.judge.ambiguity import HARMLESS, measure_ambiguity
from slatprep.judge.confidence import class_confidence, voxel_figures
from slatprep.judge.evidence import (
    FIGURES,
    VOXEL_FIGURES,
    Surroundings,
    _labels_of,
    evidence_of,
    labels_hold,
    surroundings_of,
)
from slatprep.parameters import SampleParameters
from slatprep.sample import sample

UPSIDE_DOWN = np.diag([-1.0, 1.0, -1.0, 1.0])
FAR_OFF = make_transform(np.eye(3), [0.5, 0.5, 0.5])

NO_TIES = np.zeros(99, np.float32)

FIT = records.FitFigures(
    score_slat=0.81, score_pixieverse=0.72, score_similarity=0.63,
    evidence_affine=math.nan, evidence_deformable=math.nan,
    within=(0.4, 0.5, 0.6), offset=-0.3, roughness=0.7,
    moved=1.5, moved_most=4.0, stretch=(0.7, 1.2), bending=0.01, clear_by=1.9,
    agreement=records.Agreement(0.2, 0.3, 0.4, 0.5, 0.6, 0.7, (0.1, 0.2, 0.3), (0.4, 0.5, 0.6)),
)  # fmt: skip


def fitted(transform: np.ndarray | None = None, *ties: np.ndarray) -> records.Alignment:
    quality = records.Quality(0.9, 0.5, 0.8, 0.5, 0.7, 1.0)
    first = np.eye(4) if transform is None else transform
    return aligned(first, *ties, quality=quality, margin=0.2, figures=FIT)


def tied_of(*looked_up: Any) -> np.ndarray:
    """Return `Surroundings.tied` of field, latents, alignment and annotation."""
    return measure_ambiguity(*looked_up, SampleParameters())[1]


def column(
    painted: int,
) -> tuple[records.MaterialField, records.StructuredLatents, records.Annotation]:
    """Return a column of 20 layers, the lower ones painted, in the middle of the grid."""
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[31:33, 32, 22:42] = True  # so that `UPSIDE_DOWN` keeps its shape
    field = field_of(solid, np.where(GRID[..., 2] < 22 + painted, 3, 1))
    latents = latents_of(field.voxels)
    return field, latents, sample(field, latents.centres, SampleParameters())


NOTHING = np.zeros(4, np.float32)
SOLID = np.array([[9, share, 9, 9] for share in (0.2, 0.4, 0.6, 0.8)], np.float32)
AROUND = Surroundings(np.zeros((4, 4), np.float32), SOLID, NOTHING, NOTHING, NOTHING)


def figures(alignment: records.Alignment, ambiguity: float) -> dict[str, float]:
    field, latents, _ = column(5)
    material = np.array([1, 1, 1, 255])
    annotation = annotated(material, distance=np.array([0.0, 1.0, 2.0, 9.0], np.float32))
    found = evidence_of(field, latents, alignment, annotation, AROUND, ambiguity)
    return dict(zip(FIGURES, found.tolist(), strict=True))


def test_each_figure_by_hand():
    scaled = fitted(make_transform(np.eye(3), scale=0.8), UPSIDE_DOWN, FAR_OFF)
    expected = {
        "score_slat": 0.81, "score_pixieverse": 0.72, "score_similarity": 0.63,
        "within_1": 0.4, "within_2": 0.5, "within_3": 0.6,
        "moved": 1.5, "moved_most": 4.0, "bending": 0.01,
        "stretch": -math.log(0.7),  # farther from one than 1.2
        "scale": -math.log(0.8), "offset": 0.3,
        "margin": 0.2, "clear_by": 1.9, "ties": math.log(3),
        "fitness": 0.9, "fitness_backward": 0.8, "valid_share": 0.75,
        "distance": (0 + 1 + 2 + 5) / 4,  # beyond five voxels it says no more
        "depth": math.sqrt((0.3**2 + 0.1**2) / 2),  # -0.3, -0.1, 0.1 and 0.3
        "alike": 0.0, "ground": 0.0,
        "directions_near": 0.2, "directions_middle": 0.3, "directions_worst": 0.4,
        "blocks_near": 0.5, "blocks_middle": 0.6, "blocks_far": 0.7,
        "slat_within_half": 0.1, "slat_within_1": 0.2, "slat_within_15": 0.3,
        "pixieverse_within_half": 0.4, "pixieverse_within_1": 0.5, "pixieverse_within_15": 0.6,
    }  # fmt: skip
    assert figures(scaled, 0.3) == pytest.approx(expected)


def test_what_was_not_measured_of_the_agreement_is_not_known():
    older = replace(fitted(), figures=replace(FIT, agreement=None))
    unknown = [name for name, value in figures(older, 0.0).items() if math.isnan(value)]
    assert unknown == list(FIGURES[-12:])


def test_agreement_by_direction_and_by_block_by_hand():
    """Eleven samples of a direction are too few to count, and other directions weigh as they do."""
    rows = np.array([21, 21, 42, 11])
    slat = np.concatenate([np.arange(20, -1, -1) / 10 * np.resize([1, -1], 21), np.zeros(21)])
    pixieverse = np.repeat([-9.0, 1.5], rows[2:])
    sine, cosine = np.sin(np.radians(20)), np.cos(np.radians(20))
    normals = [[cosine, sine, 0], [-cosine, 0, -sine], [-(0.5**0.5), 0.5**0.5, 0], [0, 0, 1]]
    normals = np.repeat(normals, rows, axis=0)
    normals[:21:2, 1] *= -1.0
    places = np.repeat([[-8.0, 0, 0], [0, 0, 0], [-8, 16, 0], [0, 8, 0]], rows, axis=0)
    places += np.random.default_rng(0).uniform(0.0, 8.0, places.shape)
    found = agreement_of(slat, pixieverse, normals, places)
    # Of 0, 0.1 .. 2 the third is at 0.6; no direction counts with more than 4.
    near, middle = ([one, 0.0, 4.0] @ rows[:3] / 84 for one in (0.6, 1.0))
    directions = found.directions_near, found.directions_middle, found.directions_worst
    assert directions == pytest.approx((near, middle, 0.6))
    blocks = found.blocks_near, found.blocks_middle, found.blocks_far
    assert blocks == pytest.approx((21 / 95, 42 / 95, 53 / 95))
    assert found.within_slat == pytest.approx((27 / 42, 32 / 42, 37 / 42))
    assert found.within_pixieverse == pytest.approx((0.0, 0.0, 11 / 53))
    far = agreement_of(10 * slat, pixieverse, normals, places)
    assert far.directions_worst == 4.0


def test_normals_point_out_of_a_ball_however_it_is_turned():
    slat, pixie = surface_of(ball(15.0)), surface_of(ball(15.0, 38.5))
    turn = make_transform(Rotation.from_euler("xyz", [30, 70, -50], degrees=True).as_matrix())
    pose = Similarity(turn[:3, :3], -turn[:3, :3] @ [7.0, 0.0, 0.0], 1.0)
    residuals = Residuals(slat, pixie, pose, 300)
    residuals.at(Warp.unbent(pose))
    out = residuals.places / np.linalg.norm(residuals.places, axis=1, keepdims=True)
    assert (residuals.normals() * out).sum(axis=1).min() > 0.8
    other = Residuals(slat, pixie, pose, 300, first=300).places
    assert not {*map(tuple, other[:300])} & {*map(tuple, residuals.places[:300])}


def test_margin_and_ties_count_unless_ties_change_no_class_or_something_chose():
    tied = fitted(None, UPSIDE_DOWN)
    several = figures(tied, HARMLESS + 0.001)
    assert (several["margin"], several["alike"]) == (0.2, 0.0)
    assert several["ties"] == pytest.approx(math.log(2))
    settled = replace(tied, settled_by=records.Consensus(np.eye(3), 5, 5))
    for alignment, ambiguity in ((tied, HARMLESS), (tied, 0.0), (settled, 1.0)):
        one = figures(alignment, ambiguity)
        assert math.isnan(one["margin"]) and math.isnan(one["clear_by"])
        assert (one["ties"], one["alike"]) == (0.0, 1.0)
    # Without ties the margin says how far behind the next placement is, up to a limit.
    assert figures(fitted(), 0.0)["margin"] == 0.2
    assert figures(replace(fitted(), margin=0.5), 0.0)["margin"] == 0.3
    on_ground = replace(fitted(), ground=records.Ground(np.array([0.0, 0.0, 1.0]), -0.2))
    assert figures(on_ground, 0.0)["ground"] == 1.0


def test_shares_around_voxels_are_of_other_classes_and_of_all_that_is_annotated():
    tower = np.zeros((64, 64, 64), dtype=bool)
    tower[20:44, 20:44] = True
    field = field_of(tower, np.where(GRID[..., 2] < 32, 1, 3))
    latents = latents_of(np.array([[32, 32, 31], [32, 32, 29], [32, 32, 10], [32, 32, 1]]))
    annotation = annotated(np.array([1, 1, 1, 255]), latents.centres)
    around = surroundings_of(field, latents, fitted(), annotation, NO_TIES[:4])
    # Of 14 cells one and four lie above: 1, 2, 4, 7 voxels along the axis, 1, 1, 2, 4 diagonally.
    above = np.array([[5, 5, 5, 5], [0, 0, 1, 5], [0, 0, 0, 0]]) / 14
    np.testing.assert_allclose(around.others[:3], above, rtol=1e-6)
    np.testing.assert_allclose(around.others[3], 1.0)  # without a class all are others
    below = np.array([0, 1, 5, 5]) / 14  # that lie outside the grid
    np.testing.assert_allclose(around.solid[3], 1 - below, rtol=1e-6)
    np.testing.assert_allclose(around.depth, [0.5, 0.5, 0.5, 0.5 - 1 / 14], rtol=1e-6)
    assert not around.moved.any()


def test_how_far_a_deformation_moves_is_measured_in_the_frame_of_the_annotation():
    field, latents, annotation = column(5)
    pushed = records.Deformation(np.eye(3, 4), np.zeros(3), 1.0, np.zeros((0, 0, 0, 3)))
    alignment = replace(fitted(make_transform(np.eye(3), scale=0.5)), deformation=pushed)
    steps = np.linspace(0.0, 3.0, len(latents.coords))
    place = 2.0 * latents.centres + steps[:, None] * np.array([0.6, 0.0, 0.8]) / 64
    around = surroundings_of(
        field, latents, alignment, replace(annotation, place=place), NO_TIES[: len(place)]
    )
    np.testing.assert_allclose(around.moved, steps, atol=1e-4)


@pytest.mark.parametrize(("most", "ties", "share"), [
    (99, [UPSIDE_DOWN], 1 / 2),  # of the chosen one and one more
    (99, [UPSIDE_DOWN, UPSIDE_DOWN], 2 / 3),
    (99, [UPSIDE_DOWN, np.eye(4)], 1 / 3),
    (99, [UPSIDE_DOWN, FAR_OFF], 1 / 3),  # where nothing is annotated nothing contradicts
    # Of many voxels, here 40, some ties stand for all: every second one.
    (20, [UPSIDE_DOWN] * 3, 3 / 4),
    (20, [UPSIDE_DOWN, np.eye(4), np.eye(4)], (3 / 2) / 4),
    (20, [UPSIDE_DOWN, np.eye(4), UPSIDE_DOWN], 3 / 4),
])  # fmt: skip
def test_ties_count_by_how_many_of_them_change_the_class(most, ties, share, monkeypatch):
    monkeypatch.setattr("slatprep.judge.ambiguity.MOST_VOXELS", most)
    field, latents, annotation = column(5)
    # Turned upside down the five lower and the five upper of twenty layers change classes.
    changes = np.isin(latents.coords[:, 2], [*range(22, 27), *range(37, 42)])
    tied = tied_of(field, latents, fitted(None, *ties), annotation)
    np.testing.assert_allclose(tied, np.where(changes, share, 0.0), rtol=1e-6)
    # Once settled, the others together have what the choice's probability leaves.
    left = share * (len(ties) + 1) / len(ties)
    for probability, other in ((1.0, 0.0), (0.8, 0.2), (np.nan, 0.0)):
        by = records.Consensus(np.eye(3), 5, 5, probability=probability)
        settled = replace(fitted(None, *ties), settled_by=by)
        tied = tied_of(field, latents, settled, annotation)
        np.testing.assert_allclose(tied, np.where(changes, other * left, 0.0), atol=1e-7)


def test_ties_are_compared_without_the_deformation_that_they_lack():
    field, latents, annotation = column(5)
    pushed = records.Deformation(np.eye(3, 4), np.zeros(3), 1.0, np.zeros((0, 0, 0, 3)))
    ties = fitted(None, UPSIDE_DOWN)
    bent = replace(ties, deformation=pushed)
    away = replace(annotation, material=np.full_like(annotation.material, 2))
    np.testing.assert_array_equal(
        tied_of(field, latents, bent, away), tied_of(field, latents, ties, annotation)
    )


def test_ties_that_change_few_classes_count_as_one():
    # Of 40 voxels in 20 layers four change by a painted layer, by a half each.
    field, latents, annotation = column(2)
    tied = tied_of(field, latents, fitted(None, UPSIDE_DOWN), annotation)
    assert tied.mean() == pytest.approx(8 / 40 / 2)
    one = np.where(np.arange(40) == 0, 3, 1).astype(np.uint8)  # two voxels change: 2 / 40 / 2
    field = replace(field, material=one, properties=np.ones_like(field.properties))
    annotation = sample(field, latents.centres, SampleParameters())
    assert not tied_of(field, latents, fitted(None, UPSIDE_DOWN), annotation).any()


def test_rounding_beside_what_counts_as_the_same_decides_whether_labels_of_ties_hold():
    """The limit of log10 is 0.3, and 1e-5 of it may be rounded; that of a ratio of 0.3 is 0.06."""
    field, _, annotation = column(2)
    field = replace(field, properties=np.full_like(field.properties, 0.3))
    for off, holds in (
        ([7e-7, 7e-7, 1.4e-7], True),
        ([0, 0, 1.6e-7], False),
        ([8e-7, 0, 0], False),
    ):
        assert labels_hold(field, annotation, np.array(off), tied=True) is holds
        assert labels_hold(field, annotation, np.array(off))


def plain_field(values: np.ndarray) -> records.MaterialField:
    """Return a field without classes, of voxels (K, P) of properties that are not mapped."""
    voxels = np.argwhere(np.ones((64, 64, 64), dtype=bool))[: len(values)].astype(np.uint8)
    table = tuple(records.Property(f"p{k}", "1", False) for k in range(values.shape[1]))
    given = occupancy_of(voxels), voxels, np.zeros(len(values), np.uint8), values.astype(np.float32)
    return records.MaterialField(*given, table=table, classified=False)


def as_annotation(field: records.MaterialField, rows: np.ndarray) -> records.Annotation:
    """Return an annotation that shows rows of a field; -1 for none."""
    shown = np.where(rows[:, None] >= 0, field.properties[rows], np.nan).astype(np.float32)
    return annotated(np.where(rows >= 0, 0, 255), properties=shown)


@pytest.mark.parametrize(("properties", "parts"), [(1, 10), (2, 10), (3, 5), (4, 2.5)])
def test_labels_without_classes_are_the_nearest_tenths_or_coarser(properties, parts):
    # Eleven tenths to the power of 1, 2 and 3 are 11, 121 and 1331; six fifths are 216 at the
    # third, 1296 at the fourth; and the three steps of 0, 0.4 and 0.8 are 81.
    values = np.random.default_rng(0).random((3000, properties))
    values[:2] = [[0.0], [1.0]]
    field = plain_field(5.0 + 3.0 * values)
    cells, own = _labels_of(field, as_annotation(field, np.array([4, -1, 0, 77])))
    _, expected = np.unique(np.rint(values * parts), axis=0, return_inverse=True)
    pairs = set(zip(cells.tolist(), expected.reshape(-1).tolist(), strict=True))
    assert len(pairs) == len({label for label, _ in pairs}) == expected.max() + 1
    assert own.tolist() == [cells[4], 255, cells[0], cells[77]]


def test_labels_are_made_coarser_where_255_are_too_few():
    tenths = np.argwhere(np.ones((11,) * 3, dtype=bool)) / 10
    for count, labels in ((255, 255), (256, None)):
        values = np.concatenate([tenths[: count - 1], tenths[-1:]])
        # A property that is the same everywhere changes nothing.
        field = plain_field(np.column_stack([values, np.full(count, 4.0)]))
        cells, _ = _labels_of(field, as_annotation(field, np.array([0])))
        found = len(set(cells.tolist()))
        assert found == labels if labels else found < 255
        assert cells.max() < 255


def test_no_label_is_that_of_nothing_however_many_combinations_there_are():
    # Nine properties that are either 0 or 1 have 512 combinations, however coarse.
    field = plain_field(np.argwhere(np.ones((2,) * 9, dtype=bool)).astype(float))
    cells, own = _labels_of(field, as_annotation(field, np.arange(512)))
    np.testing.assert_array_equal(cells, np.minimum(np.arange(512), 254))
    np.testing.assert_array_equal(own, cells)


@pytest.mark.parametrize("value", [0.05, 0.45])
@pytest.mark.parametrize("beside", [-0.002, 0.002])
def test_labels_hold_where_no_value_is_as_near_to_a_border_as_rounding_may_move_it(value, beside):
    # Value and ends move by `off` each: value - low by two, and two more through the extent.
    field = plain_field(np.array([[0.0], [1.0], [value + beside]]))
    annotation = as_annotation(field, np.array([2]))
    assert labels_hold(field, annotation, np.array([0.00049]))
    assert not labels_hold(field, annotation, np.array([0.00051]))


def test_borders_of_coarser_labels_count_only_where_these_are_used():
    # 0.1 is a border of fifths, not of tenths.
    few = plain_field(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.1, 0.1, 0.1]]))
    off = np.full(3, 1e-4)
    assert labels_hold(few, as_annotation(few, np.array([2])), off)
    tenths = np.argwhere(np.ones((11,) * 3, dtype=bool)) / 10
    many = plain_field(tenths)
    assert not labels_hold(many, as_annotation(many, np.array([2])), off)
    # Borders of tenths count as well where fifths are used: of rounded values tenths might do.
    levels = np.array([0.0, 0.08, 0.2, 0.4, 0.6, 0.8, 1.0])  # 343 combinations, of fifths 216
    both = levels[np.argwhere(np.ones((7,) * 3, dtype=bool))]
    assert labels_hold(plain_field(both), as_annotation(plain_field(both), np.array([2])), off)
    both[-1] = 0.05
    assert not labels_hold(plain_field(both), as_annotation(plain_field(both), np.array([2])), off)


def ball(radius: float, at: float = 31.5) -> np.ndarray:
    solid: np.ndarray = ((GRID - [at, 31.5, 31.5]) ** 2).sum(axis=-1) < radius**2
    return solid


def test_an_engine_without_figures_has_a_larger_ball_s_offset():
    for larger in (1.0, -1.0):
        field, latents = field_of(ball(18.0 + larger)), surface_latents(ball(18.0))
        found = measure_figures(field, latents, fitted())
        # At the SLAT's surface the other one's is that much farther out.
        assert found.offset == pytest.approx(-larger, abs=0.1)
        assert min(found.score_slat, found.score_pixieverse, *found.within) > 0.9
        assert found.roughness < 0.3
    # No more than two voxels are taken for an offset.
    found = measure_figures(field_of(ball(21.0)), surface_latents(ball(18.0)), fitted())
    assert found.offset == -2.0
    assert found.within[0] > 0.4 and found.roughness == pytest.approx(1.0, abs=0.2)


def test_what_one_side_alone_has_counts_against_it_unless_it_is_ground():
    field, latents = field_of(ball(18.0) | (GRID[..., 2] < 8)), surface_latents(ball(18.0))
    ground = records.Ground(np.array([0.0, 0.0, 1.0]), -24 / 64)
    both, above = (measure_figures(field, latents, replace(fitted(), ground=g)).agreement
                   for g in (None, ground))  # fmt: skip
    assert min(both.within_slat[2], *above.within_pixieverse) > 0.9 > both.within_pixieverse[2]


def test_an_engine_without_figures_has_those_of_a_shifted_ball():
    """Archimedes: heights on a sphere are even; from each follows how far off the other one is."""
    field, latents = field_of(ball(18.0)), surface_latents(ball(18.0, 35.5))
    found = measure_figures(field, latents, fitted())
    height = np.linspace(-1.0, 1.0, 100_001)
    apart = np.abs(np.sqrt(18.0**2 + 4.0**2 - 2 * 18.0 * 4.0 * height) - 18.0)
    assert found.offset == pytest.approx(0.0, abs=0.25)
    # Voxels are no sphere: some heights have a few more samples than others.
    np.testing.assert_allclose(found.within, [(apart <= k).mean() for k in (1, 2, 3)], atol=0.1)
    assert found.roughness == pytest.approx(np.median(apart), abs=0.4)
    mean = (1.0 / (1.0 + apart**2)).mean()
    assert found.score_slat == pytest.approx(mean, abs=0.08)
    assert found.score_pixieverse == pytest.approx(mean, abs=0.08)
    assert found.score_similarity == 0.5 * (found.score_slat + found.score_pixieverse)
    there = make_transform(np.eye(3), [4 / 64, 0, 0])
    assert measure_figures(field, latents, fitted(there)).within[0] > 0.98


def test_figures_of_a_voxel_by_hand():
    others = np.array([[0.1, 0.2, 0.3, 0.4], [0.5, 0.6, 0.7, 0.8]], np.float32)
    solid = np.array([[0, 0.25, 0, 0], [0, 0.65, 0, 0]], np.float32)
    of_voxels = np.array([[7.0, 1.0], [0.5, 2.5], [0.0, 0.25]], np.float32)
    around = Surroundings(others, solid, *of_voxels)
    doubt, rough = -math.log(0.8 / 0.2), 0.2  # depths of -0.25 and 0.15 lie 0.2 about their mean
    by_hand = (others.tolist(), (5.0, 1.0), (0.25, 0.15), (0.5, 2.5))
    found = voxel_figures(around, 0.8).tolist()
    for values, shares, distance, depth, moved in zip(found, *by_hand, strict=True):
        row = dict(zip(VOXEL_FIGURES, values, strict=True))
        expected = {"distance": distance, "depth": depth, "moved": moved}
        expected |= {"asset_unsure": doubt, "asset_rough": rough}
        expected |= {"asset_distance": 3.0, "asset_moved": 1.5}
        for radius, share in zip((1, 2, 4, 7), shares, strict=True):
            expected |= {f"others_{radius}": share, f"others_{radius}_rough": share * rough}
            expected |= {f"others_{radius}_unsure": share * doubt}
        assert row == pytest.approx(expected, abs=1e-6)
    # A placement that ties with another class at a quarter of them takes a quarter away.
    free = replace(around, tied=np.zeros(2, np.float32))
    whole = class_confidence(free, 0.8, np.array([True, True]))
    less = class_confidence(around, 0.8, np.array([True, True]))
    np.testing.assert_allclose(less, whole * [1.0, 0.75], rtol=1e-6)


def test_voxels_without_a_counterpart_change_no_other_voxels_confidence():
    far = {name: values[:1] * 0 for name, values in vars(AROUND).items()}
    far |= {"distance": np.float32([40]), "moved": np.float32([9])}
    both = Surroundings(*(np.concatenate([v, far[name]]) for name, v in vars(AROUND).items()))
    valid = np.arange(len(both.distance)) < len(AROUND.distance)
    alone = class_confidence(AROUND, 0.8, np.ones(len(AROUND.distance), dtype=bool))
    assert class_confidence(both, 0.8, valid).tolist() == [*alone.tolist(), 0.0]
    assert class_confidence(both, 0.8, np.zeros_like(valid)).tolist() == [0.0] * len(valid)


@pytest.mark.parametrize("certain", [0.0, 1.0])
def test_a_probability_of_nought_or_one_leaves_finite_figures(certain):
    unsure = voxel_figures(AROUND, certain)[:, VOXEL_FIGURES.index("asset_unsure")]
    np.testing.assert_allclose(unsure, (1 - 2 * certain) * math.log(999), rtol=1e-4)

"""The steps of the search, on shapes whose placement is known."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support.deformed import occupancy
from support.residuals import mean_kernel, residuals
from support.shapes import GRID, chair, crate

from slatprep.align import search
from slatprep.align.consensus import degrees_between
from slatprep.align.finish import MOST_CONTESTED, finish, rank_of
from slatprep.align.pair import (
    DISTINCT,
    FINE,
    MOST_SURVIVORS,
    RANK_STANDING,
    SURVIVORS,
    TIE,
    Pair,
    Steps,
    far_apart,
)
from slatprep.align.pose import Pose, Similarity
from slatprep.align.starts import distinct_starts
from slatprep.align.surface import Surface, surface_of
from slatprep.parameters import AlignParameters
from slatprep.records import FitFigures

Array = NDArray[np.float64]


def ball(radius: float) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = ((GRID - 31.5) ** 2).sum(axis=-1) < radius**2
    return inside


Solid = NDArray[np.bool_] | None
UPRIGHT, DEFAULT = np.eye(3), AlignParameters()


def placed(scale: float, turn: Array = UPRIGHT, at: tuple[float, ...] = (0, 0, 0)) -> Solid:
    """Return a solid without any symmetry, scaled and turned about the cube's centre and moved."""
    return occupancy(lambda points: (points - np.array(at) / 64) @ turn / scale)


@cache
def chair_surface() -> Surface:
    return surface_of(chair())


def pair_of(slat: Solid = None, pixie: Solid = None, parameters: AlignParameters = DEFAULT) -> Pair:
    """Return a pair of two solids, each a chair where nothing else is given."""
    surfaces = (chair_surface() if solid is None else surface_of(solid) for solid in (slat, pixie))
    return Pair(*surfaces, parameters)


def moved_by(*shift: float, score: float = 0.0) -> Pose:
    return Pose(Similarity(np.eye(3), np.array(shift), 1.0), score=score)


def looked_up(pose: Pose, points: Array) -> Array:
    """Return where the points of the SLAT lie on the other side, by the inverse of a 4x4 matrix."""
    matrix = np.eye(4)
    rotation, shift, scale, _ = pose.similarity
    matrix[:3, :3], matrix[:3, 3] = scale * rotation, shift
    return (np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(matrix).T)[:, :3]


def rms(one: Array, two: Array) -> float:
    return float(np.sqrt(((one - two) ** 2).sum(axis=1).mean()))


def off(pair: Pair, pose: Pose, true: Pose) -> float:
    points = pair.slat.points
    return rms(looked_up(pose, points), looked_up(true, points))


def any_poses(seed: int, count: int) -> list[Pose]:
    rng = np.random.default_rng(seed)
    return [
        Pose(Similarity(turn, rng.normal(size=3, scale=6.0), float(rng.uniform(0.7, 1.4))))
        for turn in Rotation.random(count, random_state=seed).as_matrix()
    ]


@pytest.mark.parametrize("solid", ["a chair", "one voxel"])
def test_poses_are_apart_by_the_rms_distance_of_the_places_they_look_up(solid):
    dot = np.zeros((64, 64, 64), dtype=bool)
    dot[50, 20, 30] = True
    pair = pair_of(dot if solid == "one voxel" else None)
    *poses, other = any_poses(0, 8)
    expected = [off(pair, pose, other) for pose in poses]
    np.testing.assert_allclose(pair.apart(poses, other), expected, rtol=1e-9)


def test_stretched_poses_are_apart_by_the_rms_distance_of_their_places():
    pair = pair_of()
    poses = any_poses(1, 6)
    rng = np.random.default_rng(1)
    affines = np.eye(3, 4) + rng.normal(size=(6, 3, 4), scale=[0.1, 0.1, 0.1, 3.0])
    places = pair.places(poses, affines)
    points = pair.slat.points
    moved = (points @ affine[:, :3].T + affine[:, 3] for affine in affines)
    there = [looked_up(pose, one) for pose, one in zip(poses, moved, strict=True)]
    expected = [rms(one, two) for one in there for two in there]
    apart = np.linalg.norm(places[:, None] - places, axis=2).ravel()
    np.testing.assert_allclose(apart, expected, rtol=1e-9, atol=1e-5)


def test_a_repeated_placement_is_dropped_for_the_better_one():
    """What is dropped drops no other: the third lies near the second, and to none that is kept."""
    pair = pair_of(ball(12.0))
    scores = {0.0: 0.9, 1.2: 0.8, 2.4: 0.7}
    first, second, third = (moved_by(x, 0.0, 0.0, score=score) for x, score in scores.items())
    just = moved_by(0.0, DISTINCT, 0.0, score=0.6)
    within = moved_by(0.0, 0.0, DISTINCT - 0.01, score=0.5)
    assert pair.distinct([within, third, second, just, first]) == [first, third, just]


def test_of_others_the_score_does_not_matter_and_the_distance_does():
    pair = pair_of(ball(12.0))
    best = moved_by(0.0, 0.0, 0.0, score=0.5)
    better, near = moved_by(9.0, 0.0, 0.0, score=0.9), moved_by(1.0, 0.0, 0.0, score=0.8)
    again, just = moved_by(9.0, 1.0, 0.0, score=0.7), moved_by(0.0, -DISTINCT, 0.0, score=0.2)
    assert pair.others(best, [just, near, again, better, best]) == [better, just]
    assert pair.others(best, [near, best]) == []


def test_a_start_lays_centroid_on_centroid():
    aside = np.roll(ball(9.0), (12, -8, 5), axis=(0, 1, 2))
    pair = pair_of(np.roll(ball(12.0), (-6, 10, 3), axis=(0, 1, 2)), aside)
    rotations = Rotation.random(5, random_state=2).as_matrix()
    for rotation, pose in zip(rotations, pair.starts(rotations, 1.3), strict=True):
        np.testing.assert_array_equal(pose.similarity.rotation, rotation)
        assert pose.similarity.scale == 1.3
        np.testing.assert_allclose(looked_up(pose, np.array([[-6.0, 10, 3]])), [[12, -8, 5]])


def test_the_size_of_a_start_is_that_of_the_sides_within_its_bounds():
    def ratio(radius: float, parameters: AlignParameters) -> float:
        return pair_of(ball(radius), ball(16.0), parameters).size_ratio

    free = AlignParameters(scale_bounds=(0.7, 1.5))
    assert ratio(20.0, free) == pytest.approx(20 / 16, abs=0.02)
    assert ratio(28.0, free) == 1.5
    assert ratio(8.0, free) == 0.7
    assert ratio(20.0, AlignParameters(model="rigid")) == 1.0


def test_scale_is_refined_only_where_it_is_free():
    turn = Rotation.from_euler("x", 4, degrees=True).as_matrix()
    start = Pose(Similarity(turn, np.ones(3), 1.06))
    for model, free, held in (("auto", True, False), ("auto", False, True), ("rigid", True, True)):
        pair = pair_of(parameters=AlignParameters(model=model))
        (found,) = pair.refine([start], Steps(400, (4.0,) * 8, 1e-4, free))
        if held:
            assert found.similarity.scale == 1.06
            continue
        assert found.similarity.scale == pytest.approx(1.0, abs=0.01)
        assert off(pair, found, moved_by(0, 0, 0)) < 0.1
        assert found.score == pytest.approx(1.0, abs=0.02)
        assert found.fitness == 1.0


def test_the_score_is_the_mean_kernel_of_both_sides():
    pair = pair_of(placed(0.8), placed(0.7))
    poses = [Pose(p.similarity._replace(offset=0.2)) for p in any_poses(5, 4)]
    for pose, scored in zip(poses, pair.refine(poses, Steps(10**6, (), 0.01)), strict=True):
        forward, backward = residuals(pair.slat, pair.pixie, pose.similarity, np.eye(3, 4))
        expected = 0.5 * (mean_kernel(forward) + mean_kernel(backward))
        assert scored.score == pytest.approx(expected, rel=1e-5)
        within = np.abs(np.concatenate([forward, backward])) <= 1.0
        assert scored.fitness == pytest.approx(within.mean(), abs=1e-3)


def test_marks_of_a_pose_outlive_its_refinement():
    start = replace(moved_by(0.5, 0.0, 0.0), bonus=0.1, standing=0.01)
    (found,) = pair_of().refine([start], Steps(100, (2.0,), 0.01))
    assert (found.bonus, found.standing) == (0.1, 0.01)


def test_a_pose_beside_the_truth_is_brought_to_it():
    """Not only by as much as brings the next step below a voxel."""
    pair = pair_of()
    turn = Rotation.from_euler("xyz", [5, -4, 6], degrees=True).as_matrix()
    start = Pose(Similarity(turn, np.array([1.5, -1.0, 0.5]), 1.03), score=0.5)
    (polished,), ((finished,), deformed) = pair.polish([start]), finish(pair, [start], rough=False)
    assert deformed.deformation is None
    assert finished.similarity.scale == 1.0
    for found in (polished, finished):
        assert off(pair, found, moved_by(0, 0, 0)) < 0.02


def test_a_scale_that_is_not_one_is_kept_and_one_that_is_nearly_one_is_not():
    """Off the cube's centre, so that a scale of one means another shift."""
    aside = (8, -6, 8)
    solid, larger = placed(0.9, at=aside), placed(0.9 * 1.03, at=aside)
    start = Pose(Similarity(np.eye(3), -0.03 * np.array(aside), 1.03))
    (found,), deformed = finish(pair_of(larger, solid), [start], rough=False)
    assert found.similarity.scale == pytest.approx(1.03, abs=0.005)
    assert deformed.model == "similarity"
    (same,), deformed = finish(pair_of(solid, solid), [start], rough=False)
    assert same.similarity.scale == 1.0
    assert deformed.model == "rigid"
    np.testing.assert_allclose(same.similarity.shift, 0.0, atol=0.02)


def test_a_scale_is_taken_away_about_the_centroid_and_lowers_the_rank_once_deformed():
    pair, (pose, *_) = pair_of(), any_poses(3, 1)
    centroid = pair.slat.points.mean(axis=0)[None]
    same = looked_up(Pose(pair.at_scale_one(pose.similarity)), centroid)
    np.testing.assert_allclose(same, looked_up(pose, centroid))
    figures = FitFigures(0.9, 0.8, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)
    for log, less in ((0.0, 0.0), (0.25, 0.04), (-0.5, 0.16)):
        scaled = pose.similarity._replace(scale=np.exp(log))
        assert rank_of(scaled, figures) == pytest.approx(0.85 - less)


class _Watched(Pair):
    """A pair that notes how many poses each refinement was given, and their scales."""

    refined: list[int]
    scales: list[set[float]]

    def refine(self, poses: Sequence[Pose], *given: object, **named: object) -> list[Pose]:
        self.refined.append(len(poses))
        self.scales.append({pose.similarity.scale for pose in poses})
        return super().refine(poses, *given, **named)


def watched(pair: Pair) -> _Watched:
    seen = _Watched(pair.slat, pair.pixie, pair.parameters)
    seen.refined, seen.scales = [], []
    return seen


def scattered(scores: Array) -> list[Pose]:
    """Return poses with these scores, four voxels apart."""
    places = 4.0 * (np.argwhere(np.ones((4, 4, 4), dtype=bool)) - 1.5)
    return [moved_by(*place, score=s) for place, s in zip(places, scores, strict=False)]


@pytest.mark.parametrize(("scores", "survive"), [
    (np.linspace(0.9, 0.1, 12), SURVIVORS),
    ([0.9, 0.88, 0.87, 0.86, 0.85, 0.845, 0.83, 0.5], 6),
    (np.full(40, 0.9), MOST_SURVIVORS),
    ([0.9, 0.2], 2),
])  # fmt: skip
def test_what_is_polished_is_likely_or_among_the_first(scores, survive):
    """Six of the second are within twice `TIE` of its best one."""
    assert pytest.approx(0.03) == TIE
    pair = watched(pair_of())
    pair.polish(scattered(np.array(scores))[::-1])
    assert pair.refined == [survive]


@pytest.mark.parametrize("stray", [False, True])
def test_all_orientations_are_searched_and_a_stray_part_does_not_hide_the_placement(stray):
    """Sizes say another scale with it; half as many starts at scale one are made beside them."""
    turn = Rotation.from_euler("xyz", [40, 25, -70], degrees=True).as_matrix()
    other = placed(0.6)
    other[56:63, 56:63, 2:9] |= stray
    pair = watched(pair_of(placed(0.6, turn), other))
    refined, halfway = search.search_all(pair)
    supplement = [search.SO3_STARTS // 2] * stray
    assert pair.refined == [search.SO3_STARTS, *supplement, search.SO3_KEPT]
    assert (len(refined), len(halfway)) == (search.SO3_KEPT, search.SO3_STARTS)
    scores = [pose.score for pose in halfway]
    assert scores == sorted(scores, reverse=True)
    best = max(refined, key=lambda pose: pose.score)
    assert off(pair, best, Pose(Similarity(turn, np.zeros(3), 1.0))) < (1.0 if stray else 0.5)
    if stray:
        assert pair.size_ratio < 0.85
        assert pair.scales[:2] == [{pair.size_ratio}, {1.0}]
        # The supplement's scale was held, that of the poses by size was not.
        assert 1.0 not in {pose.similarity.scale for pose in halfway}


def test_deformed_places_are_apart_from_twice_the_usual_distance_on():
    """As a root mean square: half of the points may lie where they did."""
    points = np.random.default_rng(0).normal(size=(40, 3), scale=9.0)
    half = np.arange(40)[:, None] % 2
    far, near = [(-2 * DISTINCT, 0, 0), (1.6, 1.8, -1.9)], [(0, 2.9, 0), (-1.6, 1.6, 1.6)]
    for shift in (*far, *near):
        half_moved = points + 2**0.5 * half * shift
        for better in ([points + shift], [points + 99, points - shift], [half_moved]):
            every = list(range(len(better) + 1))
            assert far_apart([*better, points]) == (every if shift in far else every[:-1])
    assert far_apart([points, points, points + 99]) == [0, 2]


def upright(pose: Pose) -> float:
    return degrees_between(pose.similarity.rotation, np.eye(3))


@pytest.fixture(scope="module")
def squashed() -> tuple[Pair, list[Pose]]:
    """A crate and the same squashed, which as a similarity fits best if it lies on its side."""
    centres = GRID.reshape(-1, 3) - 31.5
    pair = pair_of(crate(centres / [1.1, 1.1, 0.7]), crate(centres))
    starts = pair.starts([start.rotation for start in distinct_starts()], 1.0)
    return pair, pair.distinct(pair.refine(starts, Steps(400, (8.0, 4.0, 2.0, 2.0, 2.0), 0.02)))


def test_where_shapes_differ_the_order_is_by_what_a_trial_deformation_leaves(squashed):
    pair, poses = squashed
    assert upright(poses[0]) > 60.0
    _, halfway = search.search_all(pair)
    found = search.ranked(pair, poses, halfway)
    assert upright(found[0]) < 10.0
    assert found[0].score < poses[0].score - 0.1
    ranks = [pose.rank for pose in found]
    assert ranks == sorted(ranks, reverse=True)
    # The one that fitted best as it was has a standing, and no other.
    (standing,) = (pose for pose in found if pose.standing)
    assert standing.standing == RANK_STANDING
    assert off(pair, standing, poses[0]) == 0.0
    # What was not tried keeps its score; it was no more than six, within a bound.
    least = poses[0].score - search.RANK_WITHIN
    near = [pose for pose in poses if pose.score > least][: search.MOST_RANKED]
    beyond = poses[len(near) :]
    assert {id(pose) for pose in found if pose.bonus == 0.0} <= set(map(id, beyond))
    for pose in beyond:
        assert pair.apart(found, pose).min() < DISTINCT


def test_what_is_far_below_the_best_fit_is_not_tried(squashed):
    pair, all_poses = squashed
    scores = (0.65, 0.56, 0.65 - search.RANK_WITHIN - 0.01)
    poses = [replace(p, score=s) for p, s in zip(all_poses[::2], scores, strict=False)]
    found = search.ranked(pair, poses, poses[:1])
    assert found[-1] is poses[2]
    assert all(pose.bonus > 0.0 for pose in found[:-1])


def test_what_fits_best_as_it_is_takes_part_if_stretching_finds_it_no_more(squashed):
    """Stretched, a neighbour of it fits better and stands for both."""
    pair, (best, *_) = squashed
    turns = Rotation.from_rotvec(0.04 * Rotation.random(20, random_state=6).as_rotvec()).as_matrix()
    own = best.similarity
    beside = [replace(best, similarity=own._replace(rotation=t @ own.rotation)) for t in turns]
    better = next(b for b in beside if search.stretched(pair, [best, b], [best]) == [b])
    assert any(off(pair, pose, best) == 0.0 for pose in search.ranked(pair, [best, better], [best]))


def test_of_contested_placements_the_one_that_fits_once_deformed_is_the_best(squashed):
    pair, poses = squashed
    chosen = [min(poses, key=upright), *poses[:2]]
    (best, *others), deformed = finish(pair, chosen, rough=True)
    assert deformed.deformation is not None
    assert deformed.pose is best.similarity
    assert upright(best) < 10.0
    fine = pair.refine(chosen, FINE._replace(size_by_slat=True))
    # It takes over the score that the best one had, and the others have less.
    assert best.merit == pytest.approx(max(pose.score for pose in fine), abs=0.02)
    assert others
    assert all(0.01 < best.merit - pose.merit < 0.2 for pose in others)
    assert {pose.standing for pose in [best, *others]} == {0.0}


def test_of_many_placements_none_is_lost_or_doubled_where_few_are_contested(squashed):
    pair, poses = squashed
    many = pair.distinct(pair.refine(poses, FINE._replace(size_by_slat=True)))
    assert len(many) > MOST_CONTESTED + 2
    found, _ = finish(pair, poses, rough=True)
    for pose in many[MOST_CONTESTED:]:
        assert sum(off(pair, one, pose) == 0.0 for one in found) == 1
    assert len(found) <= len(many)

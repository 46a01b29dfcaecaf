"""What a pass over a dataset settles: which placement is taken, and what is fitted there."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.deformed import MOVES, occupancy
from support.shapes import aligned, chair, field_of, latents_of, surface_latents, turned

from slatprep import records
from slatprep.align import align
from slatprep.align.consensus import (
    SURE,
    TEMPERATURE,
    degrees_between,
    find_consensus,
    is_common,
    probability_of_common,
    settle,
    turn_if_likelier,
)
from slatprep.align.quality import measure_quality
from slatprep.align.settle import refit, take
from slatprep.align.starts import distinct_starts
from slatprep.geometry.deformation import map_of
from slatprep.geometry.frames import (
    VOXEL_SIZE,
    apply_transform,
    displacement,
    make_transform,
    split_transform,
    voxel_centres,
)
from slatprep.parameters import AlignParameters

COMMON = distinct_starts()[14].rotation


def consensus_of(transforms: list[np.ndarray]) -> records.Consensus | None:
    """Return the consensus of assets of an object each."""
    return find_consensus(transforms, [str(k) for k in range(len(transforms))])


def _tilted(rotation: np.ndarray, seed: int) -> np.ndarray:
    tilt = Rotation.from_rotvec(np.random.default_rng(seed).normal(scale=0.05, size=3))
    return make_transform(tilt.as_matrix() @ rotation, [0.01, 0.0, 0.02], 0.7)


def test_the_common_rotation_is_found_among_others():
    transforms = [_tilted(COMMON, seed) for seed in range(12)]
    transforms += [_tilted(start.rotation, 50) for start in distinct_starts()[:8]]
    consensus = consensus_of(transforms)
    assert (consensus.winners, consensus.agreeing) == (20, 12)
    assert degrees_between(consensus.rotation, COMMON) < 3.0
    assert np.linalg.det(consensus.rotation) == pytest.approx(1.0)
    shuffled = [transforms[i] for i in np.random.default_rng(0).permutation(20)]
    assert consensus_of(shuffled).rotation.tobytes() == consensus.rotation.tobytes()


def test_just_enough_is_enough():
    """Five at least, and half of all at least; within 30 degrees of a quarter turn."""
    others = [make_transform(start.rotation) for start in distinct_starts()]
    others = [one for one in others if degrees_between(one[:3, :3], COMMON) > 1]
    five = [make_transform(COMMON)] * 5
    assert consensus_of([]) is consensus_of(five[:4]) is consensus_of(others) is None
    found = consensus_of(five + others[:5])
    assert (found.winners, found.agreeing) == (10, 5)
    assert consensus_of(five + others[:6]) is None
    for degrees, agreeing in ((29.9, 6), (30.1, 5)):
        turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
        turn = make_transform(turn @ COMMON, scale=0.7)
        found = consensus_of([*five, turn])
        assert found.agreeing == agreeing
        assert is_common(turn, _agreeing(5)) == (agreeing == 6)
    between = make_transform(Rotation.from_euler("x", 45, degrees=True).as_matrix())
    assert consensus_of([between] * 5) is None


def test_assets_of_one_object_count_once_for_each_way_they_are_turned():
    """Annotations of one grid have its frame, and so do views of one SLAT."""
    turns = [make_transform(COMMON)] * 40 + [make_transform(AWAY[0])] * 9
    objects = ["duck"] * 36 + ["cup", "bear", "bell", "vase"] + ["duck"] * 8 + ["cup"]
    found = find_consensus(turns, objects)
    assert (found.winners, found.agreeing, sorted(found.others)[-2:]) == (7, 5, [0, 2])
    assert find_consensus(turns[1:], ["duck", *objects[2:]]).agreeing == 5
    assert find_consensus(turns[:39], objects[:39]) is None
    # However many rows one object has, it has the same part in the mean.
    tilt = Rotation.from_euler("x", 12, degrees=True).as_matrix()
    tilted = [make_transform(tilt @ tilt @ COMMON), turns[0]] * 18 + turns[36:40]
    mean = find_consensus(tilted, objects[:40]).rotation
    assert degrees_between(mean, COMMON) == pytest.approx(12 / 5, abs=0.05)


def test_no_turn_and_half_a_turn_are_angles_too():
    # The trace of such a product may be rounded beyond 3, and beyond -1.
    for rotation in Rotation.random(200, random_state=1):
        turn = rotation.as_matrix()
        axis = rotation.apply([0.0, 0.0, 1.0])
        back = Rotation.from_rotvec(np.pi * axis).as_matrix() @ turn
        some = Rotation.from_rotvec(np.radians(33) * axis).as_matrix() @ turn
        assert degrees_between(turn, some) == pytest.approx(33)
        assert degrees_between(turn, turn) == pytest.approx(0.0, abs=1e-5)
        assert degrees_between(turn, back) == pytest.approx(180.0, abs=1e-5)


AWAY = [s.rotation for s in distinct_starts() if degrees_between(s.rotation, COMMON) > 1]


def _agreeing(count: int, others: int = 0) -> records.Consensus:
    return consensus_of([make_transform(turn) for turn in [COMMON] * count + AWAY[:others]])


@pytest.fixture(scope="module")
def boxed() -> tuple[records.MaterialField, records.StructuredLatents, records.Alignment]:
    """A box, which four placements fit, turned by the common rotation."""
    box = np.zeros((64, 64, 64), dtype=bool)
    box[12:52, 22:42, 27:37] = True
    field, latents = field_of(box), surface_latents(turned(box, COMMON))
    return field, latents, align(field, latents, AlignParameters())


def test_a_tie_goes_to_the_common_rotation_and_can_be_undone(boxed):
    _, latents, before = boxed
    after = settle(before, latents, _agreeing(6))
    assert displacement(after.transform, make_transform(COMMON), latents.centres) < 0.05
    choices = [before.transform, *(p.transform for p in before.placements)]
    others = [after.transform, *(p.transform for p in after.placements)]
    assert {c.tobytes() for c in choices} == {c.tobytes() for c in others}
    assert isinstance(after.settled_by, records.Consensus)
    assert 0.95 < after.settled_by.probability < 1.0, "six agree, of four that fit as well"
    if after.transform is not before.transform:
        np.testing.assert_array_equal(after.placements[0].transform, before.transform)


def test_whichever_placement_came_first_the_same_one_is_chosen(boxed):
    _, latents, found = boxed
    assert len(found.placements) == 3
    chosen = set()
    transforms = [found.transform, *(p.transform for p in found.placements)]
    for k in range(4):
        first, *rest = [transforms[k], *transforms[:k], *transforms[k + 1 :]]
        placements = (replace(p, transform=t) for p, t in zip(found.placements, rest, strict=True))
        other = replace(found, transform=first, placements=tuple(placements))
        chosen.add(settle(other, latents, _agreeing(6)).transform.tobytes())
    assert len(chosen) == 1


@pytest.mark.parametrize("gain", [-0.1, -0.02, 0.0, 0.03])
@pytest.mark.parametrize(("score", "sharper"), [(0.3, 1), (0.9, 2), (0.999, 10), (np.nan, 1)])
@pytest.mark.parametrize(("agree", "others"), [(5, 5), (19, 1), (400, 0)])
def test_odds_of_shapes_are_weighed_by_those_of_the_dataset(agree, others, score, sharper, gain):
    """By Bayes' rule: one more asset has any of the 23 other rotations, beside those counted."""
    consensus = _agreeing(agree, others)
    for number in (0, 22):
        present = aligned(make_transform(AWAY[number], scale=0.7), score=score)
        prior = np.array([agree, (number < others) + 1 / 23])
        joint = prior * np.exp(np.array([gain, 0.0]) / TEMPERATURE * sharper)
        expected = joint[0] / joint.sum()
        assert probability_of_common(consensus, gain, present) == pytest.approx(expected)


@pytest.mark.parametrize(("agree", "opposite", "taken"), [
    (6, 4, 0.6), (5, 4, 0.55), (6, 5, 0), (5, 5, 0), (40, 0, 1), (40, 2, 0.95),
])  # fmt: skip
def test_ties_of_a_dataset_of_two_frames_are_no_surer_than_its_counts(agree, opposite, taken):
    """Half a turn apart, both of a tie's placements are frames of the dataset."""
    half = np.diag([-1.0, -1.0, 1.0]) @ COMMON
    turns = [COMMON] * agree + [half] * opposite
    consensus = consensus_of([make_transform(turn) for turn in turns])
    tied = aligned(make_transform(COMMON), make_transform(half, scale=0.7), score=1.0)
    by = settle(tied, latents_of([[1, 2, 3]]), consensus).settled_by
    assert (0 if by is None else by.probability) == pytest.approx(taken, abs=0.01)


def test_a_tie_that_fits_clearly_better_otherwise_stays_open():
    half = np.diag([-1.0, -1.0, 1.0]) @ COMMON
    tied = aligned(make_transform(half), make_transform(COMMON), score=0.99)
    tied = replace(tied, placements=(replace(tied.placements[0], score=0.97),))
    assert settle(tied, latents_of([[1, 2, 3]]), _agreeing(40)) is tied
    # So does one that the common rotation is not among, even if others have one of it too.
    often = make_transform(Rotation.from_euler("z", 90, degrees=True).as_matrix() @ COMMON)
    tied, turns = aligned(often, make_transform(half)), [make_transform(COMMON)] * 6 + [often] * 4
    assert settle(tied, latents_of([[1, 2, 3]]), consensus_of(turns)) is tied


@pytest.mark.parametrize(
    ("turn", "agreeing"), [(distinct_starts()[3].rotation, 500), (COMMON, 5)], ids=["other", "same"]
)
def test_an_asset_that_is_clearly_turned_so_stays(turn, agreeing):
    """However many assets agree: the shapes say more than that."""
    assert (degrees_between(turn, COMMON) > 60) == (agreeing == 500)
    field, latents = field_of(chair()), surface_latents(turned(chair(), turn))
    found = align(field, latents, AlignParameters())
    assert turn_if_likelier(found, field, latents, _agreeing(agreeing), AlignParameters()) is found


def test_an_asset_that_fits_as_well_is_turned_as_the_dataset_is(boxed):
    """Of its four placements only a wrong one was found."""
    field, latents, found = boxed
    choices = [found.transform, *(p.transform for p in found.placements)]
    wrong = next(c for c in choices if degrees_between(split_transform(c)[0], COMMON) > 60)
    tie = records.Placement(ELSEWHERE, 0.5, 9.0)
    alone, given = replace(found, transform=wrong, placements=(tie,)), (field, latents)
    after = turn_if_likelier(alone, *given, _agreeing(19, 1), AlignParameters())
    assert displacement(after.transform, make_transform(COMMON), latents.centres) < 0.1
    assert isinstance(after.settled_by, records.Consensus)
    assert after.settled_by.probability > SURE
    left = [placement.transform.tobytes() for placement in after.placements]
    assert left == [wrong.tobytes(), ELSEWHERE.tobytes()]
    # Nor is it turned if the fit leaves the common rotation for the right one.
    beside = Rotation.from_euler("x", 35, degrees=True).as_matrix() @ COMMON
    consensus = records.Consensus(beside, 500, 500)
    assert turn_if_likelier(alone, *given, consensus, AlignParameters()) is alone
    other = replace(alone, engine=records.Engine.OPEN3D)
    assert turn_if_likelier(other, *given, _agreeing(19, 1), AlignParameters()) is other


BY = records.LatentChoice(0.99, 12.0, 300, 40, 40)
ELSEWHERE = make_transform(Rotation.from_euler("x", 180, degrees=True).as_matrix())


@pytest.mark.parametrize(("name", "asked", "model"), [
    ("bent", "auto", records.Model.DEFORMABLE),
    ("long", "auto", records.Model.AFFINE),
    ("same", "auto", records.Model.RIGID),
    ("bent", "rigid", records.Model.RIGID),
    ("bent", "similarity", records.Model.SIMILARITY),
])  # fmt: skip
def test_what_is_taken_is_fitted_as_aligning_would_fit_it(name, asked, model):
    move = MOVES.get(name, np.copy)
    field, latents = field_of(occupancy(np.copy)), surface_latents(occupancy(move))
    parameters = AlignParameters(model=asked, radius=1.5)
    found = align(field, latents, parameters)
    assert found.model is model
    # As if another placement had been taken for the best.
    right = records.Placement(found.transform, found.score, 20.0)
    other = replace(found, transform=ELSEWHERE, placements=(right,))
    taken = take(other, 0, latents, BY)
    undeformed = model in (records.Model.RIGID, records.Model.SIMILARITY)
    assert taken.deformation is taken.figures is None
    assert taken.model is (model if undeformed else records.Model.SIMILARITY)
    np.testing.assert_array_equal(taken.placements[0].transform, ELSEWHERE)
    assert taken.placements[0].displacement > 5
    settled = refit(taken, field, latents, parameters)
    assert (settled.model, settled.settled_by) == (model, BY)
    assert (settled.deformation is None) == undeformed
    apart = displacement(ELSEWHERE, settled.transform, latents.centres)
    assert settled.placements[0].displacement == pytest.approx(apart, rel=1e-9)
    for one in (found, settled):
        assert one.quality == measure_quality(field, latents, one.transform, 1.5)
    if asked == "auto":
        places = map_of(settled).places(latents.coords)
        off = np.linalg.norm(places - move(voxel_centres(latents.coords)), axis=1) / VOXEL_SIZE
        assert np.median(off) < 0.7
        # The search leaves the best placement slightly off where a new fit ends.
        apart = np.linalg.norm(places - map_of(found).places(latents.coords), axis=1) / VOXEL_SIZE
        assert apart.max() < 0.2
        assert settled.figures.score_slat == pytest.approx(found.figures.score_slat, abs=0.01)


def test_taking_a_placement_leaves_the_others_and_the_model_of_a_rigid_fit():
    latents = surface_latents(chair())
    found = align(field_of(chair()), latents, AlignParameters())
    turns = [np.diag(signs) for signs in ([1.0, -1, -1, 1], [-1.0, 1, -1, 1], [-1.0, -1, 1, 1])]
    placements = tuple(records.Placement(turn, 0.9 - 0.1 * k, 20.0) for k, turn in enumerate(turns))
    taken = take(replace(found, placements=placements), 1, latents, BY)
    np.testing.assert_array_equal(taken.transform, turns[1])
    assert (taken.model, taken.score) == (found.model, placements[1].score)
    assert np.isnan(taken.margin) and not np.isnan(found.margin)
    assert [one.score for one in taken.placements] == [found.score, 0.9, pytest.approx(0.7)]
    here = apply_transform(turns[1], latents.centres)  # a half turn is its own inverse
    others = (found.transform, turns[0], turns[2])
    for left, transform in zip(taken.placements, others, strict=True):
        np.testing.assert_array_equal(left.transform, transform)
        there = apply_transform(np.linalg.inv(transform), latents.centres)
        apart = np.linalg.norm(there - here, axis=1).mean() / VOXEL_SIZE
        assert left.displacement == pytest.approx(apart)

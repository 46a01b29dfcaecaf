"""The rotation that a dataset shares settles ties, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.shapes import chair, field_of, surface_latents, turned

from slatprep.align import align
from slatprep.align.consensus import (
    SURE,
    TEMPERATURE,
    degrees_between,
    find_consensus,
    probability_of_common,
    settle,
    turn_if_likelier,
)
from slatprep.align.starts import distinct_starts
from slatprep.geometry.frames import displacement, make_transform, split_transform
from slatprep.parameters import AlignParameters
from slatprep.records import Consensus

COMMON = distinct_starts()[14].rotation


def _tilted(rotation: np.ndarray, seed: int) -> np.ndarray:
    tilt = Rotation.from_rotvec(np.random.default_rng(seed).normal(scale=0.05, size=3))
    return make_transform(tilt.as_matrix() @ rotation, [0.01, 0.0, 0.02])


def test_the_common_rotation_is_found_among_others():
    transforms = [_tilted(COMMON, seed) for seed in range(12)]
    transforms += [_tilted(start.rotation, 50) for start in distinct_starts()[:8]]
    consensus = find_consensus(transforms)
    assert (consensus.winners, consensus.agreeing) == (20, 12)
    assert degrees_between(consensus.rotation, COMMON) < 3.0
    assert np.linalg.det(consensus.rotation) == pytest.approx(1.0)
    shuffled = [transforms[i] for i in np.random.default_rng(0).permutation(20)]
    again = find_consensus(shuffled)
    assert again.rotation.tobytes() == consensus.rotation.tobytes()


@pytest.mark.parametrize(
    "transforms",
    [
        [],
        [_tilted(COMMON, seed) for seed in range(4)],  # too few
        [_tilted(start.rotation, 1) for start in distinct_starts()],  # all different
    ],
)
def test_no_rotation_is_common_where_few_agree(transforms):
    assert find_consensus(transforms) is None


def test_just_enough_is_enough():
    """Five at least, and half of all at least; within 30 degrees of a quarter turn."""
    others = [make_transform(start.rotation) for start in distinct_starts()]
    others = [one for one in others if degrees_between(one[:3, :3], COMMON) > 1]
    five = [make_transform(COMMON)] * 5
    assert find_consensus(five[:4]) is None
    found = find_consensus(five + others[:5])
    assert (found.winners, found.agreeing) == (10, 5)
    assert find_consensus(five + others[:6]) is None
    for degrees, agreeing in ((29.9, 6), (30.1, 5)):
        turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
        found = find_consensus([*five, make_transform(turn @ COMMON)])
        assert found.agreeing == agreeing


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


def _agreeing(count: int, others: int = 0) -> Consensus:
    away = [s.rotation for s in distinct_starts() if degrees_between(s.rotation, COMMON) > 1]
    return find_consensus([make_transform(turn) for turn in [COMMON] * count + away[:others]])


def _box() -> np.ndarray:
    box = np.zeros((64, 64, 64), dtype=bool)
    box[12:52, 22:42, 27:37] = True
    return box


def test_a_tie_goes_to_the_common_rotation_and_can_be_undone():
    latents = surface_latents(turned(_box(), COMMON))
    before = align(field_of(_box()), latents, AlignParameters())
    after = settle(before, latents, _agreeing(6))
    assert displacement(after.transform, make_transform(COMMON), latents.centres) < 0.05
    choices = [before.transform, *(p.transform for p in before.placements)]
    others = [after.transform, *(p.transform for p in after.placements)]
    assert {c.tobytes() for c in choices} == {c.tobytes() for c in others}
    assert isinstance(after.settled_by, Consensus)
    assert 0.95 < after.settled_by.probability < 1.0, "six agree, of four that fit as well"
    if after.transform is not before.transform:
        np.testing.assert_array_equal(after.placements[0].transform, before.transform)


def test_whichever_placement_came_first_the_same_one_is_chosen():
    latents = surface_latents(turned(_box(), COMMON))
    found = align(field_of(_box()), latents, AlignParameters())
    assert len(found.placements) == 3
    chosen = set()
    transforms = [found.transform, *(p.transform for p in found.placements)]
    for first in range(4):
        order = [transforms[first], *transforms[:first], *transforms[first + 1 :]]
        other = replace(
            found,
            transform=order[0],
            placements=tuple(
                replace(p, transform=t) for p, t in zip(found.placements, order[1:], strict=True)
            ),
        )
        chosen.add(settle(other, latents, _agreeing(6)).transform.tobytes())
    assert len(chosen) == 1


def test_a_planted_rotation_raises_the_share_of_symmetric_assets_placed_right():
    rng = np.random.default_rng(3)
    right = {"before": 0, "after": 0}
    winners, ambiguous = [], []
    for number in range(16):
        if number % 2:
            solid = np.zeros((64, 64, 64), dtype=bool)
            a, b, c = rng.integers(8, 24, 3)
            solid[32 - a : 32 + a, 32 - b : 32 + b, 32 - c : 32 + c] = True
        else:
            solid = np.roll(chair(), rng.integers(-3, 4, 3), axis=(0, 1, 2))
        latents = surface_latents(turned(solid, COMMON))
        alignment = align(field_of(solid), latents, AlignParameters())
        (ambiguous if alignment.placements else winners).append((alignment, latents))
    consensus = find_consensus([alignment.transform for alignment, _ in winners])
    for alignment, latents in ambiguous:
        for when, settled in (
            ("before", alignment),
            ("after", settle(alignment, latents, consensus)),
        ):
            apart = displacement(settled.transform, make_transform(COMMON), latents.centres)
            right[when] += apart < 1.5
    assert len(ambiguous) == 8
    assert right["after"] == 8
    assert right["before"] < 8
    assert all(settle(a, latents, consensus) is a for a, latents in winners)


@pytest.mark.parametrize("gain", [-0.1, -0.02, 0.0, 0.03])
@pytest.mark.parametrize(("agree", "others"), [(5, 5), (19, 1), (400, 0)])
def test_the_odds_of_the_shapes_are_weighed_by_those_of_the_dataset(agree, others, gain):
    """By Bayes' rule, counted over a dataset of the common rotation and of 23 other ones."""
    seen = agree + others + 1
    prior = np.array([agree / seen] + [(others + 1) / seen / 23] * 23)
    likelihood = np.exp(np.array([gain, 0.0]) / TEMPERATURE)
    joint = prior[:2] * likelihood
    expected = joint[0] / joint.sum()
    assert probability_of_common(_agreeing(agree, others), gain) == pytest.approx(expected)


def test_an_asset_that_is_clearly_turned_otherwise_stays():
    """However many assets agree: the shapes say more than that."""
    turn = distinct_starts()[3].rotation
    assert degrees_between(turn, COMMON) > 60
    field, latents = field_of(chair()), surface_latents(turned(chair(), turn))
    found = align(field, latents, AlignParameters())
    assert turn_if_likelier(found, field, latents, _agreeing(500), AlignParameters()) is found


def test_an_asset_that_fits_as_well_is_turned_as_the_dataset_is():
    """A box has four placements; here only a wrong one was found."""
    field, latents = field_of(_box()), surface_latents(turned(_box(), COMMON))
    found = align(field, latents, AlignParameters())
    choices = [found.transform, *(p.transform for p in found.placements)]
    wrong = next(c for c in choices if degrees_between(split_transform(c)[0], COMMON) > 60)
    alone = replace(found, transform=wrong, placements=())
    after = turn_if_likelier(alone, field, latents, _agreeing(19, 1), AlignParameters())
    assert displacement(after.transform, make_transform(COMMON), latents.centres) < 0.1
    assert isinstance(after.settled_by, Consensus)
    assert after.settled_by.probability > SURE
    assert after.placements[0].transform.tobytes() == wrong.tobytes()


def test_an_asset_that_is_turned_as_the_dataset_is_keeps_its_placement():
    field, latents = field_of(chair()), surface_latents(turned(chair(), COMMON))
    found = align(field, latents, AlignParameters())
    assert turn_if_likelier(found, field, latents, _agreeing(5), AlignParameters()) is found

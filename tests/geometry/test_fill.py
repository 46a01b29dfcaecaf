"""What lies outside a voxel set, against scipy's labelling of connected regions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from slatprep.geometry.fill import outside_of


def _expected(occupancy: np.ndarray) -> np.ndarray:
    regions, _ = ndimage.label(~np.pad(occupancy, 1))
    return (regions == regions[0, 0, 0])[1:-1, 1:-1, 1:-1]


@given(
    shape=st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 64)),
    share=st.sampled_from([0.0, 0.3, 0.6, 0.7, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=100)
def test_any_set(shape, share, seed):
    occupancy = np.random.default_rng(seed).random(shape) < share
    np.testing.assert_array_equal(outside_of(occupancy), _expected(occupancy))


def test_a_flood_follows_a_winding_passage_back_and_forth():
    # Walls with gaps at alternating ends: the way in leads along every axis, both ways.
    occupancy = np.zeros((64, 64, 64), dtype=bool)
    occupancy[:, :, [0, 63]] = occupancy[:, [0, 63]] = occupancy[[0, 63]] = True
    occupancy[2:62:2] = True
    occupancy[2:62:4, 1, 1] = occupancy[4:62:4, 62, 62] = False
    assert not outside_of(occupancy).any()
    occupancy[0, 5, 5] = False
    np.testing.assert_array_equal(outside_of(occupancy), ~occupancy)


def test_longer_lines_than_a_word_are_refused():
    with pytest.raises(ValueError, match="at most 64"):
        outside_of(np.zeros((2, 2, 65), dtype=bool))

"""The signed distance, against scipy's exact Euclidean distance transform."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from slatprep.geometry.distance import LARGEST_SIDE, signed_distance


def _expected(solid: np.ndarray) -> np.ndarray:
    inside = ndimage.distance_transform_edt(solid)
    outside = ndimage.distance_transform_edt(~solid)
    return np.where(solid, 0.5 - inside, outside - 0.5)


@given(
    shape=st.tuples(*[st.integers(1, 12)] * 3),
    share=st.sampled_from([0.02, 0.3, 0.5, 0.97]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=60)
def test_any_set_gets_the_exact_distance(shape, share, seed):
    rng = np.random.default_rng(seed)
    solid = np.pad(rng.random(shape) < share, 4)
    solid[4, 4, 4] = True
    np.testing.assert_allclose(signed_distance(solid), _expected(solid), rtol=0, atol=1e-6)


def test_the_farthest_corners_of_the_largest_box_fit_the_integers():
    # The set touches all sides of its box and is as far from two corners as it can be.
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[0, 0, 0] = solid[63, 63, 63] = True
    padded = np.pad(solid, 4)
    assert padded.shape == (LARGEST_SIDE,) * 3
    np.testing.assert_allclose(signed_distance(padded), _expected(padded), rtol=0, atol=1e-5)


def test_memory_order_does_not_matter():
    solid = np.pad(np.random.default_rng(3).random((9, 7, 11)) < 0.4, 4)
    np.testing.assert_array_equal(signed_distance(np.asfortranarray(solid)), signed_distance(solid))


def test_too_large_a_box_is_refused():
    with pytest.raises(ValueError, match="at most 72"):
        signed_distance(np.zeros((73, 4, 4), dtype=bool))

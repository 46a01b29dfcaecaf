"""Look-ups at SLAT voxels whose answer is known by construction."""

from dataclasses import replace

import numpy as np
import pytest
from support.shapes import field_of

from slatprep.geometry.frames import make_transform, places_of, voxel_centres
from slatprep.geometry.voxels import occupancy_of
from slatprep.parameters import SampleParameters
from slatprep.records import PIXIEVERSE, PROPERTIES, UNANNOTATED, Annotation, MaterialField
from slatprep.sample import in_table, lacking, merge, sample

NEAREST = SampleParameters(method="nearest")


def test_values_come_from_the_nearest_voxel_and_end_at_the_limit():
    voxels = np.array([[10, 10, 10], [20, 10, 10]], dtype=np.uint8)
    values = np.array([[2e11, 7800, 0.3], [1e5, 1000, 0.45]], dtype=np.float32)
    field = MaterialField(occupancy_of(voxels), voxels, np.array([1, 4], np.uint8), values)
    coords = np.array([[10, 10, 10], [13, 10, 10], [14, 10, 10], [18, 11, 10]], dtype=np.uint8)
    for parameters in (NEAREST, SampleParameters()):
        found = sample(field, voxel_centres(coords), parameters)
        assert found.valid.tolist() == [True, True, False, True]
        assert found.material.tolist() == [1, 1, 255, 4]
        np.testing.assert_allclose(found.distance, [0, 3, 4, np.sqrt(5)], rtol=1e-6)
        np.testing.assert_array_equal(found.properties[[0, 3]], values)
        assert np.isnan(found.properties[2]).all()
        assert found.properties.dtype == found.distance.dtype == np.float32
    # The store has places as float32, and labels are those at these.
    between = np.array([[15.5 / 64 - 0.5 + 1e-12, 10.5 / 64 - 0.5, 10.5 / 64 - 0.5]])
    far = SampleParameters(method="nearest", max_distance=9.0)
    assert sample(field, between, far).material.tolist() == [1]


def test_a_vote_changes_the_class_and_takes_that_class_s_nearest_values():
    # A voxel of class 0 in a block of class 3, outvoted slightly off its centre.
    block = np.argwhere(np.ones((5, 5, 5), dtype=bool)).astype(np.uint8) + 30
    # The voxel to be taken comes first: row 0 is a row as any other.
    block = np.roll(block, -int(np.flatnonzero((block == [31, 32, 32]).all(axis=1))[0]), axis=0)
    classes = np.where((block == 32).all(axis=1), 0, 3).astype(np.uint8)
    properties = np.stack([np.arange(125) + 1.0] * 3, axis=1).astype(np.float32)
    field = MaterialField(occupancy_of(block), block, classes, properties)
    shift = make_transform(np.eye(3), np.array([0.3, 0, 0]) / 64)
    places = places_of(voxel_centres(np.array([[32, 32, 32]], np.uint8)), shift)  # (31.7, 32, 32)
    assert sample(field, places, NEAREST).material.tolist() == [0]
    voted = sample(field, places, SampleParameters())
    assert voted.material.tolist() == [3]
    np.testing.assert_array_equal(voted.properties[0], properties[0])
    np.testing.assert_allclose(voted.distance, [0.7], rtol=1e-5)


@pytest.mark.parametrize("method", ["nearest", "vote"])
def test_labels_alone_are_the_same_labels(method):
    rng = np.random.default_rng(3)
    voxels = np.unique(rng.integers(20, 40, (500, 3)), axis=0).astype(np.uint8)
    classes = rng.integers(0, 7, len(voxels)).astype(np.uint8)
    values = rng.random((len(voxels), 3), dtype=np.float32)
    field = MaterialField(occupancy_of(voxels), voxels, classes, values)
    places = rng.uniform(-0.6, 0.6, (4000, 3))
    parameters = SampleParameters(method=method, max_distance=2.3)
    whole = sample(field, places, parameters)
    alone = sample(field, places, parameters, labels_alone=True)
    for name in ("properties", "material", "valid", "place"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(whole, name))
    np.testing.assert_array_equal(alone.distance[alone.valid], whole.distance[alone.valid])
    assert np.isinf(alone.distance[~alone.valid]).all()


def _said(material: list[int], modulus: list[float], ratio: list[float]) -> Annotation:
    """Return what one annotation says of voxels; class 255 stands for one it does not reach."""
    classes = np.array(material, dtype=np.uint8)
    valid = classes != 255
    values = np.stack([modulus, np.full(len(classes), 1e3), ratio], axis=1).astype(np.float32)
    values[~valid] = np.nan
    likely = np.where(valid, 0.8, 0.0).astype(np.float32)
    nothing = np.zeros(len(classes), np.float32)
    return Annotation(values, classes, valid, nothing, np.zeros((len(classes), 3)), likely)


def test_annotations_merge_to_mean_spread_and_votes():
    """Five voxels: all agree; three differ; a tie of classes; one annotation reaches it; none."""
    nan = np.nan
    one = _said([0, 1, 4, 255, 255], [1e6, 1e5, 1e6, nan, nan], [0.3, 0.3, 0.2, nan, nan])
    two = _said([0, 1, 2, 255, 255], [1e6, 1e6, 1e6, nan, nan], [0.3, 0.3, 0.3, nan, nan])
    three = _said([0, 3, 255, 5, 255], [1e6, 1e7, nan, 2e9, nan], [0.3, 0.3, nan, 0.4, nan])
    made = merge([one, two, three], PROPERTIES)
    np.testing.assert_allclose(made.properties[:, 0], [1e6, 1e6, 1e6, 2e9, nan], rtol=1e-6)
    np.testing.assert_allclose(made.properties[:, 2], [0.3, 0.3, 0.25, 0.4, nan], rtol=1e-6)
    assert made.material.tolist() == [0, 1, 2, 5, UNANNOTATED]
    assert made.valid.tolist() == [True] * 4 + [False]
    np.testing.assert_allclose(made.spread[:3, 0], [0, np.std([5, 6, 7]), 0], rtol=1e-6)
    np.testing.assert_allclose(made.spread[:3, 2], [0, 0, 0.05], atol=1e-7)
    assert not made.spread[0].any()
    assert np.isnan(made.spread[3:]).all()
    np.testing.assert_allclose(made.votes, [1, 2 / 3, 1 / 2, 1, 0], rtol=1e-6)
    # Half where a property is off: 1e5 is a tenth of 1e6, and 0.3 is 0.05 off 0.25, just a fifth.
    likely = 0.8 * np.array([1, (0.5 + 1) / 3, 1 / 2, 1, 0])
    np.testing.assert_allclose(made.confidence, likely, rtol=1e-6)


def test_what_an_annotation_does_not_know_is_left_to_the_others():
    """Two know all, the third one property and no class; the last voxel it reaches alone."""
    one = _said([0, 1, 255], [1e6, 1e5, np.nan], [0.3, 0.3, np.nan])
    two = _said([0, 1, 255], [1e6, 1e7, np.nan], [0.3, 0.3, np.nan])
    three = _said([0, 0, 0], [1e9, 1e9, 1e9], [0.2, 0.2, 0.2])
    three.properties[:, 0] = three.properties[:, 2] = np.nan
    three.properties[:, 1] = 4e3
    three.material[:] = 255
    made = merge([one, two, three], PROPERTIES)
    assert made.valid.tolist() == [True, True, False]
    assert made.material.tolist() == [0, 1, 255]
    np.testing.assert_allclose(made.properties[:2, 0], [1e6, 1e6], rtol=1e-6)
    np.testing.assert_allclose(made.properties[:2, 1], 1e3 * 4 ** (1 / 3), rtol=1e-6)
    np.testing.assert_allclose(made.properties[:2, 2], 0.3, rtol=1e-6)
    np.testing.assert_allclose(made.spread[:2, 0], [0, 1], atol=1e-7)
    np.testing.assert_allclose(made.spread[:2, 1], np.std(np.log10([1, 1, 4])), rtol=1e-6)
    assert np.isnan(made.spread[2]).all()
    assert made.votes.tolist() == [1, 1, 0]
    # A density of 4e3 is 2.5 times the mean: half. Of the second voxel no modulus is near.
    np.testing.assert_allclose(made.confidence, 0.8 * np.array([2.5 / 3, 1.5 / 3, 0]), rtol=1e-6)


def test_a_voxel_with_a_class_and_without_one_of_the_properties_is_not_valid():
    made = merge([_said([2, 2], [1e6, np.nan], [0.3, 0.3])] * 2, PROPERTIES)
    assert made.valid.tolist() == [True, False]
    assert made.material.tolist() == [2, UNANNOTATED]
    assert np.isnan(made.properties[1]).all()
    assert np.isnan(made.spread[1]).all()


def test_near_is_a_factor_of_two_and_a_fifth_of_the_mean():
    """Poisson's ratio 0.2 and 0.3, mean 0.25, are off by a fifth; 0.199 and 0.301 by more."""
    likely = []
    for modulus, ratio in (
        ((1e6, 4e6), (0.3, 0.3)),  # each twice or half of 2e6
        ((1e6, 4.1e6), (0.3, 0.3)),
        ((1e6, 1e6), (0.2, 0.3)),
        ((1e6, 1e6), (0.199, 0.301)),
    ):
        said = [_said([1], [e], [nu]) for e, nu in zip(modulus, ratio, strict=True)]
        likely.append(float(merge(said, PROPERTIES).confidence[0]))
    np.testing.assert_allclose(likely, [0.8, 0.4, 0.8, 0.4], rtol=1e-6)


def test_columns_of_another_table_are_put_in_those_of_the_store():
    said = _said([1, 255], [1e6, np.nan], [0.3, np.nan])
    table = (PROPERTIES[2], PROPERTIES[0])
    said = replace(said, properties=said.properties[:, [2, 0]])
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[30, 30, 30] = True
    field = field_of(solid)
    field = replace(field, properties=field.properties[:, [2, 0]], table=table)
    density = PROPERTIES[1].name
    assert lacking(field, PIXIEVERSE) == (density,)
    made = in_table(said, field, PIXIEVERSE)
    np.testing.assert_allclose(made.properties[0], [1e6, np.nan, 0.3], rtol=1e-6)
    assert made.material.tolist() == [1, UNANNOTATED]
    unclassified = replace(field, classified=False, material=np.zeros_like(field.material))
    assert lacking(unclassified, PIXIEVERSE) == (density, "classes")
    assert lacking(unclassified, replace(PIXIEVERSE, classes=())) == (density,)
    assert in_table(said, unclassified, PIXIEVERSE).material.tolist() == [UNANNOTATED] * 2

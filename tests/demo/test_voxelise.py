"""Voxelisation against shapes whose answer is known voxel by voxel."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from slatprep.demo.voxelise import voxelise
from slatprep.geometry.frames import voxel_centres

ALL = np.argwhere(np.ones((64, 64, 64), dtype=bool))
CENTRES = voxel_centres(ALL)
HALF = 0.5 / 64

unit = st.floats(-1.0, 1.0)
directions = st.tuples(unit, unit, unit).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=10)
@given(normal=directions, offset=st.floats(-0.6, 0.6))
def test_plane_meets_the_cubes_whose_corners_it_parts(normal, offset):
    n = np.array(normal) / np.linalg.norm(normal)
    surface, filled = voxelise(lambda p: p @ n - offset)
    # A cube's corners reach |n| . h to either side of its centre.
    at_centre = CENTRES @ n - offset
    reach = HALF * np.abs(n).sum()
    margin = 1e-9
    surely = (np.abs(at_centre) < reach - margin).reshape(surface.shape)
    perhaps = (np.abs(at_centre) <= reach + margin).reshape(surface.shape)
    assert not np.any(surely & ~surface)
    assert not np.any(surface & ~perhaps)
    assert np.array_equal(filled, surface | (at_centre <= 0).reshape(surface.shape))


@settings(max_examples=10)
@given(centre=st.tuples(*[st.floats(-0.2, 0.2)] * 3), radius=st.floats(0.03, 0.3))
@example(centre=(0.0, 0.0, 0.1640625), radius=0.0625)
def test_sphere_meets_the_cubes_between_nearest_and_farthest_point(centre, radius):
    surface, filled = voxelise(lambda p: np.linalg.norm(p - centre, axis=1) - radius)
    away = np.abs(CENTRES - centre)
    nearest = np.linalg.norm(np.maximum(away - HALF, 0.0), axis=1)
    farthest = np.linalg.norm(away + HALF, axis=1)
    met = ((nearest <= radius) & (farthest >= radius)).reshape(surface.shape)
    assert not np.any(surface & ~met)
    # What is missed, the sphere enters by less than a tenth of a voxel.
    depth = np.minimum(radius - nearest, farthest - radius).reshape(surface.shape)
    missed = met & ~surface
    assert np.all(depth[missed] < HALF / 5)
    # On an axis of the grid it misses with a cube the seven that mirrors make of it, too.
    images = 8 if sum(c == 0 for c in centre) >= 2 else 2
    assert missed.sum() <= 0.01 * met.sum() + images
    solid = (nearest <= radius).reshape(surface.shape)
    assert not np.any(filled & ~solid)
    assert np.array_equal(filled ^ solid, missed & solid & ~filled)


def test_thin_sheet_has_no_holes():
    # A slab a third of a voxel thick, between two layers of centres.
    surface, _ = voxelise(lambda p: np.abs(p[:, 2]) - HALF / 3)
    assert surface[:, :, 31].all()
    assert surface[:, :, 32].all()
    assert surface.sum() == 2 * 64 * 64


@pytest.mark.parametrize(("value", "count"), [(1.0, 0), (-1.0, 64**3)])
def test_empty_and_full_cube(value, count):
    surface, filled = voxelise(lambda p: np.full(len(p), value))
    assert not surface.any()
    assert filled.sum() == count

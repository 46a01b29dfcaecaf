"""Objects on a slab of ground that the SLAT does not have, under maps known by construction."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from support.shapes import GRID, chair, field_of, judged, surface_latents

from slatprep.align import align
from slatprep.align import field as engine
from slatprep.align.ground import find_layers
from slatprep.align.quality import measure_quality
from slatprep.align.settle import refit, take
from slatprep.align.surface import surface_of
from slatprep.geometry.frames import displacement, make_transform
from slatprep.geometry.voxels import above
from slatprep.parameters import AlignParameters
from slatprep.records import Ground, LatentChoice, Placement, Verdict

DEFAULT = AlignParameters()
HEIGHTS = GRID[..., 2].astype(float)
FOOT = 20
"""The lowest voxels of the chair."""


def larger(solid: np.ndarray, scale: float) -> np.ndarray:
    """Return a solid scaled about the cube's centre."""
    at = (np.moveaxis(GRID, -1, 0) - 31.5) / scale + 31.5
    return map_coordinates(solid.astype(float), at, order=1) > 0.5


def slab(thickness: float, degrees: float = 0.0, radius: float = np.inf) -> np.ndarray:
    """Return a slab whose top touches the chair's foot in its middle, tilted about x."""
    normal = Rotation.from_euler("x", degrees, degrees=True).apply([0.0, 0.0, 1.0])
    apart = GRID - [29.0, 30.0, FOOT - 0.5]
    heights = apart @ normal
    away = np.linalg.norm(apart - heights[..., None] * normal, axis=-1)
    return (heights < 0) & (heights > -thickness) & (away < radius)


@pytest.mark.parametrize(
    ("thickness", "degrees", "radius", "scale"),
    [(1.0, 0.0, np.inf, 1.0), (3.0, 0.0, np.inf, 1.35), (3.0, 10.0, np.inf, 1.2), (4, 0, 26, 1.35)],
)
def test_an_object_on_ground_is_placed_as_without(thickness, degrees, radius, scale):
    latents = surface_latents(larger(chair(), scale))
    field = field_of(chair() | slab(thickness, degrees, radius))
    found = align(field, latents, DEFAULT)
    true = make_transform(np.eye(3), scale=scale)
    assert displacement(found.transform, true, latents.centres) < 1.5
    normal = Rotation.from_euler("x", degrees, degrees=True).apply([0.0, 0.0, 1.0])
    assert np.degrees(np.arccos(found.ground.normal @ normal)) < 1.5
    assert judged(field, latents, found).verdict is Verdict.GOOD


def test_the_top_of_a_slab_is_found():
    ground = find_layers(surface_of(chair() | slab(3.0)))[0]
    np.testing.assert_allclose(ground.normal, [0, 0, 1], atol=0.01)
    # The slab's highest voxels have the index FOOT - 1; centres are half a voxel off.
    assert ground.height * 64 + 31.5 == pytest.approx(FOOT - 0.5, abs=0.75)


def board() -> np.ndarray:
    """A board on wheels with a tail: nearly all of it is one flat layer above the ground."""
    x, y, z = np.moveaxis(GRID, -1, 0)
    deck = (x >= 10) & (x < 54) & (y >= 25) & (y < 38) & (z >= FOOT + 5) & (z < FOOT + 8)
    tail = (x >= 50) & (x < 58) & (y >= 26) & (y < 37) & (z >= FOOT + 7) & (z < FOOT + 10)
    wheels = (abs(abs(y - 31.5) - 5) < 2) & ((abs(x - 18) < 3) | (abs(x - 44) < 3))
    return deck | tail | (wheels & (z >= FOOT) & (z < FOOT + 6))


@pytest.mark.parametrize("radius", [np.inf, 30.0])
def test_the_lid_of_a_low_object_is_not_taken_for_its_ground(radius):
    """More voxels go away at the lid than at the slab's top, but nothing lies above it."""
    latents = surface_latents(larger(board(), 1.1))
    field = field_of(board() | slab(2.0, radius=radius))
    found = align(field, latents, DEFAULT)
    assert found.ground.height * 64 + 31.5 == pytest.approx(FOOT - 0.5, abs=2.5)
    true = make_transform(np.eye(3), scale=1.1)
    assert displacement(found.transform, true, latents.centres) < 1.5


@pytest.mark.parametrize(
    ("thick", "sunk", "below", "radius", "within"),
    [(3, 1, 1, np.inf, 0.5), (3, 2, 1, 25, 1.5), (4, 2, 2, np.inf, 1.2), (6, 2, 2, np.inf, 1.5)],
)
def test_a_rug_that_lies_in_the_ground_is_placed(thick, sunk, below, radius, within):
    """What is cut off with the ground is drawn down again, or the rug would be half as thick."""
    x, y, z = np.moveaxis(GRID, -1, 0)
    rug = (abs(x - 31.5) < 16) & (abs(y - 31.5) < 11) & (z >= FOOT) & (z < FOOT + thick)
    rug |= (abs(x - 22) < 5) & (abs(y - 36) < 4) & (z >= FOOT) & (z < FOOT + thick + 3)
    ground = (z >= FOOT - below) & (z < FOOT + sunk) & (np.hypot(x - 31.5, y - 31.5) < radius)
    latents = surface_latents(larger(rug, 1.3))
    found = align(field_of(rug | ground), latents, DEFAULT)
    true = make_transform(np.eye(3), scale=1.3)
    assert displacement(found.transform, true, latents.centres) < within


def test_a_flat_part_that_both_sides_have_is_no_ground():
    """Where the SLAT shows the layer too, it is the object's, however badly the rest fits."""
    solid = chair() | slab(3.0)
    latents = surface_latents(solid)
    blobs = np.zeros_like(solid)
    for centre in np.random.default_rng(3).integers([4, 4, FOOT + 4], 60, (60, 3)):
        blobs |= ((GRID - centre) ** 2).sum(axis=-1) < 16
    found = align(field_of(solid | blobs), latents, DEFAULT)
    assert found.score < engine.POOR
    assert find_layers(surface_of(solid | blobs))
    assert found.ground is None
    assert displacement(found.transform, np.eye(4), latents.centres) < 2.0


def test_where_the_sides_fit_no_ground_is_looked_for(monkeypatch):
    def looked(_: object) -> None:
        raise AssertionError("looked for ground")

    monkeypatch.setattr(engine, "find_layers", looked)
    found = align(field_of(chair()), surface_latents(chair()), DEFAULT)
    assert found.ground is None


def test_a_ball_a_slab_alone_and_a_few_voxels_have_no_ground():
    ball = ((GRID - 31.5) ** 2).sum(axis=-1) < 400
    few = [(GRID >= [10, 20, 30]) & ([11, 21, 30 + count] > GRID) for count in (1, 2, 5)]
    for solid in (ball, slab(3.0), *(one.all(axis=-1) for one in few)):
        assert not find_layers(surface_of(solid))


def test_quality_does_not_count_the_ground():
    field, latents = field_of(chair() | slab(3.0)), surface_latents(chair())
    found = align(field, latents, DEFAULT)
    assert found.quality.fitness > 0.9
    assert found.quality == measure_quality(field, latents, found.transform, 1.0, found.ground)
    assert measure_quality(field, latents, found.transform, 1.0).fitness < 0.5


def test_a_hollow_object_stays_closed_without_its_ground():
    bell = np.zeros((64, 64, 64), dtype=bool)
    bell[20:40, 20:40, 20:44] = True
    solid = bell.copy()
    bell[23:37, 23:37, 20:41] = False
    ground = Ground(np.array([0.0, 0.0, 1.0]), (FOOT - 0.5 - 31.5) / 64)
    # It goes on for the layer whose centres are less than a voxel and a half below the top.
    solid[20:40, 20:40, 19] = True
    np.testing.assert_array_equal(above(bell | slab(3.0), ground), solid)
    np.testing.assert_array_equal(above(bell, None), bell)


def test_a_placement_that_is_taken_is_fitted_without_the_ground():
    field, latents = field_of(chair() | slab(3.0)), surface_latents(larger(chair(), 1.2))
    found = align(field, latents, DEFAULT)
    elsewhere = make_transform(Rotation.from_euler("x", 180, degrees=True).as_matrix())
    other = replace(
        found, transform=elsewhere, placements=(Placement(found.transform, found.score, 20.0),)
    )
    settled = refit(
        take(other, 0, latents, LatentChoice(0.99, 12.0, 300, 40, 40)), field, latents, DEFAULT
    )
    assert settled.ground is found.ground
    assert displacement(settled.transform, found.transform, latents.centres) < 0.2
    assert settled.quality.fitness == pytest.approx(found.quality.fitness, abs=0.01)

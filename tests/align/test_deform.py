"""A deformation is found where there is one, and none where there is none."""

from itertools import product

import numpy as np
import pytest
from support.deformed import Move, bend, occupancy, stretch
from support.shapes import chair, field_of, latents_of, surface_latents

from slatprep.align import align
from slatprep.align.pose import Similarity
from slatprep.align.warp import Warp, from_nearest, halved, places_of
from slatprep.geometry.deformation import is_proper, map_of
from slatprep.geometry.frames import voxel_centres
from slatprep.geometry.voxels import boundary, voxels_of
from slatprep.parameters import AlignParameters
from slatprep.records import Alignment, MaterialField, StructuredLatents

DEFAULT = AlignParameters()


def pair(move: Move) -> tuple[MaterialField, StructuredLatents]:
    """Return the solid, and the boundary of the moved one: voxel x lies at `move(x)`."""
    field = field_of(occupancy(lambda points: points))
    return field, latents_of(voxels_of(boundary(occupancy(move))))


def mistakes(alignment: Alignment, latents: StructuredLatents, move: Move) -> np.ndarray:
    """Return how far, in voxels, each SLAT voxel is looked up from where it lies."""
    places = map_of(alignment).places(latents.coords)
    return np.asarray(
        np.linalg.norm(places - move(voxel_centres(latents.coords)), axis=1) * 64, dtype=np.float64
    )


def test_a_known_bend_is_found():
    field, latents = pair(bend)
    before = align(field, latents, AlignParameters(model="similarity"))
    after = align(field, latents, DEFAULT)
    assert after.model == "deformable"
    assert is_proper(after.deformation)
    assert before.deformation is None
    assert mistakes(before, latents, bend).mean() > 1.2
    assert mistakes(after, latents, bend).mean() < 0.75
    assert after.figures.evidence_affine + after.figures.evidence_deformable > 0.05
    assert after.figures.score_slat > after.figures.score_similarity + 0.1
    assert after.figures.moved_most > after.figures.moved > 0.5
    assert after.figures.bending > 0


def test_a_known_stretch_is_found_as_an_affine_map():
    field, latents = pair(stretch)
    alignment = align(field, latents, DEFAULT)
    assert alignment.model in ("affine", "deformable")
    assert mistakes(alignment, latents, stretch).mean() < 0.4
    affine = align(field, latents, AlignParameters(model="affine"))
    assert affine.model == "affine"
    assert affine.deformation.coefficients.size == 0
    assert mistakes(affine, latents, stretch).mean() < 0.3
    low, high = affine.figures.stretch
    # The similarity has taken the mean scale already.
    assert high / low == pytest.approx(1.15 / 0.95, abs=0.05)


@pytest.mark.parametrize("factors", [(1.45, 0.8, 1.2), (1.5, 0.75, 0.9)])
def test_proportions_that_no_similarity_finds_are_bounded_from_the_nearest_one(factors):
    # The search comes to a scale and heading from which the affine map is beyond the bounds.
    field, latents = pair(lambda points: points / factors)
    alignment = align(field, latents, DEFAULT)
    assert mistakes(alignment, latents, lambda points: points / factors).mean() < 0.8
    stretches = np.linalg.svd(alignment.deformation.affine[:, :3], compute_uv=False)
    assert 0.6 <= stretches[-1] <= stretches[0] <= 1.6


@pytest.mark.parametrize("bounds", [(0.6, 1.6), (1.0, 1.0)])
def test_a_warp_from_the_nearest_similarity_is_the_same_map(bounds):
    rng = np.random.default_rng(4)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = Similarity(turn * np.linalg.det(turn), rng.normal(size=3), 1.2, 0.1)
    affine = np.eye(3, 4) + rng.normal(scale=0.1, size=(3, 4))
    warp = Warp(affine, 0.0, np.full(3, -32.0), 32.0, rng.normal(size=(5, 5, 5, 3)))
    points = rng.uniform(-30, 30, (500, 3))
    nearest, rest = from_nearest(pose, warp, points, bounds)
    assert places_of(nearest, rest, points) == pytest.approx(places_of(pose, warp, points))
    assert nearest.rotation @ nearest.rotation.T == pytest.approx(np.eye(3))
    assert bounds[0] <= nearest.scale <= bounds[1]
    # Centroid on centroid, no turn and, within the bounds, no growth are left.
    moved = rest.moved(points) - points.mean(axis=0)
    there = points - points.mean(axis=0)
    assert moved.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-9)
    assert moved.T @ there == pytest.approx((moved.T @ there).T)
    if bounds[0] < 1.0:
        assert (moved * there).sum() == pytest.approx((there**2).sum())


def test_the_same_shape_is_not_deformed_and_keeps_the_bytes_of_a_rigid_fit():
    solid = chair()
    tilted = np.roll(solid, (2, -1, 3), axis=(0, 1, 2))
    field, latents = field_of(solid), surface_latents(tilted)
    alignment = align(field, latents, DEFAULT)
    assert alignment.model == "rigid"
    assert alignment.deformation is None
    assert alignment.figures.moved == alignment.figures.bending == 0.0
    assert np.isnan(alignment.figures.evidence_affine)  # too good to try
    again = align(field, latents, DEFAULT)
    assert alignment.transform.tobytes() == again.transform.tobytes()
    places = map_of(alignment).places(latents.coords)
    assert places.tobytes() == map_of(again).places(latents.coords).tobytes()


def test_a_tie_is_one_only_if_both_fit_once_deformed():
    # A bar with a small fin near one end, and the same bar bent: end for end the bend hides
    # the fin from every similarity, but none the fin from what is bent back.
    def bar(points: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(points, -1, 0)
        body = (abs(x) < 22) & (abs(y) < 6) & (abs(z) < 8)
        return body | ((abs(x - 14) < 3) & (abs(y) < 2) & (z >= 8) & (z < 11))

    points = np.moveaxis(np.indices((64,) * 3), 0, -1) - 31.5
    bent = points + 4.0 * np.cos(points[..., :1] / 7.0) * [0.0, 0.0, 1.0]
    field, latents = field_of(bar(points)), latents_of(voxels_of(boundary(bar(bent))))
    alignment = align(field, latents, DEFAULT)
    assert alignment.transform[0, 0] > 0.9
    assert alignment.model == "deformable"
    assert alignment.placements == ()
    assert len(align(field, latents, AlignParameters(model="similarity")).placements) > 0


def test_roughness_is_no_reason_to_deform():
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    solid = occupancy(lambda points: points)
    outside, inside = distance_transform_edt(~solid), distance_transform_edt(solid)
    noise = gaussian_filter(np.random.default_rng(5).normal(size=solid.shape), 1.5)
    rough = outside - inside < 0.7 + noise / noise.std()
    latents = surface_latents(solid)
    alignment = align(field_of(rough), latents, DEFAULT)
    assert alignment.model in ("rigid", "similarity")
    assert mistakes(alignment, latents, lambda points: points).mean() < 0.6
    figures = alignment.figures
    assert figures.evidence_affine + figures.evidence_deformable < 0.05
    assert figures.offset < 0  # it is thicker


def test_what_only_the_field_has_does_not_make_the_object_smaller():
    """Rough thick fields with blobs afloat, of an object that the SLAT shows 8 % larger."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    solid = occupancy(lambda points: points)
    latents = latents_of(voxels_of(boundary(occupancy(lambda points: points / 1.08))))
    signed = distance_transform_edt(~solid) - distance_transform_edt(solid)
    voxels = np.argwhere(np.ones_like(solid)) - 31.5
    scales, off = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        noise = gaussian_filter(rng.normal(size=solid.shape), 1.5)
        rough = signed < 1.0 + 0.6 * noise / noise.std()
        for centre in rng.uniform(-30, 30, (30, 3)):
            rough |= (((voxels - centre) ** 2).sum(axis=1) < 6).reshape(solid.shape)
        alignment = align(field_of(rough), latents, AlignParameters(model="similarity"))
        scales.append(np.cbrt(np.linalg.det(alignment.transform[:3, :3])))
        off.append(mistakes(alignment, latents, lambda points: points / 1.08).mean())
    assert np.mean(scales) == pytest.approx(1.08, abs=0.01)
    assert np.mean(off) < 0.3


def test_a_model_that_is_asked_for_is_fitted_and_the_bound_holds():
    field, latents = pair(bend)
    for model in ("rigid", "similarity"):
        plain = align(field, latents, AlignParameters(model=model))
        assert plain.model == model
        assert plain.deformation is None
    free = align(field, latents, AlignParameters(model="deformable"))
    affine, bending = free.deformation.affine, free.deformation.coefficients
    low, high = latents.coords.min(axis=0) / 64 - 0.5, (latents.coords.max(axis=0) + 1) / 64 - 0.5
    corners = np.array(list(product(*np.stack([low, high], axis=1))))
    by_affine = np.linalg.norm(corners @ affine[:, :3].T + affine[:, 3] - corners, axis=1)
    by_bending = np.linalg.norm(bending, axis=-1)
    farthest = max(by_affine.max(), by_bending.max()) * 64
    for limit in (farthest + 1.0, 0.5):
        parameters = AlignParameters(model="deformable", max_displacement=limit)
        bounded = align(field, latents, parameters)
        if bounded.deformation is None:  # its affine part alone moves too far
            assert bounded.model in ("rigid", "similarity")
            assert limit == 0.5
        else:
            assert np.linalg.norm(bounded.deformation.coefficients, axis=-1).max() * 64 <= limit
        if limit > farthest:
            np.testing.assert_array_equal(bounded.deformation.coefficients, bending)


def test_repetition_and_the_order_of_voxels_do_not_change_a_bit():
    field, latents = pair(bend)
    shuffled = latents_of(np.random.default_rng(1).permutation(latents.coords))
    one, two = align(field, latents, DEFAULT), align(field, shuffled, DEFAULT)
    for name in ("affine", "origin", "coefficients"):
        theirs = getattr(two.deformation, name)
        assert getattr(one.deformation, name).tobytes() == theirs.tobytes()
    assert one.deformation.spacing == two.deformation.spacing
    assert repr(one.figures) == repr(two.figures)  # as two NaN are not equal


def test_a_finer_lattice_starts_as_the_same_warp():
    warp = Warp(np.eye(3, 4), 0.0, np.zeros(3), 32.0, np.ones((5, 5, 5, 3)))
    finer = halved(warp)
    assert finer.spacing == 16.0
    assert finer.coefficients.shape == (7, 7, 7, 3)
    assert finer.coefficients == pytest.approx(1.0)


def test_two_different_objects_are_not_made_one():
    grid = np.argwhere(np.ones((64, 64, 64), dtype=bool)) - 31.5
    ball = ((grid**2).sum(axis=1) < 20**2).reshape(64, 64, 64)
    alignment = align(field_of(chair()), surface_latents(ball), DEFAULT)
    assert min(alignment.figures.score_slat, alignment.figures.score_pixieverse) < 0.6

"""A deformation is found where there is one; what is squashed is placed by its features."""

from dataclasses import astuple, replace
from itertools import combinations_with_replacement, product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial.transform import Rotation
from support.deformed import MOVES, Move, bend, occupancy
from support.residuals import carried, mean_kernel, residuals, within_box
from support.shapes import GRID, chair, crate, field_of, latents_of, surface_latents

from slatprep import align_voxels
from slatprep.align import align
from slatprep.align.consensus import degrees_between
from slatprep.align.deform_solver import OFFSET_PRIOR, PIXIEVERSE_WEIGHT
from slatprep.align.pose import Poses, Similarity
from slatprep.align.residuals import STIFFNESS, Residuals
from slatprep.align.stretch import RIDGE, stretch
from slatprep.align.surface import Surface, surface_of
from slatprep.align.warp import Warp, from_nearest, halved, places_of
from slatprep.geometry.deformation import is_proper, map_of
from slatprep.geometry.frames import split_transform, voxel_centres
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
    return np.linalg.norm(places - move(voxel_centres(latents.coords)), axis=1) * 64


def test_a_known_bend_is_found_and_the_order_of_voxels_does_not_change_a_bit():
    field, latents = pair(bend)
    before = align(field, latents, AlignParameters(model="similarity"))
    after = align(field, latents, DEFAULT)
    shuffled = latents_of(np.random.default_rng(1).permutation(latents.coords))
    again = align(field, shuffled, DEFAULT)
    for one, two in zip(astuple(after.deformation), astuple(again.deformation), strict=True):
        assert np.asarray(one).tobytes() == np.asarray(two).tobytes()
    assert repr(after.figures) == repr(again.figures)  # as two NaN are not equal
    assert before.model == "similarity"
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
    field, latents = pair(MOVES["long"])
    alignment = align(field, latents, DEFAULT)
    assert alignment.model in ("affine", "deformable")
    assert mistakes(alignment, latents, MOVES["long"]).mean() < 0.4
    assert alignment.figures.evidence_affine > 0.1 > 0.03 > alignment.figures.evidence_deformable
    affine = align(field, latents, AlignParameters(model="affine"))
    assert affine.model == "affine"
    assert affine.deformation.coefficients.size == 0
    assert mistakes(affine, latents, MOVES["long"]).mean() < 0.3
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


def test_the_same_shape_is_not_deformed():
    field = field_of(chair())
    alignment = align(field, surface_latents(np.roll(chair(), (2, -1, 3), axis=(0, 1, 2))), DEFAULT)
    assert (alignment.model, alignment.deformation) == ("rigid", None)
    assert alignment.figures.moved == alignment.figures.bending == 0.0
    # Too good to try, and so is a mirror image.
    assert np.isnan([alignment.figures.evidence_affine, alignment.figures.mirrored]).all()


@pytest.mark.parametrize("rows", [slice(18, None), slice(0, 46)], ids=["foot", "mouth"])
def test_a_vase_is_not_stretched_over_a_part_that_its_annotation_lacks(rows):
    x, y, z = np.moveaxis(GRID - np.array([31.5, 31.5, 7.5]), -1, 0)
    vase = (np.hypot(x, y) < 8.0 + 2.8 * np.cos(z / 8)) & (z > 0) & (z < 48)
    rest = np.zeros_like(vase)
    rest[:, :, rows] = vase[:, :, rows]
    latents = surface_latents(vase)
    places = map_of(align(field_of(rest), latents, DEFAULT)).places(latents.coords)
    # Its turn about the axis is free.
    assert np.abs(places - voxel_centres(latents.coords))[:, 2].max() < 0.5 / 64


def test_a_tie_is_one_only_if_both_fit_once_deformed():
    # A bar with a small fin near one end: bent, the fin is hidden from every similarity.
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
    solid = occupancy(lambda points: points)
    signed = distance_transform_edt(~solid) - distance_transform_edt(solid)
    noise = gaussian_filter(np.random.default_rng(5).normal(size=solid.shape), 1.5)
    rough = signed < 0.7 + noise / noise.std()
    latents = surface_latents(solid)
    alignment = align(field_of(rough), latents, DEFAULT)
    assert alignment.model in ("rigid", "similarity")
    assert mistakes(alignment, latents, lambda points: points).mean() < 0.6
    figures = alignment.figures
    assert figures.evidence_affine + figures.evidence_deformable < 0.05
    assert figures.offset < 0  # it is thicker


def test_what_only_the_field_has_does_not_make_the_object_smaller():
    """Rough thick fields with blobs afloat, of an object that the SLAT shows 8 % larger."""
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
    plain = align(field, latents, AlignParameters(model="rigid"))
    assert (plain.model, plain.deformation) == ("rigid", None)
    free = align(field, latents, AlignParameters(model="deformable"))
    affine, bending = free.deformation.affine, free.deformation.coefficients
    low, high = latents.coords.min(axis=0) / 64 - 0.5, (latents.coords.max(axis=0) + 1) / 64 - 0.5
    corners = np.array(list(product(*np.stack([low, high], axis=1))))
    by_affine = np.linalg.norm(corners @ affine[:, :3].T + affine[:, 3] - corners, axis=1)
    by_bending = np.linalg.norm(bending, axis=-1)
    farthest = max(by_affine.max(), by_bending.max()) * 64
    for limit in (farthest + 1.0, 0.5):
        bounded = align(field, latents, AlignParameters(model="deformable", max_displacement=limit))
        if bounded.deformation is None:  # its affine part alone moves too far
            assert bounded.model in ("rigid", "similarity")
            assert limit == 0.5
        else:
            assert np.linalg.norm(bounded.deformation.coefficients, axis=-1).max() * 64 <= limit
        if limit > farthest:
            np.testing.assert_array_equal(bounded.deformation.coefficients, bending)


def test_a_finer_lattice_starts_as_the_same_warp():
    finer = halved(Warp(np.eye(3, 4), 0.0, np.zeros(3), 32.0, np.ones((5, 5, 5, 3))))
    assert finer.spacing == 16.0
    assert finer.coefficients.shape == (7, 7, 7, 3)
    assert finer.coefficients == pytest.approx(1.0)


CENTRES = np.indices((64, 64, 64)).reshape(3, -1).T - 31.5


def stretched(
    slat: Surface, pixie: Surface, pose: Similarity, affine: NDArray[np.float64], *taus: float
) -> tuple[NDArray[np.float64], float, float]:
    """Return the affine map and the offset after steps of these widths, and the score."""
    affines, poses = affine[None].copy(), Poses.of([pose])
    (score,) = stretch(slat.samples, pixie.samples, poses, affines, np.array(taus))
    return affines[0], float(poses.offsets[0]), float(score)


@pytest.fixture(scope="module")
def beside() -> tuple[Surface, Surface, Similarity, NDArray[np.float64]]:
    """Two sides of other sizes beside each other, some samples outside, and any affine map."""
    slat = surface_of(crate(CENTRES - [3, -2, 4])).subset(150)
    pixie = surface_of(crate((CENTRES - [-2, -5, 1]) / 0.8)).subset(200)
    turn = Rotation.from_euler("xyz", [25, -40, 70], degrees=True).as_matrix()
    affine = np.array([[1.1, 0.07, -0.05, 1.3], [-0.04, 0.9, 0.06, -0.7], [0.03, -0.08, 1.05, 0.4]])
    return slat, pixie, Similarity(turn, np.array([4.0, -3.0, 6.0]), 1.2, offset=0.3), affine


Beside = tuple[Surface, Surface, Similarity, NDArray[np.float64]]


def test_without_a_step_the_score_is_the_mean_kernel_of_both_sides(beside):
    slat, pixie, pose, affine = beside
    forward, backward = residuals(slat, pixie, pose, affine)
    same, offset, score = stretched(slat, pixie, pose, affine)
    assert score == pytest.approx(0.5 * (mean_kernel(forward) + mean_kernel(backward)), rel=1e-5)
    np.testing.assert_array_equal(same, affine)
    assert offset == pose.offset


def shared(beside: Beside) -> Beside:
    """Return the two sides without the samples that lie outside the other's box."""
    slat, pixie, pose, affine = beside
    there, here = carried(slat, pixie, pose, affine)
    forward, backward = within_box(pixie, there), within_box(slat, here)
    slat = replace(slat, points=slat.points[forward], values=slat.values[forward])
    pixie = replace(pixie, points=pixie.points[backward], values=pixie.values[backward])
    assert min(len(slat.points), len(pixie.points)) > 64  # more than one block of the sums
    return slat, pixie, pose, affine


@pytest.mark.parametrize("tau", [1.5, 5.0])
def test_a_step_is_that_of_least_squares_on_numerical_derivatives(beside, tau):
    """Of Gauss and Newton, with Geman's and McClure's weights; of samples in the other's box."""
    slat, pixie, pose, affine = shared(beside)
    centre = slat.points.mean(axis=0)
    count = len(slat.points) + len(pixie.points)

    def after(step: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Return map and offset after a step, a map's row and its shift at a time."""
        rows = step[:12].reshape(3, 4)
        change = np.column_stack([rows[:, :3], rows[:, 3] - rows[:, :3] @ centre])
        return affine + change, pose.offset + float(step[12])

    def at(step: NDArray[np.float64]) -> NDArray[np.float64]:
        moved, offset = after(step)
        return np.concatenate(residuals(slat, pixie, pose._replace(offset=offset), moved))

    tiny = 1e-6 * np.eye(13)
    jacobian = np.stack([(at(one) - at(-one)) / 2e-6 for one in tiny], axis=1)
    residual = at(np.zeros(13))
    side = np.repeat([1.0, PIXIEVERSE_WEIGHT], [len(slat.points), len(pixie.points)])
    weight = side / (1.0 + (residual / tau) ** 2) ** 2
    normal = jacobian.T @ (weight[:, None] * jacobian)
    right = -jacobian.T @ (weight * residual)
    normal[12, 12] += OFFSET_PRIOR * count
    right[12] -= OFFSET_PRIOR * count * pose.offset
    normal += RIDGE * np.diag(np.diag(normal)) + 1e-9 * count * np.eye(13)
    expected, offset = after(np.linalg.solve(normal, right))
    found, found_offset, _ = stretched(slat, pixie, pose, affine, tau)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert found_offset == pytest.approx(offset, abs=1e-4)


@pytest.mark.parametrize("tau", [1.5, 5.0])
def test_a_step_of_a_lattice_is_that_of_least_squares_by_scipys_splines(beside, tau, monkeypatch):
    """From a lattice that moves all points alike; the fit sees two thirds of the samples."""
    monkeypatch.setattr("slatprep.align.residuals.SOLVER_STEPS", 2_000)  # until it is solved
    slat, pixie, pose, affine = shared(beside)
    offset, by = 0.2, np.array([0.5, -0.3, 0.2])
    sides = len(slat.points), len(pixie.points)
    seen = np.flatnonzero(np.arange(sum(sides)) % 3 > 0)
    fitted = Residuals(slat, pixie, pose, 1_000)
    warp = fitted.with_lattice(Warp(affine, offset))
    warp = warp._replace(coefficients=warp.coefficients + by)
    found = fitted.fit_lattice(warp, (tau,), seen)

    def at(shift: NDArray[np.float64], added: float) -> NDArray[np.float64]:
        moved = affine + np.column_stack([np.zeros((3, 3)), by + shift])
        other = pose._replace(offset=offset + added)
        return np.concatenate(residuals(slat, pixie, other, moved))[seen]

    tiny = 1e-6 * np.eye(4)
    slopes = [(at(one[:3], one[3]) - at(-one[:3], -one[3])) / 2e-6 for one in tiny]
    _, here = carried(slat, pixie, pose, affine + np.column_stack([np.zeros((3, 3)), by]))
    places = (np.concatenate([slat.points, here])[seen] - warp.origin) / warp.spacing
    shape = warp.coefficients.shape[:3]
    axes = [
        BSpline(np.arange(-3.0, n + 1.0), np.eye(n), 3)(np.clip(x, 0.0, n - 3.0))
        for n, x in zip(shape, places.T, strict=True)
    ]
    splines = np.einsum("mi,mj,mk->mijk", *axes).reshape(len(seen), -1)
    count = splines.shape[1]
    jacobian = np.column_stack([*(splines * one[:, None] for one in slopes[:3]), slopes[3]])
    residual, side = at(np.zeros(3), 0.0), np.repeat([1.0, PIXIEVERSE_WEIGHT], sides)[seen]
    weight = side / (1.0 + (residual / tau) ** 2) ** 2
    # The energy of bending: squares of second differences, the mixed ones twice.
    number = np.eye(count).reshape(*shape, count)
    energy = sum(
        (1.0 if a == b else 2.0) * second.T @ second
        for a, b in combinations_with_replacement(range(3), 2)
        for second in [np.diff(np.diff(number, axis=a), axis=b).reshape(-1, count)]
    )
    held = np.diag([1e-6] * (3 * count) + [OFFSET_PRIOR]) * len(seen)
    normal = jacobian.T @ (weight[:, None] * jacobian) + held
    stiff = STIFFNESS * len(seen) / count / warp.spacing**4
    normal[:-1, :-1] += stiff * np.kron(np.eye(3), energy)
    right = -jacobian.T @ (weight * residual) - held @ np.append(np.repeat(by, count), offset)
    step = np.linalg.solve(normal, right)
    moved = np.moveaxis(step[:-1].reshape(3, *shape), 0, -1)
    assert min(np.abs(moved).max(), abs(step[-1])) > 0.01
    np.testing.assert_allclose(found.coefficients - by, moved, atol=2e-4)
    assert found.offset - offset == pytest.approx(step[-1], abs=1e-4)


def test_an_affine_map_is_fitted_to_the_samples_that_are_seen(beside):
    slat, pixie, pose, affine = beside
    fitted = Residuals(slat, pixie, pose, 1_000)
    few = np.arange(0, 90), np.arange(20, 170)
    found = fitted.fit_affine(Warp(affine, 0.2), (4.0, 2.0), np.append(few[0], 150 + few[1]))
    slat, pixie = (
        replace(one, points=one.points[rows], values=one.values[rows])
        for one, rows in zip((slat, pixie), few, strict=True)
    )
    expected, offset, _ = stretched(slat, pixie, pose._replace(offset=0.2), affine, 4.0, 2.0)
    np.testing.assert_array_equal(found.affine, expected)
    assert found.offset == offset


def test_poses_are_stretched_each_by_itself(beside):
    slat, pixie, pose, affine = beside
    other = pose._replace(shift=pose.shift + 2.0, scale=1.1, offset=-0.1)
    affines, poses = np.stack([np.eye(3, 4), affine]), Poses.of([other, pose])
    scores = stretch(slat.samples, pixie.samples, poses, affines, np.array([4.0, 2.0]))
    for k, one in enumerate(((other, np.eye(3, 4)), (pose, affine))):
        alone = stretched(slat, pixie, *one, 4.0, 2.0)
        np.testing.assert_array_equal(affines[k], alone[0])
        assert (poses.offsets[k], scores[k]) == alone[1:]


@pytest.mark.parametrize("factors", [(1.1, 1.1, 0.7), (1.15, 1.05, 0.75)])
@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_squashed_object_is_not_laid_on_its_side(factors, seed):
    """As a similarity the lid fits best where a wall was, which is as near as the lid is now."""
    rotation = Rotation.random(random_state=seed).as_matrix()
    other = crate(CENTRES @ rotation / factors)
    found = align_voxels(crate(CENTRES), other)
    assert degrees_between(split_transform(found.transform)[0], rotation) < 15.0
    as_similarity = align_voxels(crate(CENTRES), other, AlignParameters(model="similarity"))
    assert degrees_between(split_transform(as_similarity.transform)[0], rotation) > 60.0


def test_a_pose_that_would_be_squashed_flat_scores_nothing():
    """An eighth of the volume is another shape, whatever the fit."""
    block = np.zeros((64, 64, 64), dtype=bool)
    block[20:44, 20:44, 20:44] = True
    flat = surface_of(block).subset(60)
    affines, poses = np.eye(3, 4)[None].copy(), Poses.of([Similarity(np.eye(3), np.zeros(3), 1.0)])
    affines[0, :, :3] *= 0.5
    assert stretch(flat.samples, flat.samples, poses, affines, np.array([5.0]))[0] == 0.0


def test_a_step_that_would_squash_it_flat_is_not_taken_nor_is_its_offset():
    large, small = (np.zeros((64, 64, 64), dtype=bool) for _ in range(2))
    large[20:44, 20:44, 20:44], small[27:37, 27:37, 27:37] = True, True
    slat, pixie = surface_of(large).subset(60), surface_of(small).subset(60)
    pose, affine = Similarity(np.eye(3), np.zeros(3), 1.0, offset=0.3), np.eye(3, 4)
    affine[:, :3] *= 0.6
    found, offset, score = stretched(slat, pixie, pose, affine, 5.0)
    assert score == 0.0
    np.testing.assert_array_equal(found, affine)
    assert offset == pose.offset

"""Every form of a PixieVerse field, and every fault of one."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from support.raw_sources import changed, raw_grid

from slatprep.errors import InputError
from slatprep.readers import read_field
from slatprep.records import SourceFile

VOXELS = [[1, 2, 3], [1, 2, 4], [60, 0, 63]]
MATERIAL = [0, 1, 6]
PROPERTIES = [[2.0e6, 1000.0, 0.25], [2.0e11, 7850.0, 0.30], [1.0e5, 500.0, 0.45]]

# Pixie's published 1st and 99th percentiles.
LOG_DENSITY = (1.7031893730163574, 3.871432304382324)
LOG_E = (3.0183002948760986, 10.881680488586426)
NU = (0.21027633547782898, 0.4492689371109009)


def prediction_of(grid: np.ndarray, *, scores: bool) -> np.ndarray:
    """Normalise a raw grid by hand, as Pixie's training code does, channels first."""
    prediction = np.full((11 if scores else 4, 64, 64, 64), -1.0, dtype=np.float32)
    occupied = grid[..., 3] != 7
    values = grid[occupied].astype(np.float64)
    columns = np.log10(values[:, 0]), np.log10(values[:, 1]), values[:, 2]
    for channel, (lo, hi) in enumerate((LOG_DENSITY, LOG_E, NU)):
        prediction[channel, occupied] = 2 * (columns[channel] - lo) / (hi - lo) - 1
    if scores:
        for k in range(8):
            prediction[3 + k] = grid[..., 3] == k
    else:
        prediction[3] = grid[..., 3]
    return prediction


RAW = raw_grid()
MASK = (RAW[..., 3] != 7).astype(np.float32)
SCORES, IDS = (prediction_of(RAW, scores=scores) for scores in (True, False))


@pytest.mark.parametrize("grid_dtype", ["f4", ">f4", "f8"])
@pytest.mark.parametrize("mask_dtype", [None, "bool", "u1", "i8", "f2", "f4", ">f8"])
def test_raw_grid(make_pair, grid_dtype, mask_dtype):
    mask = None if mask_dtype is None else MASK.astype(mask_dtype)
    order = "F" if mask_dtype == "bool" else "C"
    field = read_field(make_pair(grid=RAW.astype(grid_dtype, order=order), mask=mask))

    assert (field.voxels.tolist(), field.voxels.dtype) == (VOXELS, np.uint8)
    assert (field.material.tolist(), field.material.dtype) == (MATERIAL, np.uint8)
    np.testing.assert_array_equal(field.properties, np.array(PROPERTIES, dtype=np.float32))
    assert field.properties.dtype == np.float32 and field.properties.dtype.isnative
    assert np.argwhere(field.occupancy).tolist() == VOXELS
    assert field.warnings == ()


@pytest.mark.parametrize("scores", [True, False])
@pytest.mark.parametrize("masked", [False, True])
def test_prediction_comes_back_to_si(make_pair, scores, masked):
    # The published range of the ratio ends at 0.449.
    within = ((60, 0, 63), (500.0, 1.0e5, 0.44, 6)), ((1, 2, 4), (7400.0, 7.0e10, 0.30, 1))
    grid = prediction_of(changed(RAW, *within), scores=scores)
    field = read_field(make_pair(grid=grid, mask=MASK if masked else None))

    assert field.voxels.tolist() == VOXELS
    assert field.material.tolist() == MATERIAL
    expected = [[2.0e6, 1000.0, 0.25], [7.0e10, 7400.0, 0.30], [1.0e5, 500.0, 0.44]]
    np.testing.assert_allclose(field.properties, expected, rtol=2e-6)
    assert field.warnings == ()


def test_prediction_beyond_its_range_is_clipped_and_counted(make_pair):
    # Density, Young's modulus and Poisson's ratio, of which one of the voxels is occupied.
    beyond = ((0, 1, 2, 3), 1.5), ((1, 1, 2, 3), -3.0), (np.s_[2, :, 2, 3], 7.0)
    field = read_field(make_pair(grid=changed(SCORES, *beyond)))

    ends = [10 ** LOG_E[0], 10 ** LOG_DENSITY[1], NU[1]]
    np.testing.assert_allclose(field.properties[0], ends, rtol=2e-6)
    # The metal voxel of the raw grid is stiffer and denser, the other's ratio higher.
    clipped = [warning for warning in field.warnings if "clipped" in warning]
    assert [int(warning.split()[1]) for warning in clipped] == [2, 2, 2]
    assert "youngs_modulus" in clipped[0]


NOISE = np.random.default_rng(0).random((8, 64, 64, 64), dtype=np.float32)
NOISY = changed(SCORES, (np.s_[3:], 4 * SCORES[3:] - NOISE))
# No class at all is not jelly.
TIED = changed(SCORES, (np.s_[3:, 1, 2, 3], 0), (np.s_[3:10, 1, 2, 3], 1))
ISLAND = changed(RAW, (np.s_[10, 10, 10:12], (0, 0, 0, -1)))
OTHER_MASK = changed(MASK, ((1, 2, 3), 0), (np.s_[20, 20, 20:24], 1))
SOFT_MASK = changed(MASK, ((1, 2, 3), 0.5), ((1, 2, 4), 0.75))
ODD = {
    "scores not one-hot": (NOISY, None, 3, []),
    "tied scores": (TIED, MASK, 3, ["1 voxels have no single highest class score; not annotated",
                                    "1 occupied voxels have no class (-1); not annotated"]),
    "an island": (ISLAND, None, 5, ["2 occupied voxels have no class (-1); not annotated"]),
    "another mask": (RAW, OTHER_MASK, 6, ["4 voxels of the mask are background; not annotated",
                                          "1 voxels with a class lie outside the mask; left out"]),
    "a soft mask": (RAW, SOFT_MASK, 2, ["mask: 2 voxels lie between 0 and 1; above 0.5 is occupied",
                                        "1 voxels with a class lie outside the mask; left out"]),
}  # fmt: skip


@pytest.mark.parametrize("case", ODD)
def test_an_odd_grid_or_mask_is_read_as_far_as_it_goes_and_reported(make_pair, case):
    grid, mask, occupied, warnings = ODD[case]
    field = read_field(make_pair(grid=grid, mask=mask))
    lost = 1 if mask is not None else 0
    assert (field.voxels.tolist(), field.material.tolist()) == (VOXELS[lost:], MATERIAL[lost:])
    assert field.occupancy.sum() == occupied
    if mask is not None:
        np.testing.assert_array_equal(field.occupancy, mask > 0.5)
    others = ("clipped", "unusual masks: ")
    assert [one for one in field.warnings if not any(word in one for word in others)] == warnings
    assert any(others[1] in one for one in field.warnings) == any("the mask" in w for w in warnings)


def block(*corner: int) -> np.ndarray:
    """Return a grid with a box of wood, 10 voxels wide, at a corner."""
    grid = changed(raw_grid(), (np.s_[...], (0, 0, 0, 7)))
    return changed(grid, (tuple(slice(one, one + 10) for one in corner), (500, 1e7, 0.3, 0)))


def test_a_mask_that_contradicts_its_grid_is_told_or_refused(make_pair):
    grid, same = block(20, 20, 20), block(20, 20, 20)[..., 3] != 7
    assert read_field(make_pair(grid=grid, mask=same)).warnings == ()
    *_, told = read_field(make_pair(grid=grid, mask=np.roll(same, 3, axis=0))).warnings
    assert told.startswith("unusual masks: mask.npy leaves out 30% of the voxels with a c")
    assert "30% of it is background" in told and "mask = []" in told
    other = make_pair(grid=grid, mask=np.roll(same, 7, axis=0))
    with pytest.raises(InputError, match=r"mask\.npy: leaves out 70% of .*mask = \[\]") as caught:
        read_field(other)
    assert 'plausibility = "warn". Such keys stand in [pixieverse] of' in str(caught.value)
    few = np.roll(same, 1, axis=0)
    assert "leaves out 10% of" in read_field(make_pair(grid=grid, mask=few)).warnings[-1]
    unlabelled = changed(grid, (np.s_[20:24, 20:30, 20:30, 3], -1))
    channels = np.moveaxis(changed(grid, (np.s_[..., :3], 0.5)), -1, 0).astype(np.float32)
    # Of a prediction any class may lie outside.
    for one, mask in ((unlabelled, same), (channels, np.roll(same, 7, axis=0))):
        told = read_field(make_pair(grid=one, mask=mask)).warnings
        assert not any("unusual" in text for text in told)
    part = same & np.roll(same, 7, axis=0)
    *_, told = read_field(make_pair(grid=grid, mask=part)).warnings
    assert "leaves out 70% of the voxels with a class, and 0% of it is" in told
    for plausibility, tells in (("warn", True), ("off", False)):
        field = read_field(replace(other, roots=replace(other.roots, plausibility=plausibility)))
        assert len(field.voxels) == 300
        assert any("unusual masks" in text for text in field.warnings) == tells


def test_sources_are_named_and_hashed_and_bounds_are_ready_for_json(make_pair):
    bounds = {"min_bounds": [-0.5, -0.5, -0.25], "voxel_size": 1 / 64, "grid_shape": [64, 64, 64],
              "alpha_weighted": True, "model": "ViT-L"}  # fmt: skip
    pair = make_pair(mask=MASK, bounds=bounds)
    field = read_field(pair)
    assert json.loads(json.dumps(field.bounds)) == bounds
    roles = ("grid", "mask", "bounds")
    for role, source in zip(roles, field.sources, strict=True):
        path = getattr(pair, role)
        data, name = path.read_bytes(), f"a/{path.name}"
        assert source == SourceFile(role, name, len(data), hashlib.sha256(data).hexdigest())


def test_unreadable_bounds_are_a_warning(make_pair):
    pair = make_pair(bounds={"scale": 2.0, "extra": np.array(None, dtype=object)})
    field = read_field(pair)
    assert field.bounds == {"scale": 2.0}
    (warning,) = field.warnings
    assert "pickle" in warning
    assert warning.startswith("bounds: a/bounds.npz")
    (warning,) = read_field(make_pair(bounds={"min_bounds": np.nan})).warnings
    assert warning == "bounds: a/bounds.npz [min_bounds] is not finite; left out"
    for content in (b"not a zip", b""):
        pair.bounds.write_bytes(content)
        field = read_field(pair)
        assert field.bounds is None
        assert field.warnings[0].startswith("bounds not read: a/bounds.npz: ")


CLASS = (9, 8, 7, 3)
BAD_GRIDS = {
    "five channels": (np.zeros((5, 64, 64, 64)), "shape (5,", "(11, 64, 64, 64)"),
    "complex": (np.zeros((64, 64, 64, 4), np.complex64), "dtype <c8", "floating-point"),
    "class -2": (changed(RAW, (CLASS, -2)), "unknown class -2 at voxel (9, 8, 7)", "-1 to 7"),
    "class 1.5": (changed(RAW, (CLASS, 1.5)), "unknown class 1.5 at voxel (9, 8, 7)", "whole"),
    "class nan": (changed(RAW, (CLASS, np.nan)), "unknown class nan at voxel (9, 8, 7)", "whole"),
    "nothing annotated": (np.full((64, 64, 64, 4), -1.0),
                          "none of the 262144 occupied voxels is annotated", "class 0 to 6"),
    "score nan": (changed(SCORES, ((4, 1, 2, 3), np.nan)),
                  "class score is NaN or infinite at voxel (1, 2, 3)", "finite"),
    "predicted nan": (changed(SCORES, ((2, 1, 2, 3), np.nan)), "ratio nan at annotated voxel (1, 2",
                      "ratio in [0, 0.5], in all but 10% (sample.max_unphysical)"),
    "predicted class": (changed(IDS, ((3, 1, 2, 3), 9)), "unknown class 9 at voxel (1, 2", "to 7"),
}  # fmt: skip


UNPHYSICAL = {
    "Poisson's ratio above 0.5": (2, 0.546, "Poisson's ratio 0.546", "[0, 0.5]"),
    "negative Poisson's ratio": (2, -0.01, "Poisson's ratio -0.01", "[0, 0.5]"),
    "Poisson's ratio NaN": (2, np.nan, "Poisson's ratio nan", "[0, 0.5]"),
    "no density": (0, 0.0, "density 0", "above 0 kg"),
    "endless density": (0, np.inf, "density inf", "a finite density"),
    "negative modulus": (1, -5.0, "Young's modulus -5", "above 0 Pa"),
    "modulus NaN": (1, np.nan, "Young's modulus nan", "finite Y"),
    "modulus beyond float32": (1, 1e39, "Young's modulus 1e+39", "finite"),
}


@pytest.mark.parametrize("case", UNPHYSICAL)
def test_an_unphysical_voxel_is_not_annotated_and_one_of_few_is_refused(make_pair, case):
    channel, value, named, expected = UNPHYSICAL[case]
    few, grid = RAW.astype(np.float64), RAW.astype(np.float64)
    grid[20:23, 20:23, 20] = 900.0, 1.0e6, 0.0, 2  # none of these is at fault
    grid[20, 21, 20, channel] = few[1, 2, 4, channel] = value
    read = read_field(make_pair(grid=grid))
    assert [20, 21, 20] not in read.voxels.tolist()
    assert len(read.voxels) == len(read.material) == len(read.properties) == 11
    assert read.occupancy[20, 21, 20] and read.unphysical == 1
    assert read.warnings == (
        f"1 voxels are unphysical, the first by {named} at annotated voxel (20, 21, 20); "
        "not annotated",
    )
    pair = make_pair(grid=few)
    with pytest.raises(InputError) as caught:
        read_field(pair)
    assert caught.value.path == str(pair.grid)
    assert f"{named} at annotated voxel (1, 2, 4)" in caught.value.fault
    assert expected in caught.value.expected


def test_an_asset_fails_by_the_share_of_its_unphysical_voxels(make_pair):
    # Not a very large value that may be clipped.
    read = read_field(make_pair(grid=changed(SCORES, ((1, 1, 2, 3), np.inf))), 1 / 3)
    assert (len(read.voxels), read.unphysical) == (2, 1)
    grid = changed(RAW, ((1, 2, 3, 2), 0.7))
    assert len(read_field(make_pair(grid=grid), 1 / 3).voxels) == 2
    with pytest.raises(InputError, match=r"1 of 3 annotated voxels are unphysical.*sample\.max_un"):
        read_field(make_pair(grid=grid), 0.33)
    grid[..., 2] = 0.7
    with pytest.raises(InputError, match="3 of 3 annotated voxels"):
        read_field(make_pair(grid=grid), 1.0)


@pytest.mark.parametrize("material", [-1, 7], ids=["without class", "outside the object"])
def test_values_of_a_voxel_that_is_not_annotated_do_not_matter(make_pair, material):
    read = read_field(make_pair(grid=changed(RAW, ((30, 30, 30), (np.nan, -1, 9, material)))))
    assert read.voxels.tolist() == VOXELS
    assert read.unphysical == 0


BAD_MASKS = {
    "empty": (np.zeros((64, 64, 64), bool), "mask is empty", "occupied voxel"),
    "shape": (np.ones((1, 64, 64, 64), bool), "shape (1, 64, 64, 64)", "shape (64, 64, 64)"),
    "nan": (changed(MASK, (CLASS[:3], np.nan)), "value nan at voxel (9, 8, 7)", "or 1 (occupied)"),
    "255": (changed(MASK.astype("u1"), (CLASS[:3], 255)), "value 255 at voxel (9, 8, 7)", "0 (emp"),
    "negative": (changed(MASK, (CLASS[:3], -1)), "value -1.0 at voxel (9, 8, 7)", "0 (empty) or 1"),
    "text": (np.full((64, 64, 64), "1"), "dtype <U1", "boolean"),
}


@pytest.mark.parametrize(
    ("kind", "fault"), [*(("grid", k) for k in BAD_GRIDS), *(("mask", k) for k in BAD_MASKS)]
)
def test_a_bad_grid_or_mask_is_named(make_pair, kind, fault):
    array, what, expected = (BAD_GRIDS if kind == "grid" else BAD_MASKS)[fault]
    pair = make_pair(**{kind: array})
    with pytest.raises(InputError) as caught:
        read_field(pair)
    assert caught.value.path == str(getattr(pair, kind))
    assert what in caught.value.fault and expected in caught.value.expected
    assert "\n" not in str(caught.value)

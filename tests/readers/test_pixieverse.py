"""Every form of a PixieVerse field, and every fault of one."""

import hashlib
import json

import numpy as np
import pytest
from support.raw_sources import raw_grid

from slatprep.errors import InputError
from slatprep.readers import read_field

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
    for channel, (column, (lo, hi)) in enumerate(
        [(np.log10(values[:, 0]), LOG_DENSITY), (np.log10(values[:, 1]), LOG_E), (values[:, 2], NU)]
    ):
        prediction[channel, occupied] = 2 * (column - lo) / (hi - lo) - 1
    if scores:
        for k in range(8):
            prediction[3 + k] = grid[..., 3] == k
    else:
        prediction[3] = grid[..., 3]
    return prediction


def mask_of(grid: np.ndarray) -> np.ndarray:
    return (grid[..., 3] != 7).astype(np.float32)


@pytest.mark.parametrize("grid_dtype", ["f4", ">f4", "f8"])
@pytest.mark.parametrize("mask_dtype", [None, "bool", "u1", "i8", "f2", "f4", ">f8"])
def test_raw_grid(make_pair, grid_dtype, mask_dtype):
    grid = raw_grid()
    mask = None if mask_dtype is None else mask_of(grid).astype(mask_dtype)
    order = "F" if mask_dtype == "bool" else "C"
    field = read_field(make_pair(grid=grid.astype(grid_dtype, order=order), mask=mask))

    assert field.voxels.tolist() == VOXELS
    assert field.voxels.dtype == np.uint8
    assert field.material.tolist() == MATERIAL
    assert field.material.dtype == np.uint8
    np.testing.assert_array_equal(field.properties, np.array(PROPERTIES, dtype=np.float32))
    assert field.properties.dtype == np.float32
    assert field.properties.dtype.isnative
    assert np.argwhere(field.occupancy).tolist() == VOXELS
    assert field.warnings == ()


@pytest.mark.parametrize("scores", [True, False])
@pytest.mark.parametrize("masked", [False, True])
def test_prediction_comes_back_to_si(make_pair, scores, masked):
    grid = raw_grid()
    grid[60, 0, 63] = 500.0, 1.0e5, 0.44, 6  # the published range ends at 0.449
    grid[1, 2, 4] = 7400.0, 7.0e10, 0.30, 1
    pair = make_pair(
        grid=prediction_of(grid, scores=scores), mask=mask_of(grid) if masked else None
    )
    field = read_field(pair)

    assert field.voxels.tolist() == VOXELS
    assert field.material.tolist() == MATERIAL
    expected = [[2.0e6, 1000.0, 0.25], [7.0e10, 7400.0, 0.30], [1.0e5, 500.0, 0.44]]
    np.testing.assert_allclose(field.properties, expected, rtol=2e-6)
    assert field.warnings == ()


def test_prediction_beyond_its_range_is_clipped_and_counted(make_pair):
    prediction = prediction_of(raw_grid(), scores=True)
    prediction[0, 1, 2, 3] = 1.5  # density
    prediction[1, 1, 2, 3] = -3.0  # Young's modulus
    prediction[2, :, 2, 3] = 7.0  # Poisson's ratio; one of these voxels is occupied
    field = read_field(make_pair(grid=prediction))

    np.testing.assert_allclose(
        field.properties[0], [10 ** LOG_E[0], 10 ** LOG_DENSITY[1], NU[1]], rtol=2e-6
    )
    # The metal voxel of the raw grid is stiffer and denser, the other's ratio higher.
    clipped = [warning for warning in field.warnings if "clipped" in warning]
    assert [int(warning.split()[1]) for warning in clipped] == [2, 2, 2]
    assert "youngs_modulus" in clipped[0]


def test_class_scores_need_not_be_one_hot(make_pair):
    grid = raw_grid()
    prediction = prediction_of(grid, scores=True)
    rng = np.random.default_rng(0)
    prediction[3:] = 4 * prediction[3:] - rng.random((8, 64, 64, 64), dtype=np.float32)
    assert read_field(make_pair(grid=prediction)).material.tolist() == MATERIAL


def test_tied_class_scores_label_nothing(make_pair):
    prediction = prediction_of(raw_grid(), scores=True)
    prediction[3:, 1, 2, 3] = 0  # no class at all: not jelly
    prediction[3:10, 1, 2, 3] = 1
    field = read_field(make_pair(grid=prediction, mask=mask_of(raw_grid())))
    assert field.material.tolist() == [1, 6]
    assert field.occupancy[1, 2, 3]
    assert any("no single highest class score" in warning for warning in field.warnings)


def test_unlabelled_island_is_occupied_but_not_annotated(make_pair):
    grid = raw_grid()
    grid[10, 10, 10:12] = 0, 0, 0, -1
    field = read_field(make_pair(grid=grid))
    assert field.voxels.tolist() == VOXELS
    assert field.occupancy.sum() == 5
    assert field.warnings == ("2 occupied voxels have no class (-1); not annotated",)


def test_disagreeing_mask_is_believed_and_reported(make_pair):
    grid = raw_grid()
    mask = mask_of(grid) > 0
    mask[1, 2, 3] = False
    mask[20, 20, 20:24] = True
    field = read_field(make_pair(grid=grid, mask=mask))
    assert field.voxels.tolist() == VOXELS[1:]
    np.testing.assert_array_equal(field.occupancy, mask)
    assert field.warnings == (
        "4 voxels of the mask are background; not annotated",
        "1 voxels with a class lie outside the mask; left out",
    )


def test_soft_mask_is_cut_at_one_half(make_pair):
    mask = mask_of(raw_grid())
    mask[1, 2, 3], mask[1, 2, 4] = 0.5, 0.75
    field = read_field(make_pair(mask=mask))
    assert field.voxels.tolist() == VOXELS[1:]
    assert field.warnings[0].startswith("mask: 2 voxels lie between 0 and 1")


def test_sources_are_named_and_hashed_and_bounds_are_ready_for_json(make_pair):
    bounds = {
        "min_bounds": [-0.5, -0.5, -0.25],
        "voxel_size": 0.015625,
        "grid_shape": [64, 64, 64],
        "alpha_weighted": True,
        "model": "ViT-L",
    }
    pair = make_pair(mask=mask_of(raw_grid()), bounds=bounds)
    field = read_field(pair)
    assert json.loads(json.dumps(field.bounds)) == bounds
    sources = {source.role: source for source in field.sources}
    assert list(sources) == ["grid", "mask", "bounds"]
    for role, path in (("grid", pair.grid), ("mask", pair.mask), ("bounds", pair.bounds)):
        data, source = path.read_bytes(), sources[role]
        assert source.sha256 == hashlib.sha256(data).hexdigest()
        assert (source.size, source.path) == (len(data), f"a/{path.name}")


def test_unreadable_bounds_are_a_warning(make_pair):
    pair = make_pair(bounds={"scale": 2.0, "extra": np.array(None, dtype=object)})
    field = read_field(pair)
    assert field.bounds == {"scale": 2.0}
    assert len(field.warnings) == 1
    assert "pickle" in field.warnings[0]

    pair.bounds.write_bytes(b"not a zip")
    field = read_field(pair)
    assert field.bounds is None
    assert "bounds not read" in field.warnings[0]


def _with(voxel, channel, value, grid=raw_grid):
    changed = grid()
    changed[(*voxel, channel)] = value
    return changed


BAD_GRIDS = {
    "five channels": (np.zeros((5, 64, 64, 64), np.float32), "shape (5,", "(11, 64, 64, 64)"),
    "complex": (np.zeros((64, 64, 64, 4), np.complex64), "dtype <c8", "floating-point"),
    "class -2": (_with((9, 8, 7), 3, -2), "unknown class -2 at voxel (9, 8, 7)", "-1 to 7"),
    "class 1.5": (_with((9, 8, 7), 3, 1.5), "unknown class 1.5 at voxel (9, 8, 7)", "whole"),
    "class nan": (_with((9, 8, 7), 3, np.nan), "unknown class nan at voxel (9, 8, 7)", "whole"),
    "nothing annotated": (
        np.full((64, 64, 64, 4), -1, np.float32),
        "none of the 262144 occupied voxels is annotated",
        "class 0 to 6",
    ),
    "score nan": (
        _with((4, 1, 2), 3, np.nan, lambda: prediction_of(raw_grid(), scores=True)),
        "class score is NaN or infinite at voxel (1, 2, 3)",
        "finite",
    ),
    "predicted nan": (
        _with((2, 1, 2), 3, np.nan, lambda: prediction_of(raw_grid(), scores=True)),
        "ratio nan at annotated voxel (1, 2, 3)",
        "ratio in [0, 0.5], in all but 10% (sample.max_unphysical)",
    ),
    "predicted class": (
        _with((3, 1, 2), 3, 9, lambda: prediction_of(raw_grid(), scores=False)),
        "unknown class 9 at voxel (1, 2, 3)",
        "-1 to 7",
    ),
}


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
    few, grid = raw_grid().astype(np.float64), raw_grid().astype(np.float64)
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
    prediction = prediction_of(raw_grid(), scores=True)
    prediction[1, 1, 2, 3] = np.inf  # not a very large value that may be clipped
    read = read_field(make_pair(grid=prediction), 1 / 3)
    assert (len(read.voxels), read.unphysical) == (2, 1)
    grid = raw_grid()
    grid[1, 2, 3, 2] = 0.7
    assert len(read_field(make_pair(grid=grid), 1 / 3).voxels) == 2
    with pytest.raises(InputError, match=r"1 of 3 annotated voxels are unphysical.*sample\.max_un"):
        read_field(make_pair(grid=grid), 0.33)
    grid[..., 2] = 0.7
    with pytest.raises(InputError, match="3 of 3 annotated voxels"):
        read_field(make_pair(grid=grid), 1.0)


@pytest.mark.parametrize("material", [-1, 7], ids=["without class", "outside the object"])
def test_values_of_a_voxel_that_is_not_annotated_do_not_matter(make_pair, material):
    grid = raw_grid()
    grid[30, 30, 30] = np.nan, -1, 9, material
    read = read_field(make_pair(grid=grid))
    assert read.voxels.tolist() == VOXELS
    assert read.unphysical == 0


def _mask_with(value):
    mask = mask_of(raw_grid())
    mask[9, 8, 7] = value
    return mask


BAD_MASKS = {
    "empty": (np.zeros((64, 64, 64), bool), "mask is empty", "occupied voxel"),
    "shape": (np.ones((1, 64, 64, 64), bool), "shape (1, 64, 64, 64)", "shape (64, 64, 64)"),
    "nan": (_mask_with(np.nan), "value nan at voxel (9, 8, 7)", "0 (empty) or 1 (occupied)"),
    "255": (_mask_with(255).astype(np.uint8), "value 255 at voxel (9, 8, 7)", "0 (empty) or 1"),
    "negative": (_mask_with(-1), "value -1.0 at voxel (9, 8, 7)", "0 (empty) or 1"),
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

"""Normalisation against arithmetic by hand, and its inverse."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slatprep import normalize
from slatprep.errors import ConfigError
from slatprep.readers.ranges import read_ranges
from slatprep.records import MaterialField, Normalization


def ranges(source: str, *spans: tuple[float, float]) -> Normalization:
    return normalize.normalization_of(np.array(spans), source)


DECADES = ranges("by hand", (4.0, 12.0), (2.0, 4.0), (0.2, 0.4))


def test_the_ends_are_not_clipped_and_what_lies_beyond_is_counted():
    # 10^4..10^12: 10^6 lies a quarter of the way, 2 * 0.25 - 1 = -0.5.
    properties = [[1e6, 1e3, 0.35], [1e4, 1e2, 0.2], [1e12, 1e4, 0.4], [np.nan] * 3]
    properties += [[1e3, 1e5, 0.3], [1e13, 1e3, 0.5]]
    values, clipped = normalize.normalize_and_count(properties, DECADES)
    np.testing.assert_allclose(values[0], [-0.5, 0.0, 0.5], atol=1e-6)
    np.testing.assert_array_equal(values[1:4], [[-1, -1, -1], [1, 1, 1], [np.nan] * 3])
    np.testing.assert_allclose(values[4:], [[-1, 1, 0], [1, 0, 1]], atol=1e-6)
    assert clipped.tolist() == [2, 1, 1]
    assert values.dtype == np.float32


def test_properties_are_mapped_and_brought_back_by_hand():
    properties = [[1e6, 1e3, 0.35], [2e11, 7850.0, 0.28]]
    mapped = normalize.to_mapped(properties)
    by_hand = [[6.0, 3.0, 0.35], [11 + np.log10(2), np.log10(7850), 0.28]]
    np.testing.assert_allclose(mapped, by_hand, rtol=1e-12)
    back = normalize.from_mapped(mapped)
    np.testing.assert_allclose(back, properties, rtol=1e-6)
    assert back.dtype == np.float32


def test_values_of_other_ranges_by_hand_are_not_clipped():
    wide = ranges("by hand", (0.0, 16.0), (2.0, 6.0), (0.3, 0.4))
    # Of 4..12, 2..4 and 0.2..0.4: -0.5 is 6, 2.5 and 0.25; 1 is 12, 4 and 0.4.
    values = normalize.change_ranges([[-0.5] * 3, [1.0] * 3], DECADES, wide)
    np.testing.assert_allclose(values, [[-0.25, -0.75, -2.0], [0.5, 0.0, 1.0]], atol=1e-12)


@pytest.mark.parametrize("way", [normalize.normalize_properties, normalize.denormalize_properties])
@pytest.mark.parametrize("shape", [(2, 2), (2, 4), (3, 7), ()])
def test_columns_without_a_range_are_refused(way, shape):
    with pytest.raises(ValueError, match=r"expected \(N, 3\), a column each of youngs_modulus"):
        way(np.ones(shape))


MATERIALS = st.tuples(st.floats(1.1e3, 7e10), st.floats(51, 7400), st.floats(0.211, 0.449))


@given(st.lists(MATERIALS, min_size=1, max_size=20))
def test_the_inverse_is_exact_to_float32(rows):
    properties = np.array(rows, dtype=np.float32)
    values, clipped = normalize.normalize_and_count(properties, normalize.PIXIE_RANGES)
    assert clipped.sum() == 0
    # Half a step of float32 near 1 is 3e-8, which eight decades of E stretch by 4 ln 10.
    back = normalize.denormalize_properties(values, normalize.PIXIE_RANGES)
    np.testing.assert_allclose(back, properties, rtol=1e-6)


def _field(properties: list[list[float]]) -> MaterialField:
    rows = np.arange(len(properties), dtype=np.uint8)
    occupancy, voxels = np.zeros((64, 64, 64), dtype=bool), np.stack([rows] * 3, axis=1)
    return MaterialField(occupancy, voxels, 0 * rows, np.array(properties, np.float32))


def test_dataset_ranges_span_all_assets():
    here = normalize.property_extent(_field([[1e5, 100, 0.2], [1e7, 1000, 0.3]]))
    there = normalize.property_extent(_field([[1e9, 10, 0.25]]))
    np.testing.assert_allclose(here, [[5, 7], [2, 3], [0.2, 0.3]], atol=1e-7)
    found = normalize.ranges_from_extents([here, there])
    assert found.source == "dataset"
    np.testing.assert_allclose([(r.lo, r.hi) for r in found.ranges],
                               [(5, 9), (1, 3), (0.2, 0.3)], atol=1e-7)  # fmt: skip


def test_one_value_in_all_the_dataset_becomes_zero():
    field = _field([[1e5, 100, 0.3]])
    own = normalize.ranges_from_extents([normalize.property_extent(field)])
    values, clipped = normalize.normalize_and_count(field.properties, own)
    np.testing.assert_allclose(values, [[0, 0, 0]], atol=1e-6)
    assert clipped.sum() == 0


@pytest.mark.parametrize("extents", [np.zeros((0, 3, 2)), np.full((1, 3, 2), np.nan)])
def test_ranges_of_nothing_are_refused(extents):
    with pytest.raises(ValueError, match="at least one asset"):
        normalize.ranges_from_extents(extents)


def test_a_change_is_scaled_as_the_values_are():
    scaled = normalize.normalize_change([2.0, 1.0, 0.1], DECADES)
    np.testing.assert_allclose(scaled, [0.5, 1.0, 1.0])


def test_ranges_are_read_from_toml_and_json(tmp_path):
    table = {r.name: {"lo": r.lo, "hi": r.hi} for r in DECADES.ranges}
    (tmp_path / "ranges.json").write_text(json.dumps(table))
    text = "".join(f"[{r.name}]\nlo = {r.lo}\nhi = {r.hi}\n" for r in DECADES.ranges)
    (tmp_path / "ranges.toml").write_text(text)
    for name in ("ranges.json", "ranges.toml"):
        found = read_ranges(tmp_path / name)
        assert found.ranges == DECADES.ranges
        assert found.source == name


PIXIE_S_FILE = {
    "density_min": 1.7031893730163574, "density_max": 3.871432304382324,
    "E_min": 3.0183002948760986, "E_max": 10.881680488586426,
    "nu_min": 0.21027633547782898, "nu_max": 0.4492689371109009,
}  # fmt: skip


@pytest.mark.parametrize("form", ["json", "lines", "minima and maxima"])
def test_pixie_s_own_file_gives_pixie_s_ranges(tmp_path, form):
    percentiles = {
        name.replace("_min", "_p1").replace("_max", "_p99"): value
        for name, value in PIXIE_S_FILE.items()
    }
    numbers = PIXIE_S_FILE | ({} if form == "minima and maxima" else percentiles)
    path = tmp_path / "normalization_ranges.yaml"
    lines = "".join(f"{name}: {value}  # log10\n" for name, value in numbers.items())
    path.write_text(f"---\n{lines}\n" if form == "lines" else json.dumps(numbers))
    found = read_ranges(path)
    assert found.ranges == normalize.PIXIE_RANGES.ranges
    assert found.source == "normalization_ranges.yaml"


def changed(**numbers: object) -> str:
    return json.dumps(PIXIE_S_FILE | numbers)


MODULUS = "[youngs_modulus]\n"
BAD = {
    "ranges.yaml": [
        "", "{", "{}", "[" * 100_000, '{"a":' * 100_000, "- 1", "density_p1: [1, 2]",
        "density_p1: !!python/object/apply:os.system [ls]", changed(nu_min="0.2"),
        changed(nu_min=math.nan), changed(nu_max=math.inf), changed(E_max=10**400),
        changed(E_min=True), changed(nu_min=0.5), changed(E_min=None), changed(nu_p1=0.2),
        changed(nu_p99=0.3), changed(density_min=1000.0, density_max=8000.0),
    ],
    "ranges.toml": [
        "", "not toml at all", "youngs_modulus = 3\n", f"{MODULUS}lo = true\nhi = 4\n",
        f"{MODULUS}lo = -1e308\nhi = 1e308\n", f"{MODULUS}lo = 3\nhi = 3\n",
        f"{MODULUS}lo = 3\nhi = inf\n", f"{MODULUS}lo = 3\nhi = 1e11\n",
        f"{MODULUS}lo = '3'\nhi = 4\n",
    ],
}  # fmt: skip


@pytest.mark.parametrize(("name", "text"), [(name, text) for name in BAD for text in BAD[name]])
def test_bad_ranges_are_named_by_their_file(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=name):
        read_ranges(tmp_path / name)


@pytest.mark.parametrize(("values", "told"), [
    ({"nu_max": 1e7}, r"between -1,000,000 and 1,000,000$"),
    ({"E_max": 1e11}, r"between -50 and 50, in log10 of the SI value$"),
])  # fmt: skip
def test_the_bounds_of_ranges_are_told(tmp_path, values, told):
    (tmp_path / "r.yaml").write_text(changed(**values))
    with pytest.raises(ConfigError, match=told):
        read_ranges(tmp_path / "r.yaml")


@pytest.mark.parametrize("name", ["r.json", "r.yaml", "lines.yaml"])
def test_a_number_that_is_there_twice_is_an_error(tmp_path, name):
    numbers: dict[str, object] = {**PIXIE_S_FILE}
    if name == "r.json":
        numbers = {r.name: {"lo": r.lo, "hi": r.hi} for r in DECADES.ranges}
    pairs = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in numbers.items()]
    text = "{" + ", ".join([*pairs, pairs[0]]) + "}"
    if name == "lines.yaml":
        text = "density_min: 1\n" + "".join(f"{key}: {value}\n" for key, value in numbers.items())
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=f"{name}.*the key '{next(iter(numbers))}' occurs twice"):
        read_ranges(tmp_path / name)

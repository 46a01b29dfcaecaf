"""What `import slatprep` gives."""

import doctest
import importlib.metadata
import inspect
import os
import pkgutil
import re
import subprocess
import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from support.synthetic import JELLY, METAL, QUARTER_TURN, Asset, make_asset

import slatprep
from slatprep.errors import ConfigError, needing
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.records import Engine

NAMES = sorted(slatprep.__all__)
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(slatprep.__path__, "slatprep.")
    if not module.name.endswith("__main__")
)


def run(script: str) -> str:
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_is_light():
    loaded = run(
        "import sys; before = set(sys.modules); import slatprep; dir(slatprep)\n"
        "print(*{name.partition('.')[0] for name in set(sys.modules) - before})"
    ).split()
    assert "slatprep" in loaded
    assert set(loaded) <= set(sys.stdlib_module_names) | {"slatprep", "lazy_loader"}


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_there_and_documented(name):
    value = getattr(slatprep, name)
    assert name in dir(slatprep) and not isinstance(value, ModuleType)
    assert f"slatprep.{name}" not in MODULES  # It would take a function's place.
    if callable(value):
        assert inspect.getdoc(value), name
    if inspect.isfunction(value):
        documented = inspect.getdoc(value) or ""
        assert "Parameters\n---" in documented and "Returns\n---" in documented, name


def test_the_version_is_that_of_the_package():
    assert slatprep.__version__ == importlib.metadata.version("slatprep")


@pytest.mark.parametrize("name", MODULES)
def test_doctests_run(name):
    failed, _ = doctest.testmod(importlib.import_module(name))
    assert failed == 0


def field_of(asset: Asset) -> slatprep.MaterialField:
    material = asset.grid[..., 3]
    voxels = np.argwhere(material != 7).astype(np.uint8)
    row = tuple(voxels.T)
    properties = asset.grid[row][:, [1, 0, 2]]
    return slatprep.MaterialField(material != 7, voxels, material[row].astype(np.uint8), properties)


def test_two_voxel_sets_in_any_form_give_the_same_transform():
    asset = make_asset(1)
    occupancy = asset.grid[..., 3] != 7
    batch = np.column_stack([np.zeros(len(asset.coords), int), asset.coords])
    target = np.zeros((64, 64, 64), dtype=bool)
    target[tuple(asset.coords.T)] = True
    first = slatprep.align_voxels(occupancy, asset.coords).transform
    np.testing.assert_allclose(first, QUARTER_TURN, atol=2e-3)
    for source in (occupancy, np.argwhere(occupancy)):
        for slat in (batch, target):
            # The order of the voxels differs, the voxels do not.
            again = slatprep.align_voxels(source, slat).transform
            np.testing.assert_allclose(again, first, atol=2e-3)


def test_a_field_is_looked_up_at_slat_voxels():
    asset = make_asset(2)
    found = slatprep.annotate_voxels(field_of(asset), asset.coords, QUARTER_TURN)
    assert found.valid.all() and found.distance.max() < 1e-6
    for stuff in (JELLY, METAL):
        here = found.material == stuff[0]
        assert here.any()
        np.testing.assert_allclose(found.properties[here], [stuff[1:]] * here.sum(), rtol=1e-6)


@pytest.mark.parametrize(("name", "values", "said"), [
    ("voxels", np.uint8(64), r"field\.voxels has values from .* to 64; expected whole"),
    ("voxels", -5, "field.voxels has values from -5"),
    ("voxels", np.nan, "field.voxels has values from nan"),
    ("material", -1, "classes; expected 0 to 254"),
    ("material", 255, "classes; expected 0 to 254"),
    ("material", 0.5, "classes; expected 0 to 254"),
    ("material", None, r"field\.material has shape \(\d+,\); expected"),
    ("properties", None, r"field\.properties has shape \(\d+, 3\); expected"),
])  # fmt: skip
def test_a_field_whose_arrays_do_not_fit_is_refused_in_words(name, values, said):
    asset = make_asset(2)
    field = field_of(asset)
    array = getattr(field, name)[:-1]
    if values is not None:
        array = getattr(field, name).astype(np.result_type(values, np.int16))
        array[3] = values
    with pytest.raises(ValueError, match=said):
        slatprep.annotate_voxels(replace(field, **{name: array}), asset.coords, QUARTER_TURN)


@pytest.mark.parametrize(("change", "said"), [
    (lambda f: {"voxels": f.voxels[[1, *range(1, len(f.voxels))]]}, r"field\.voxels has .* twice"),
    (lambda f: {"properties": f.properties * np.nan}, r"field\.properties has youngs_modulus nan"),
    (lambda f: {"properties": -f.properties}, r"field\.properties has youngs_modulus -"),
])  # fmt: skip
def test_a_field_that_no_reader_gives_is_refused_in_words(change, said):
    asset = make_asset(2)
    field = field_of(asset)
    with pytest.raises(ValueError, match=said):
        slatprep.annotate_voxels(replace(field, **change(field)), asset.coords, QUARTER_TURN)


@pytest.mark.parametrize("dtype", [">i8", ">f4", np.int8, object])
def test_arrays_of_a_field_may_have_any_type_of_number_and_may_change(dtype):
    asset = make_asset(2)
    field = field_of(asset)
    expected = slatprep.annotate_voxels(field, asset.coords, QUARTER_TURN)
    arrays = {name: getattr(field, name) for name in ("voxels", "material")}
    given = replace(field, **{name: array.astype(dtype) for name, array in arrays.items()})
    other = given.voxels.copy()
    given.voxels[:] = other[::-1]
    slatprep.annotate_voxels(given, asset.coords, QUARTER_TURN)
    given.voxels[:] = other
    found = slatprep.annotate_voxels(given, asset.coords, QUARTER_TURN)
    np.testing.assert_array_equal(found.material, expected.material)
    assert found.material.dtype == np.uint8


def test_eight_voxels_of_a_finer_grid_are_placed_and_looked_up_as_the_one_they_fill():
    asset = make_asset(3)
    field = field_of(asset)
    corners = np.indices((2, 2, 2)).reshape(3, -1).T
    fine = (2 * asset.coords[:, None].astype(int) + corners).reshape(-1, 3)
    for parameters in (None, AlignParameters(engine=Engine.KNOWN)):
        coarse = slatprep.align_voxels(field.occupancy, asset.coords, parameters)
        again = slatprep.align_voxels(field.occupancy, fine, parameters, resolution=128)
        np.testing.assert_array_equal(again.transform, coarse.transform)
        assert again.quality == coarse.quality
    nearest = SampleParameters(method="nearest")
    one = slatprep.annotate_voxels(field, asset.coords, QUARTER_TURN, nearest)
    eight = slatprep.annotate_voxels(field, fine, QUARTER_TURN, nearest, resolution=128)
    np.testing.assert_array_equal(eight.material, np.repeat(one.material, 8))
    np.testing.assert_allclose(eight.distance, np.sqrt(3) / 4, atol=1e-5)
    with pytest.raises(ValueError, match=r"whole numbers in 0\.\.31"):
        slatprep.align_voxels(field.occupancy, fine, resolution=32)
    with pytest.raises(ValueError, match="resolution is 512"):
        slatprep.align_voxels(field.occupancy, fine, resolution=512)


@pytest.mark.parametrize(("voxels", "said"), [
    (np.zeros((64, 64, 64), bool), "with a voxel in it"),
    (np.empty((0, 3)), "with a voxel in it"),
    (np.full((64, 64, 64), 0.1), "values other than 0 and 1"),
    (np.full((64, 64, 64), np.nan), "values other than 0 and 1"),
    (np.full((64, 64, 64), -1), "values other than 0 and 1"),
    (np.ones((5, 4)), r"shape \(5, 4\)"),
    ([[0, 0, 64]], "from 0 to 64; expected whole numbers in 0..63"),
    ([[0, 0, -1]], "from -1 to 0"),
    ([[0.5, 0, 0]], "whole numbers"),
    ([[np.nan, 0, 0]], "whole numbers"),
])  # fmt: skip
def test_what_is_no_voxel_set_is_refused_in_words(voxels, said):
    with pytest.raises(ValueError, match=said):
        slatprep.align_voxels(voxels, [[1, 2, 3]])
    with pytest.raises(ValueError, match=said):
        slatprep.align_voxels([[1, 2, 3]], voxels)


@pytest.mark.parametrize(("wrong", "said"), [
    ({"engine": "opend3d"}, "AlignParameters: engine: got 'opend3d'; expected 'field'"),
    ({"scale_bounds": (2, 1)}, r"scale_bounds.0: got 2"),
    ({"radius": -1}, "radius: got -1"),
    ({"method": "zz"}, "SampleParameters: method: got 'zz'; expected 'vote' or 'nearest'"),
    ({"max_distance": np.nan}, "max_distance: got nan"),
    ({"vote_width": 0}, "vote_width: got 0"),
])  # fmt: skip
def test_parameters_that_make_no_sense_are_refused_in_words(wrong, said):
    asset = make_asset(3)
    with pytest.raises(ConfigError, match=said):
        if {*wrong} & {"engine", "scale_bounds", "radius"}:
            slatprep.align_voxels(asset.coords, asset.coords, AlignParameters(**wrong))
        else:
            parameters = SampleParameters(**wrong)
            slatprep.annotate_voxels(field_of(asset), asset.coords, QUARTER_TURN, parameters)


def test_type_checkers_see_the_package_from_outside_the_checkout(tmp_path):
    script = tmp_path / "script.py"
    asked = "".join(f"reveal_type({one})\n" for one in ("store", "store[0]", "store[1:]"))
    script.write_text(f"import slatprep\nstore = slatprep.open_store('x')\n{asked}")
    # What the package stands on is large, and no part of what is asked.
    (tmp_path / "mypy.ini").write_text(
        "[mypy]\nfollow_imports = skip\nincremental = False\n"
        "[mypy-slatprep.*]\nfollow_imports = silent\n"
    )
    environment = {name: value for name, value in os.environ.items() if "PYTHONPATH" not in name}
    command = [sys.executable, "-m", "mypy", str(script)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    seen = re.findall(r'Revealed type is "([\w.\[\]]+)"', done.stdout)
    asset = "slatprep.store.reader.StoredAsset"
    assert seen == ["slatprep.store.reader.Store", asset, f"list[{asset}]"], done.stdout


def test_a_package_that_fails_while_it_is_imported_tells_why():
    reason = r"reading a PLY needs a package that fails \(for another numpy\); install it with"
    with pytest.raises(ConfigError, match=reason), needing("reading a PLY needs", "simulate"):
        raise ImportError("for another numpy")

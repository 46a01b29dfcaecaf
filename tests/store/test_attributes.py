"""What the attributes of a root must say: good ones are read, each fault is told by its name."""

from typing import Any

import pytest
from support.made_store import BUILD_ID

from slatprep.records import PIXIEVERSE, Contents, LatentSpace, Property
from slatprep.store.attributes import (
    RootAttributes,
    read_attributes,
    segments_of,
    store_attributes,
    width_findings,
)


def said() -> dict[str, Any]:
    """Attributes of a store, written out."""
    span = {"log10": True, "lo": 2.0, "hi": 5.0, "source": "pixie"}
    return {
        "format": "slatprep-store",
        "format_version": 1,
        "resolution": 64,
        "material_classes": list(PIXIEVERSE.classes),
        "property_columns": ["density", "hue"],
        "property_units": ["kg/m^3", "1"],
        "normalization": {
            # As JSON has them: in no order.
            "hue": {**span, "log10": False, "lo": -1.0, "hi": 1.0},
            "density": span,
        },
        "latents": {"encoder": "trellis", "channels": 8, "resolution": 64},
        "manifest": BUILD_ID,
        "build": {
            "parameters": {"align": {"radius": 1.5}, "sample": {"method": "nearest"}},
            "versions": {"slatprep": "0"},
        },
    }


def read(attributes: dict[str, Any]) -> RootAttributes:
    found = read_attributes(attributes)
    assert isinstance(found, RootAttributes), found
    return found


def test_ranges_and_tables_are_in_the_order_of_the_columns():
    found = read(said())
    spans = [(one.name, one.log10, one.lo, one.hi) for one in found.ranges.ranges]
    assert spans == [("density", True, 2.0, 5.0), ("hue", False, -1.0, 1.0)]
    assert found.ranges.source == "pixie"
    assert found.contents.properties == (
        Property("density", "kg/m^3", True),
        Property("hue", "1", False),
    )
    assert found.contents.latents == LatentSpace("trellis", 8, 64)
    assert found.build.parameters.sample.method == "nearest"


def test_a_store_may_have_a_single_property():
    attributes = said()
    attributes["property_columns"], attributes["property_units"] = ["hue"], ["1"]
    del attributes["normalization"]["density"]
    found = read(attributes)
    assert [one.name for one in found.ranges.ranges] == ["hue"]
    assert found.ranges.source == "pixie"


def test_what_newer_versions_add_is_left_alone():
    attributes = said()
    attributes["colour"] = "new"
    attributes["build"]["parameters"]["sample"]["colour"] = "new"
    attributes["build"]["parameters"]["align"]["colour"] = "new"
    assert read(attributes) == read(said())
    assert "colour" in attributes["build"]["parameters"]["sample"]


LONG = "x" * 200
FAULTS = {
    "another format": (("format",), "other", "attribute format is 'other'", "'slatprep-store'"),
    "a newer format": (("format_version",), 2, "attribute format_version is 2", "1"),
    "a number as text": (
        ("normalization", "hue", "lo"), "1", "attribute normalization/hue/lo is '1'",
        "a valid number",
    ),
    "yes as text": (
        ("normalization", "hue", "log10"), "yes", "attribute normalization/hue/log10 is 'yes'",
        "a valid boolean",
    ),
    "an empty range": (
        ("normalization", "hue", "hi"), -1.0, "attribute normalization/hue is {",
        "lo must be less than hi",
    ),
    "a column twice": (
        ("property_columns",), ["density", "density"], "attribute  is {",
        "property_columns and normalization must name the same properties",
    ),
    "a column twice that has the names": (
        ("property_columns",), ["density", "hue", "hue"], "attribute  is {",
        "property_columns and normalization must name the same properties",
    ),
    "a column without a range": (
        ("property_columns",), ["density", "taste"], "attribute  is {",
        "property_columns and normalization must name the same properties",
    ),
    "a unit too few": (
        ("property_units",), ["1"], "attribute  is {",
        "property_units must have a unit for each of property_columns",
    ),
    "long text": (("manifest",), LONG, f"attribute manifest is '{LONG[:99]}", ""),
}  # fmt: skip


@pytest.mark.parametrize("case", FAULTS)
def test_what_is_wrong_is_told_by_its_name(case):
    place, value, what, expected = FAULTS[case]
    attributes = at = said()
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    found = read_attributes(attributes)
    assert isinstance(found, tuple)
    (finding,) = found
    assert finding.file == "zarr.json"
    assert finding.what.startswith(what)
    assert len(finding.what) <= len("attribute ") + len("/".join(place)) + len(" is ") + 100
    assert finding.expected.startswith(expected)


def test_what_is_missing_is_said_to_be_and_every_fault_is_told():
    attributes = said()
    del attributes["manifest"], attributes["build"]["versions"]
    attributes["resolution"] = 32
    found = read_attributes(attributes)
    assert isinstance(found, tuple)
    assert {one.what for one in found} == {
        "attribute manifest is missing",
        "attribute build/versions is missing",
        "attribute resolution is 32",
    }


@pytest.mark.parametrize("parameters", [None, 5, {"sample": 5}, {"sample": None}])
def test_parameters_that_are_no_tables_are_told(parameters):
    attributes = said()
    attributes["build"]["parameters"] = parameters
    found = read_attributes(attributes)
    assert isinstance(found, tuple)
    assert all(one.what.startswith("attribute build/parameters") for one in found)


def test_arrays_of_another_width_are_told_and_others_left_to_those_who_check_shapes():
    found = read(said())
    fine = {"voxel/feats": {"shape": [9, 8]}, "voxel/properties": {"shape": [9, 2]}}
    assert list(width_findings(found, fine)) == []
    (finding,) = width_findings(found, {**fine, "voxel/feats": {"shape": [8, 9]}})
    assert finding.what == "attribute latents says 8 columns of voxel/feats"
    assert finding.expected == "9, as the array has"
    (finding,) = width_findings(found, {**fine, "voxel/properties": {"shape": [2, 3]}})
    assert finding.what == "attribute property_columns says 2 columns of voxel/properties"
    for odd in (None, [9], [9, 5, 5], "ab", {}):
        assert list(width_findings(found, {**fine, "voxel/feats": {"shape": odd}})) == []
    for odd in (None, 5, {}):
        assert list(width_findings(found, {**fine, "voxel/feats": odd})) == []
    assert list(width_findings(found, {})) == []


def test_segments_begin_where_ids_begin_anew():
    assert segments_of([]) == [0]
    assert segments_of(["b"]) == [0]
    assert segments_of(["a", "b", "c"]) == [0]
    assert segments_of(["c", "a", "b", "a", "z"]) == [0, 1, 3]


@pytest.mark.parametrize(("classes", "background"), [(7, None), (8, 254)])
def test_the_background_is_said_where_it_is_not_the_usual_one(classes, background):
    contents = Contents(PIXIEVERSE.properties, tuple(f"class {n}" for n in range(classes)))
    ranges = read(said()).ranges
    attributes = store_attributes(ranges, {}, contents)
    assert attributes.get("background") == background

"""Records and the attributes of a root: good ones are read, each fault is told by its name."""

import hashlib
import json
import runpy
from dataclasses import replace
from math import nan
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from support.made_store import BUILD_ID, GONE, placed

from slatprep.pipeline.dataset import BuildSummary
from slatprep.records import PIXIEVERSE, LatentSpace, Property, oddities_in
from slatprep.storage.documents import adapter_of
from slatprep.store import open_store
from slatprep.store.attributes import RootAttributes, read_attributes, segments_of, width_findings
from slatprep.store.layout import RECORDS_IN_CHUNK
from slatprep.store.record import AssetRecord, BuildRecord, FailedRecord
from slatprep.store.record_json import FOLDER, RecordError, read_record, to_json
from slatprep.store.records import StoredRecords


def lines_of(build: BuildSummary) -> list[bytes]:
    return build.records.read_bytes().splitlines()


@pytest.fixture
def record(mixed_build: BuildSummary) -> AssetRecord:
    return read_record(AssetRecord, lines_of(mixed_build)[0], "here")


def test_every_record_follows_the_published_schema(mixed_build):
    published = {path.name: json.loads(path.read_text()) for path in FOLDER.iterdir()}
    for schema in published.values():
        jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(published["asset_record.schema.json"])
    lines = lines_of(mixed_build)
    assert len(lines) == 5
    build = json.loads((mixed_build.records.parent / "build.json").read_text())
    assert [one["asset_id"] for one in build["failed"]] == ["lone", "torn"]
    for record in (*(json.loads(line, parse_constant=pytest.fail) for line in lines),
                   *build["failed"]):  # fmt: skip
        validator.validate(record)
    jsonschema.Draft202012Validator(published["build_record.schema.json"]).validate(build)
    assert build["id"] == mixed_build.build_id
    assert build["statuses"] == mixed_build.statuses


def test_records_that_threads_read_at_once_are_not_kept_for_ever():
    """A text that reads on while it is made stands for another thread at that moment."""

    class Text(str):
        def __str__(self) -> str:
            row = int(self.removeprefix("row "))
            if 6 * RECORDS_IN_CHUNK <= row < 20 * RECORDS_IN_CHUNK:
                records.text(row + RECORDS_IN_CHUNK)
            return str.__str__(self)

    class Rows:
        reads = 0

        def __len__(self) -> int:
            return 64 * RECORDS_IN_CHUNK

        def read_rows(self, _: str, start: int, stop: int) -> list[Text]:
            self.reads += 1
            return [Text(f"row {row}") for row in range(start, stop)]

    rows = Rows()
    records = StoredRecords(rows)
    for chunk in range(64):
        assert records.text(chunk * RECORDS_IN_CHUNK) == f"row {chunk * RECORDS_IN_CHUNK}"
    before = rows.reads
    for chunk in range(56, 64):
        records.text(chunk * RECORDS_IN_CHUNK)
    assert rows.reads == before
    records.text(0)
    assert rows.reads == before + 1


def test_the_published_schemas_are_those_of_the_classes():
    made = runpy.run_path(str(Path(__file__).parents[2] / "tools" / "schema.py"))["json_schemas"]()
    alike = made == {path.name: json.loads(path.read_text()) for path in FOLDER.iterdir()}
    assert alike, "run: make schema"  # Both sides would be pages of output.


def test_what_is_written_is_read_again_bit_for_bit(mixed_build):
    for line in lines_of(mixed_build):
        again = read_record(AssetRecord, line, "here")
        assert to_json(again) == line
        assert again.alignment.transform.tolist() == json.loads(line)["alignment"]["transform"]
    file = mixed_build.records.parent / "build.json"
    build = read_record(BuildRecord, file.read_bytes(), "here")
    assert to_json(build, indent=True) + b"\n" == file.read_bytes()


@pytest.mark.parametrize(("path", "value"), [
    ("status", "fine"), ("status", "failed"), ("status", GONE), ("format_version", 2),
    ("asset_id", ""), ("alignment", GONE), ("alignment/engine", "magic"),
    ("alignment/transform/3", GONE), ("alignment/transform/0/0", "1"),
    ("alignment/quality/fitness", 1.5), ("alignment/quality/fitness", -0.1),
    ("alignment/quality/surplus", 1), ("alignment/candidates/0/index", -1),
    ("alignment/candidates/0/index", 0.5), ("judgement/verdict", "splendid"), ("sources", []),
    ("sources/0/role", "photo"), ("sources/0/sha256", "beef"), ("parameters/align/radius", "1"),
    ("parameters/sample/surplus", 1), ("counts/valid", -1), ("versions", GONE),
    ("versions/numpy", GONE), ("code", "0" * 63), ("key", ""), ("surplus", 1),
])  # fmt: skip
def test_what_is_no_record_is_refused_and_named(record, path, value):
    changed = placed(json.loads(to_json(record)), path, value)
    with pytest.raises(RecordError, match=r"^a\.jsonl, line 3: not a record") as refused:
        read_record(AssetRecord, json.dumps(changed), "a.jsonl, line 3")
    assert refused.value.faults[0].startswith(path.rpartition("/")[0])
    if path != "versions/numpy":  # That certain keys must be there, JSON Schema cannot say.
        schema = json.loads((FOLDER / "asset_record.schema.json").read_text())
        assert not jsonschema.Draft202012Validator(schema).is_valid(changed)


def test_a_failed_asset_has_a_reason(mixed_build):
    build = json.loads((mixed_build.records.parent / "build.json").read_text())
    (skipped,) = (json.dumps(one) for one in build["failed"] if one["asset_id"] == "lone")
    assert adapter_of(FailedRecord).validate_json(skipped, strict=True).reason
    with pytest.raises(ValueError, match="reason"):
        adapter_of(FailedRecord).validate_json(json.dumps(json.loads(skipped) | {"reason": ""}))
    with pytest.raises(RecordError):
        read_record(AssetRecord, skipped, "here")


def test_text_that_is_no_json_is_refused():
    for text in ("", "{", "[]", "null", '{"status": NaN}', b"\xff"):
        with pytest.raises(RecordError):
            read_record(AssetRecord, text, "here")


def test_what_is_unusual_of_a_merged_annotation_names_it():
    warnings = ["sample 2: unusual values: class sand has\n3 Pa", "unusual values: other", "a word"]
    assert oddities_in(warnings) == {"values": "sample 2: class sand has 3 Pa"}
    masks = ["sample 0 has no unusual masks: none", "unusual masks: b"]
    assert oddities_in(masks) == {"masks": "b"}


def test_nan_is_null(record):
    unknown = replace(record, alignment=replace(record.alignment, score=nan))
    assert json.loads(to_json(unknown))["alignment"]["score"] is None
    again = read_record(AssetRecord, to_json(unknown), "here")
    assert np.isnan(again.alignment.score)
    assert to_json(again) == to_json(unknown)


def test_a_record_names_what_the_row_was_made_from(mixed_build):
    records = [json.loads(line) for line in mixed_build.records.read_text().splitlines()]
    record = next(record for record in records if record["asset_id"] == "bear.side")
    assert (record["object_id"], record["view"]) == ("bear", "side")
    # Their sizes and digests are held to the files in tests/inspect/verify.
    paths = {source["role"]: source["path"] for source in record["sources"]}
    assert paths == {"grid": "bear/sample_0/material_grid.npy", "slat": "bear/side.npz"}
    candidates = record["alignment"]["candidates"]
    assert len(candidates) == 64 and sum(one["same_as"] is None for one in candidates) == 24
    assert record["versions"]["numpy"] == np.__version__


def test_the_id_is_of_the_records_and_of_what_the_store_says_of_itself(mixed_build):
    store = open_store(mixed_build.store)
    said = {n: v for n, v in store.attributes.items() if n not in ("manifest", "segments")}
    digest = hashlib.sha256(json.dumps(said, sort_keys=True, separators=(",", ":")).encode())
    for line in sorted(lines_of(mixed_build), key=lambda line: json.loads(line)["asset_id"]):
        digest.update(hashlib.sha256(line).digest())
    assert digest.hexdigest() == mixed_build.build_id


def said() -> dict[str, Any]:
    """Attributes of a store, written out."""
    span = {"log10": True, "lo": 2.0, "hi": 5.0, "source": "pixie"}
    # As JSON has them: in no order.
    ranges = {"hue": {**span, "log10": False, "lo": -1.0, "hi": 1.0}, "density": span}
    parameters = {"align": {"radius": 1.5}, "sample": {"method": "nearest"}}
    return {
        "format": "slatprep-store", "format_version": 1, "resolution": 64, "manifest": BUILD_ID,
        "material_classes": list(PIXIEVERSE.classes), "normalization": ranges,
        "property_columns": ["density", "hue"], "property_units": ["kg/m^3", "1"],
        "latents": {"encoder": "trellis", "channels": 8, "resolution": 64},
        "build": {"parameters": parameters, "versions": {"slatprep": "0"}},
    }  # fmt: skip


def read(attributes: dict[str, Any]) -> RootAttributes:
    found = read_attributes(attributes)
    assert isinstance(found, RootAttributes), found
    return found


def test_ranges_and_tables_are_in_the_order_of_the_columns():
    found = read(said())
    spans = [(one.name, one.log10, one.lo, one.hi) for one in found.ranges.ranges]
    assert spans == [("density", True, 2.0, 5.0), ("hue", False, -1.0, 1.0)]
    assert found.ranges.source == "pixie"
    density, hue = Property("density", "kg/m^3", True), Property("hue", "1", False)
    assert found.contents.properties == (density, hue)
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
SAME = "property_columns and normalization must name the same properties"


@pytest.mark.parametrize(("path", "value", "what", "expected"), [
    ("format", "other", "format is 'other'", "'slatprep-store'"),
    ("format_version", 2, "format_version is 2", "1"),
    ("normalization/hue/lo", "1", "normalization/hue/lo is '1'", "a valid number"),
    ("normalization/hue/log10", "yes", "normalization/hue/log10 is 'yes'", "a valid boolean"),
    ("normalization/hue/hi", -1.0, "normalization/hue is {", "lo must be less than hi"),
    ("property_columns", ["density", "density"], " is {", SAME),
    ("property_columns", ["density", "hue", "hue"], " is {", SAME),
    ("property_columns", ["density", "taste"], " is {", SAME),
    ("property_units", ["1"], " is {", "property_units must have a unit for each of"),
    ("latents/mean", [0.0], "latents is {", "a mean and a std above 0 for each of 8"),
    ("latents/channels", 0, "latents/channels is 0", ""),
    ("property_columns/0", "E [Pa]", "property_columns/0 is 'E [Pa]'", ""),
    ("manifest", LONG, f"manifest is '{LONG[:99]}", ""),
    ("manifest", GONE, "manifest is missing", ""),
    ("build/versions", GONE, "build/versions is missing", ""),
    ("build/parameters", GONE, "build/parameters is missing", ""),
    ("build/parameters", 5, "build/parameters is 5", ""),
    ("build/parameters", {"sample": 5}, "build/parameters", ""),
    ("build/parameters", {"sample": None}, "build/parameters", ""),
])  # fmt: skip
def test_what_is_wrong_is_told_by_its_name(path, value, what, expected):
    found = read_attributes(placed(said(), path, value))
    assert isinstance(found, tuple)
    assert len(found) == 1 or path == "build/parameters"
    for finding in found:
        assert finding.file == "zarr.json"
        assert finding.what.startswith(f"attribute {what}")
        assert len(finding.what) <= len(f"attribute {path} is ") + 100
        assert finding.expected.startswith(expected)


def test_every_fault_is_told():
    found = read_attributes(placed(placed(said(), "manifest", GONE), "resolution", 32))
    told = {"attribute manifest is missing", "attribute resolution is 32"}
    assert {one.what for one in found} == told


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
    assert segments_of([]) == segments_of(["b"]) == segments_of(["a", "b", "c"]) == [0]
    assert segments_of(["c", "a", "b", "a", "z"]) == [0, 1, 3]

import hashlib
import json
from dataclasses import replace
from math import nan

import jsonschema
import numpy as np
import pytest

from slatprep.pipeline.dataset import BuildSummary
from slatprep.store import open_store
from slatprep.store.record import AssetRecord, FailedRecord
from slatprep.store.record_json import (
    FOLDER,
    RecordError,
    adapter_of,
    json_schemas,
    read_asset_record,
    read_build_record,
    to_json,
)


def lines_of(build: BuildSummary) -> list[bytes]:
    return build.records.read_bytes().splitlines()


@pytest.fixture
def record(mixed_build: BuildSummary) -> AssetRecord:
    return read_asset_record(lines_of(mixed_build)[0], "here")


def no_constants(name: str) -> None:
    raise AssertionError(f"{name} is not JSON")


def test_every_record_follows_the_published_schema(mixed_build):
    published = {path.name: json.loads(path.read_text()) for path in FOLDER.iterdir()}
    for schema in published.values():
        jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(published["asset_record.schema.json"])
    lines = lines_of(mixed_build)
    assert len(lines) == 5
    build = json.loads((mixed_build.records.parent / "build.json").read_text())
    assert [one["asset_id"] for one in build["failed"]] == ["lone", "torn"]
    for record in (*(json.loads(line, parse_constant=no_constants) for line in lines),
                   *build["failed"]):  # fmt: skip
        validator.validate(record)
    jsonschema.Draft202012Validator(published["build_record.schema.json"]).validate(build)
    assert build["id"] == mixed_build.build_id
    assert build["statuses"] == mixed_build.statuses


def test_the_published_schemas_are_those_of_the_classes():
    """Made anew by ``python -m slatprep.store.record_json``."""
    assert json_schemas() == {path.name: json.loads(path.read_text()) for path in FOLDER.iterdir()}


def test_what_is_written_is_read_again_bit_for_bit(mixed_build):
    for line in lines_of(mixed_build):
        again = read_asset_record(line, "here")
        assert to_json(again) == line
        assert again.alignment.transform.tolist() == json.loads(line)["alignment"]["transform"]
    file = mixed_build.records.parent / "build.json"
    build = read_build_record(file.read_bytes(), "here")
    assert to_json(build, indent=True) + b"\n" == file.read_bytes()


def place(document: dict, path: str, value: object) -> dict:
    """Return a document with the value at ``a/0/b`` replaced; None removes it."""
    changed = json.loads(json.dumps(document))
    *steps, last = [int(step) if step.isdigit() else step for step in path.split("/")]
    at = changed
    for step in steps:
        at = at[step]
    if value is None:
        del at[last]
    else:
        at[last] = value
    return changed


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("status", "fine"),
        ("status", "failed"),
        ("status", None),
        ("format_version", 2),
        ("asset_id", ""),
        ("alignment", None),
        ("alignment/engine", "magic"),
        ("alignment/transform/3", None),
        ("alignment/transform/0/0", "1"),
        ("alignment/quality/fitness", 1.5),
        ("alignment/quality/fitness", -0.1),
        ("alignment/quality/surplus", 1),
        ("alignment/candidates/0/index", -1),
        ("alignment/candidates/0/index", 0.5),
        ("judgement/verdict", "splendid"),
        ("sources", []),
        ("sources/0/role", "photo"),
        ("sources/0/sha256", "beef"),
        ("parameters/align/radius", "1"),
        ("parameters/sample/surplus", 1),
        ("counts/valid", -1),
        ("versions", None),
        ("versions/numpy", None),
        ("code", "0" * 63),
        ("key", ""),
        ("surplus", 1),
    ],
)
def test_what_is_no_record_is_refused_and_named(record, path, value):
    document = json.loads(to_json(record))
    changed = place(document, path, value)
    with pytest.raises(RecordError, match=r"^a\.jsonl, line 3: not a record") as refused:
        read_asset_record(json.dumps(changed), "a.jsonl, line 3")
    assert refused.value.faults[0].startswith(path.rpartition("/")[0])
    if path != "versions/numpy":  # That certain keys must be there, JSON Schema cannot say.
        schema = json_schemas()["asset_record.schema.json"]
        assert not jsonschema.Draft202012Validator(schema).is_valid(changed)


def test_a_failed_asset_has_a_reason(mixed_build):
    build = json.loads((mixed_build.records.parent / "build.json").read_text())
    (skipped,) = (json.dumps(one) for one in build["failed"] if one["asset_id"] == "lone")
    assert adapter_of(FailedRecord).validate_json(skipped, strict=True).reason
    with pytest.raises(ValueError, match="reason"):
        adapter_of(FailedRecord).validate_json(json.dumps(json.loads(skipped) | {"reason": ""}))
    with pytest.raises(RecordError):
        read_asset_record(skipped, "here")


def test_text_that_is_no_json_is_refused():
    for text in ("", "{", "[]", "null", '{"status": NaN}', b"\xff"):
        with pytest.raises(RecordError):
            read_asset_record(text, "here")


def test_nan_is_null(record):
    unknown = replace(record, alignment=replace(record.alignment, score=nan))
    assert json.loads(to_json(unknown))["alignment"]["score"] is None
    again = read_asset_record(to_json(unknown), "here")
    assert np.isnan(again.alignment.score)
    assert to_json(again) == to_json(unknown)


def test_a_record_names_what_the_row_was_made_from(mixed, mixed_build):
    records = [json.loads(line) for line in mixed_build.records.read_text().splitlines()]
    record = next(record for record in records if record["asset_id"] == "bear.side")
    assert (record["object_id"], record["view"]) == ("bear", "side")
    sources = {source["role"]: source for source in record["sources"]}
    for role, root, path in (
        ("grid", "pixieverse", "bear/sample_0/material_grid.npy"),
        ("slat", "slat", "bear/side.npz"),
    ):
        content = (mixed.root / root / path).read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        assert sources[role] == {"role": role, "path": path, "size": len(content), "sha256": digest}
    alignment = record["alignment"]
    assert len(alignment["candidates"]) == 64
    assert len({c["same_as"] for c in alignment["candidates"] if c["same_as"] is not None}) <= 24
    assert sum(c["same_as"] is None for c in alignment["candidates"]) == 24
    assert record["versions"]["numpy"] == np.__version__


def test_the_id_is_of_the_records_and_of_what_the_store_says_of_itself(mixed_build):
    store = open_store(mixed_build.store)
    said = {n: v for n, v in store.attributes.items() if n not in ("manifest", "segments")}
    digest = hashlib.sha256(json.dumps(said, sort_keys=True, separators=(",", ":")).encode())
    for line in sorted(lines_of(mixed_build), key=lambda line: json.loads(line)["asset_id"]):
        digest.update(hashlib.sha256(line).digest())
    assert digest.hexdigest() == mixed_build.build_id

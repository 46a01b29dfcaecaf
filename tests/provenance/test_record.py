import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.synthetic import Dataset

from slatprep.pipeline.dataset import BuildSummary
from slatprep.provenance.jsonable import jsonable
from slatprep.provenance.record import load_schema, write_records
from slatprep.storage.atomic import staged

SCHEMAS = ("asset_record", "build_record")
PUBLISHED = Path(__file__).parents[2] / "manifests" / "schema"


def no_constants(name: str) -> None:
    raise AssertionError(f"{name} is not JSON")


def test_every_record_follows_the_schema(mixed_build: BuildSummary) -> None:
    validator = jsonschema.Draft202012Validator(load_schema("asset_record"))
    lines = mixed_build.records.read_text().splitlines()
    assert len(lines) == 7
    for line in lines:
        validator.validate(json.loads(line, parse_constant=no_constants))
    build = json.loads((mixed_build.records.parent / "build.json").read_text())
    jsonschema.Draft202012Validator(load_schema("build_record")).validate(build)
    assert build["id"] == mixed_build.manifest
    assert build["statuses"] == mixed_build.statuses


def test_the_schema_refuses_what_is_no_record(mixed_build: BuildSummary) -> None:
    validator = jsonschema.Draft202012Validator(load_schema("asset_record"))
    record = json.loads(mixed_build.records.read_text().splitlines()[0])
    for change in (
        {"status": "fine"},
        {"status": "failed"},
        {"alignment": None},
        {"sources": []},
        {"surplus": 1},
        {"duration_s": -1},
    ):
        assert not validator.is_valid({**record, **change}), change
    del record["versions"]
    assert not validator.is_valid(record)


@pytest.mark.parametrize("name", SCHEMAS)
def test_the_published_schema_is_the_one_used(name: str) -> None:
    jsonschema.Draft202012Validator.check_schema(load_schema(name))
    published = json.loads((PUBLISHED / f"{name}.schema.json").read_text())
    assert published == load_schema(name)


def test_a_record_names_what_the_row_was_made_from(
    mixed: Dataset, mixed_build: BuildSummary
) -> None:
    import hashlib

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


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.tuples(inner),
        max_leaves=20,
    )
)
def test_anything_jsonable_is_json(value: object) -> None:
    json.dumps(jsonable(value), allow_nan=False)


def test_not_a_number_is_null_and_arrays_are_lists() -> None:
    value = {"a": np.array([1.0, np.nan]), "b": np.float32(np.inf), "c": np.int64(3)}
    assert jsonable(value) == {"a": [1.0, None], "b": None, "c": 3}
    with pytest.raises(TypeError, match="object"):
        jsonable(object())


def test_a_crash_while_writing_leaves_the_old_file_whole(tmp_path: Path) -> None:
    target = tmp_path / "records.jsonl"
    target.write_text("old\n")

    def torn() -> object:
        yield {"asset_id": "a"}
        raise OSError("No space left on device")

    with pytest.raises(OSError, match="No space"), staged(target) as file:
        write_records(file, torn())
    assert target.read_text() == "old\n"
    assert list(tmp_path.iterdir()) == [target]


def test_the_id_is_of_the_content_alone(tmp_path: Path) -> None:
    def id_of(**change: object) -> str:
        record = {"asset_id": "a", "status": "ok", "duration_s": 1.0, "reason": ""}
        return write_records(tmp_path / "r.jsonl", [{**record, **change}])

    assert id_of(duration_s=2.0) == id_of()
    assert id_of(status="failed", reason="/here: bad") == id_of(status="failed", reason="/t: bad")
    assert id_of(asset_id="b") != id_of()

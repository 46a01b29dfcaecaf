"""Whatever is wrong with a store is found, and named."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.commands import document, refused, run
from support.faults import flip
from support.made_store import edit_json, rewrite

from slatprep.errors import StoreError
from slatprep.inspect.verify import Finding, SourceRoots, verify_store
from slatprep.inspect.verify.manifests import manifest_findings
from slatprep.store import open_store


@pytest.fixture
def store(copy: Path) -> Path:
    return copy


def found(store: Path, **options: object) -> tuple[Finding, ...]:
    return verify_store(store, **options).findings


def of_file(findings: tuple[Finding, ...], file: str) -> list[Finding]:
    return [finding for finding in findings if finding.file == file]


def test_a_sound_store_has_no_findings(mixed_build):
    one, two = (verify_store(mixed_build.store, jobs=jobs) for jobs in (1, 2))
    assert one.ok
    assert one == two
    assert one.assets == 5
    assert one.files > 50
    assert one.manifests == mixed_build.records.parent


def test_a_sample_is_looked_at_and_nothing_else(store):
    assert verify_store(store, sample=2).assets == 2
    assert verify_store(store, sample=9).assets == 5
    ids = open_store(store).ids
    for row, known in ((1, True), (0, False)):  # Of five, two at even steps are the second, fourth.
        first = int(open_store(store).offsets[row])
        rewrite(store, "voxel/distance", slice(first, first + 1), -1.0)
        named = {finding.asset for finding in found(store, sample=2)}
        assert (ids[row] in named) is known
    assert ids[0] in {finding.asset for finding in found(store)}


SHARDS = [
    "voxel/coords/c/0/0",
    "voxel/feats/c/1/0",
    "voxel/properties/c/0/0",
    "voxel/material/c/0",
    "voxel/valid/c/0",
    "voxel/distance/c/1",
    "grid/properties/c/0/0/0/0/0",
    "grid/material/c/1/0/0/0",
]


@pytest.mark.parametrize(
    ("name", "byte", "what"),
    [
        *((name, 20, "chunk 0 is damaged") for name in SHARDS),
        *((name, -6, "no sound index") for name in SHARDS[::3]),
    ],
)
def test_a_flipped_bit_names_the_file_and_the_assets(store, name, byte, what):
    flip(store / name, byte, 3)
    findings = of_file(found(store), name)
    assert any("its bytes changed" in finding.what for finding in findings)
    assert any(finding.asset and what in finding.what for finding in findings)


def test_truncated_shards_are_found(store):
    sizes = {name: (store / name).stat().st_size for name in SHARDS}
    for name in SHARDS:
        os.truncate(store / name, sizes[name] - 7)
    all_found = found(store)
    for name, size in sizes.items():
        said = [finding.what for finding in of_file(all_found, name)]
        assert f"was cut short: it has {size - 7} of {size} bytes" in said


@pytest.mark.parametrize(
    "names", [SHARDS, ["asset/id/c/0"], ["asset/fitness/c/0"], ["asset/zarr.json"]]
)
def test_deleted_files_are_found(store, names):
    for name in names:
        (store / name).unlink()
    all_found = found(store)
    for name in names:
        findings = of_file(all_found, name)
        assert any(finding.what.startswith("is missing") for finding in findings), name


def test_swapped_shards_are_named_as_such(store):
    """Each is sound in itself: every checksum within is right."""
    first, second = store / "voxel/feats/c/0/0", store / "voxel/feats/c/1/0"
    first.rename(store / "aside")
    second.rename(first)
    (store / "aside").rename(second)
    findings = found(store)
    sizes = first.stat().st_size, second.stat().st_size
    assert [f.file for f in findings] == ["voxel/feats/c/0/0", "voxel/feats/c/1/0"]
    if sizes[0] == sizes[1]:
        assert findings[0].what == "holds what belongs in voxel/feats/c/1/0"


def test_an_extra_file_is_found(store):
    shutil.copy(store / "voxel/feats/c/1/0", store / "voxel/feats/c/99")
    (finding,) = found(store)
    assert finding.file == "voxel/feats/c/99"
    assert finding.what == "belongs to no array"


def test_a_link_in_place_of_a_file_is_found(store, tmp_path):
    shard = store / "voxel/feats/c/1/0"
    shard.rename(tmp_path / "elsewhere")
    shard.symlink_to(tmp_path / "elsewhere")
    (finding,) = found(store)
    assert finding.file == "voxel/feats/c/1/0"
    assert finding.what == "is a link"


@pytest.mark.parametrize(
    ("array", "rows", "value", "what"),
    [
        ("voxel/coords", 3, (64, 0, 0), "a coordinate above 63"),
        ("voxel/feats", (5, 2), np.inf, "NaN or infinite"),
        ("voxel/properties", (4, 1), 1.5, "a property that does not go with valid"),
        ("voxel/properties", (4, 1), np.nan, "a property that does not go with valid"),
        ("voxel/properties", (4, 1), 0.123, "1 of "),
        ("voxel/material", 4, 5, "1 of "),
        ("voxel/material", 4, 7, "a class that does not go with valid"),
        ("voxel/distance", 4, -1.0, "negative or NaN"),
        ("voxel/distance", 4, 2.5, "1 of "),
        ("grid/material", (0, 0, 0, 0), 9, "an unknown class"),
        ("grid/properties", (0, 0, 0, 0, 0), 0.5, "a property that does not go with grid"),
        ("asset/offset", 1, -5, "-5 rows"),
        ("asset/transform", (0, 1, 1), np.nan, "is no similarity transform"),
        ("asset/transform", (0, 0, 3), np.inf, "is no similarity transform"),
        ("asset/fitness", 0, 1.5, "is 1.5"),
        ("asset/verdict", 0, "fine", "'fine'"),
        ("asset/id", 0, "zebra", "comes after 'zebra'"),
        ("asset/id", 1, "ant", "occurs twice"),
        ("asset/id", 0, "../../a", "is '../../a'"),
        ("asset/id", 0, "a\x1b[2J", "is 'a\\x1b[2J'"),
        ("asset/id", 0, "a" * 600, "is 'aaa"),
        ("asset/view", 1, "/etc", "is '/etc'"),
        ("asset/object_id", 1, "", "is ''"),
        ("asset/engine", 0, "other", "'other'"),
    ],
)
def test_values_out_of_the_contract_are_found(store, array, rows, value, what):
    rewrite(store, "asset/model", 0, "similarity")
    rewrite(store, array, rows, value)
    findings = of_file(found(store), array)
    assert any(what in f.what and (f.asset or "offset" in array) for f in findings), findings


def test_a_voxel_that_is_not_valid_but_labelled_is_found(store):
    rewrite(store, "voxel/valid", 4, False)
    files = {finding.file for finding in found(store) if finding.asset == "ant"}
    assert {"voxel/material", "voxel/properties"} <= files


def test_another_confidence_of_a_voxel_is_found(store):
    asset = open_store(store).asset("ant")
    assert asset.valid[7] and abs(asset.confidence[7] - 0.5) > 0.1
    rewrite(store, "voxel/confidence", 7, 0.5)
    findings = of_file(found(store), "voxel/confidence")
    assert [(f.asset, f.what) for f in findings] == [
        ("ant", f"1 of {len(asset.coords)} voxels differ")
    ]
    assert "today's code" not in findings[0].expected


def test_a_confidence_that_other_code_made_is_told_as_such(store):
    """Each release may have weights of its own."""
    record = json.loads(str(open_store(store).read_rows("asset/record", 0, 1)[0]))
    rewrite(store, "asset/record", 0, json.dumps(record | {"code": "0" * 64}))
    rewrite(store, "voxel/confidence", 7, 0.5)
    (finding,) = of_file(found(store), "voxel/confidence")
    assert "by today's code; another made the store" in finding.expected


def test_a_row_that_its_record_does_not_tell_of_is_found(store):
    rewrite(store, "asset/fitness", 0, 0.123)
    findings = [f for f in found(store) if f.file == "asset/record"]
    assert [(f.asset, f.what.startswith("fitness is ")) for f in findings] == [("ant", True)]


def test_a_record_that_breaks_its_schema_is_found(store):
    record = json.loads(str(open_store(store).read_rows("asset/record", 1, 2)[0]))
    record["sources"][0]["sha256"] = "beef"
    rewrite(store, "asset/record", 1, json.dumps(record))
    findings = of_file(found(store), "asset/record")
    assert [f.asset for f in findings] == ["bear.front"], findings
    assert findings[0].what.startswith("sources/0/sha256: String should match pattern")
    assert "found 'beef'" in findings[0].what


@pytest.mark.parametrize(
    ("group", "key"), [("sources", "size"), ("candidates", "index"), ("counts", "valid")]
)
def test_a_number_beyond_counting_is_a_finding(store, group, key):
    record = json.loads(str(open_store(store).read_rows("asset/record", 0, 1)[0]))
    place = record["alignment"][group] if group == "candidates" else record[group]
    (place[0] if isinstance(place, list) else place)[key] = 10**30
    rewrite(store, "asset/record", 0, json.dumps(record))
    assert any(key in f.what for f in of_file(found(store), "asset/record"))


def test_a_coordinate_beyond_the_grid_is_refused_wherever_an_asset_is_read(store, tmp_path):
    rewrite(store, "voxel/coords", 3, 70)
    with pytest.raises(StoreError, match=r"voxel/coords: a coordinate above 63; expected 0 to 63"):
        open_store(store).asset("ant")
    for words in (
        ("check-alignment", "--store", store, "--asset", "ant", "--picture", "none"),
        ("export", store, "--format", "ply", "--out", tmp_path / "x"),
    ):
        assert "a coordinate above 63" in refused(*words, code=1)


@pytest.mark.parametrize(
    ("edit", "what"),
    [
        (lambda d: d["attributes"].update(resolution=32), "attribute resolution is 32"),
        (lambda d: d["attributes"].update(manifest="0" * 64), "the attributes changed"),
        (lambda d: d["attributes"]["normalization"]["density"].update(lo=99), "normalization"),
        (lambda d: d["attributes"]["build"].update(name="other"), "the attributes changed"),
        (lambda d: d.pop("consolidated_metadata"), "has no consolidated metadata"),
        *((lambda d, these=these: d["attributes"].update(segments=these), "segments")
          for these in ([0, 4, 4], [0, 1], [], [0.0], [False], None, "0")),
    ],
)  # fmt: skip
def test_edited_root_metadata_are_found(store, edit, what):
    edit_json(store / "zarr.json", edit)
    assert any(what in finding.what for finding in of_file(found(store), "zarr.json"))


def test_a_root_that_is_no_json_is_a_finding(store):
    (store / "zarr.json").write_text("{")
    assert [finding.file for finding in found(store)] == ["zarr.json"]


def test_an_edited_repetition_within_the_consolidated_metadata_is_found(store):
    def edit(document: dict) -> None:
        copy = document["consolidated_metadata"]["metadata"]["voxel"]
        copy["consolidated_metadata"]["must_undurstand"] = False

    edit_json(store / "zarr.json", edit)
    findings = of_file(found(store), "voxel/zarr.json")
    assert any("differs from its copy" in finding.what for finding in findings)


@pytest.mark.parametrize(
    ("key", "value"),
    [("shape", [7]), ("data_type", "float32"), ("dimension_names", ["row"]), ("fill_value", 1.0)],
)
def test_edited_metadata_of_an_array_are_found(store, key, value):
    edit_json(store / "asset/fitness/zarr.json", lambda document: document.update({key: value}))
    findings = of_file(found(store), "asset/fitness/zarr.json")
    assert any("differs from its copy" in finding.what for finding in findings)


def forged(store: Path, array: str, edit: Callable[[dict], object]) -> tuple[Finding, ...]:
    """Edit both copies of an array's metadata, and return what is found."""

    def both(root: dict) -> None:
        edit(root["consolidated_metadata"]["metadata"][array])

    edit_json(store / "zarr.json", both)
    edit_json(store / array / "zarr.json", edit)
    return found(store)


def the_codec(metadata: dict, name: str) -> dict:
    inner = metadata["codecs"][0].get("configuration", {}).get("codecs", metadata["codecs"])
    return next(codec for codec in inner if codec["name"] == name)


@pytest.mark.parametrize(
    ("array", "edit", "what"),
    [
        ("asset/fitness", lambda d: d["chunk_grid"].update(name=1e-320), "chunk_grid is"),
        ("asset/fitness", lambda d: d["chunk_grid"].update(more=1), "chunk_grid is"),
        ("asset/fitness", lambda d: d["chunk_key_encoding"].update(name="v2"), "chunk_key_enc"),
        ("asset/fitness", lambda d: d.pop("chunk_key_encoding"), "chunk_key_encoding is None"),
        ("asset/fitness", lambda d: d.update(strange={}), "has 'strange'"),
        ("asset/fitness", lambda d: d.update(fill_value=0.5), "fill_value is 0.5"),
        ("asset/fitness", lambda d: the_codec(d, "zstd")["configuration"].update(level={}), "zstd"),
        ("voxel/feats", lambda d: the_codec(d, "blosc")["configuration"].update(clevel=True), "bl"),
        ("voxel/feats", lambda d: the_codec(d, "blosc")["configuration"].update(cname=7), "blosc"),
        ("voxel/feats", lambda d: the_codec(d, "blosc").update(configuration=[]), "blosc"),
        ("voxel/feats", lambda d: the_codec(d, "crc32c").update(configuration={"x": 1}), "crc32c"),
        ("voxel/feats", lambda d: d["codecs"][0]["configuration"].update(more=0), "sharding"),
        ("asset/property", lambda d: the_codec(d, "zstd").update(configuration={}), "zstd"),
    ],
)
def test_forged_metadata_of_an_array_are_found(store, array, edit, what):
    findings = of_file(forged(store, array, edit), f"{array}/zarr.json")
    assert any(what in finding.what for finding in findings), findings


def test_edited_manifests_are_found(store):
    records = store.with_suffix(".manifests") / "assets.jsonl"
    lines = records.read_text().splitlines()
    records.write_text("\n".join(line.replace('"cup"', '"cop"') for line in lines) + "\n")
    findings = of_file(found(store), str(records))
    assert [(one.asset, one.what) for one in findings] == [
        ("cup", f"line {open_store(store).ids.index('cup') + 1} differs from asset/record")
    ]


OF_THE_STORE: list[tuple[str, object]] = [
    ("id", "0" * 64),
    ("name", "another"),
    ("verdicts/good", 9),
    ("statuses/ok", 1),
    ("counts/voxels", 1),
    ("counts/valid", 1),
    ("counts/unphysical", 1),
    ("counts/clipped/density", 1),
    ("normalization/ranges/0/lo", 1.0),
    ("versions/numpy", "0"),
    ("parameters/align/radius", 2.0),
    ("parameters/store/voxel_chunk", 1),
]
"""Entries of build.json that the store says as well, and others."""


def test_what_build_json_says_of_the_store_is_compared(store):
    build, opened = store.with_suffix(".manifests") / "build.json", open_store(store)
    sound = build.read_text()
    for entry, value in OF_THE_STORE:
        *steps, last = (int(step) if step.isdigit() else step for step in entry.split("/"))
        document = whole = json.loads(sound)
        for step in steps:
            document = document[step]
        assert document[last] != value
        document[last] = value
        build.write_text(json.dumps(whole))
        assert [one.file for one in manifest_findings(opened, build.parent)] == [str(build)], entry


def test_changed_and_missing_sources_are_found(store, mixed, tmp_path):
    parameters = mixed.parameters()
    roots = SourceRoots(tmp_path / "pixieverse", tmp_path / "slat")
    shutil.copytree(parameters.pixieverse.root, roots.pixieverse)
    shutil.copytree(parameters.slat.root, roots.slat)
    result = verify_store(store, sources=True, roots=roots)
    assert result.ok
    assert result.sources == 10
    grid, slat = roots.pixieverse / "ant/sample_0/material_grid.npy", roots.slat / "cup.npz"
    flip(grid, 1000)
    slat.unlink()
    findings = found(store, sources=True, roots=roots)
    assert [(f.file, f.asset, f.what) for f in findings] == [
        (str(grid), "ant", "its bytes changed"),
        (str(slat), "cup", "does not exist"),
    ]


def test_a_second_look_remembers_nothing_of_the_first(store, mixed, tmp_path):
    parameters = mixed.parameters()
    roots = SourceRoots(parameters.pixieverse.root, tmp_path / "slat")
    shutil.copytree(parameters.slat.root, roots.slat)
    assert verify_store(store, roots=roots, sources=True).ok
    slat = roots.slat / "ant.npz"
    times = slat.stat().st_atime_ns, slat.stat().st_mtime_ns
    flip(slat, 300)
    os.utime(slat, ns=times)
    rewrite(store, "asset/id", 4, "zebra")
    findings = found(store, roots=roots, sources=True)
    assert {"its bytes changed"} <= {f.what for f in of_file(findings, str(slat))}
    assert any(finding.asset == "zebra" for finding in findings)


def test_sources_that_nobody_knows_of_are_asked_for(store):
    shutil.rmtree(store.with_suffix(".manifests"))
    assert verify_store(store).ok
    with pytest.raises(StoreError, match="--pixieverse and --slat"):
        verify_store(store, sources=True)


def test_the_command_names_findings_and_sets_the_exit_code(store):
    assert run("verify", store, "-q").stdout == f"{store}: nothing is wrong\n"
    (store / "voxel/feats/c/1/0").unlink()
    told = document("verify", store, "-q", code=1)
    assert told["ok"] is False
    assert {"voxel/feats/c/1/0"} == {finding["file"] for finding in told["findings"]}

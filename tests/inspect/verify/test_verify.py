"""Whatever is wrong with a store is found, and named."""

import gc
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import document, refused, run
from support.faults import flip
from support.made_store import edit_json, edit_record, placed, rewrite
from support.shapes import surface_latents

from slatprep import StoreError, build_store, open_store
from slatprep.inspect.verify import Finding, SourceRoots, index_findings, verify_store
from slatprep.inspect.verify.manifests import manifest_findings
from slatprep.pipeline.join import subset_store
from slatprep.store.integrity import file_findings


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


def test_a_store_that_is_replaced_meanwhile_is_not_called_damaged(store, tmp_path, monkeypatch):
    """The digests are those of the store that was opened."""
    subset_store(store, tmp_path / "other.zarr", [0])

    def replaced(*given: Any) -> Any:
        store.rename(tmp_path / "older.zarr")
        (tmp_path / "other.zarr").rename(store)
        return file_findings(*given)

    monkeypatch.setattr("slatprep.inspect.verify.file_findings", replaced)
    with pytest.raises(StoreError, match="was the store replaced"):
        verify_store(store)


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


@pytest.mark.parametrize(("name", "byte", "what"), [
    *((name, 20, "chunk 0 is damaged") for name in SHARDS),
    *((name, -6, "no sound index") for name in SHARDS[::3]),
])  # fmt: skip
def test_a_flipped_bit_names_the_file_and_the_assets(store, name, byte, what):
    flip(store / name, byte, 3)
    findings = of_file(found(store), name)
    assert any("its bytes changed" in finding.what for finding in findings)
    assert any(finding.asset and what in finding.what for finding in findings)


@pytest.mark.parametrize(
    ("names", "cut"),
    [(SHARDS, 7), ([*SHARDS, "asset/fitness/c/0"], 0), (["asset/id/c/0", "asset/zarr.json"], 0)],
)
def test_files_that_were_cut_short_or_deleted_are_found(store, names, cut):
    sizes = {name: (store / name).stat().st_size for name in names}
    for name in names:
        os.truncate(store / name, sizes[name] - cut) if cut else (store / name).unlink()
    all_found = found(store)
    for name, size in sizes.items():
        told = f"was cut short: it has {size - cut} of {size} bytes" if cut else "is missing"
        assert any(one.what.startswith(told) for one in of_file(all_found, name)), name


def test_swapped_shards_extra_files_and_links_are_named_as_such(store, tmp_path):
    """Each shard is sound in itself: every checksum within is right."""
    first, second = store / "voxel/feats/c/0/0", store / "voxel/feats/c/1/0"
    shutil.copy(second, store / "voxel/feats/c/99")
    first.rename(store / "aside")
    second.rename(first)
    (store / "aside").rename(second)
    linked = store / "voxel/distance/c/1"
    linked.rename(tmp_path / "elsewhere")
    linked.symlink_to(tmp_path / "elsewhere")
    told = {finding.file: finding.what for finding in found(store)}
    of_first, _ = (told.pop(f"voxel/feats/c/{k}/0") for k in (0, 1))
    if first.stat().st_size == second.stat().st_size:
        assert of_first == "holds what belongs in voxel/feats/c/1/0"
    others = {"voxel/feats/c/99": "belongs to no array", "voxel/distance/c/1": "is a link"}
    assert told == others


OUT_OF_THE_CONTRACT: list[list[tuple[str, Any, object, str]]] = [
    [
        ("voxel/properties", (0, 4, 1), 0.123, "1 of "),
        ("voxel/material", (0, 5), 5, "1 of "),
        ("voxel/distance", (0, 6), 2.5, "1 of "),
        ("voxel/coords", (1, 3), (64, 0, 0), "a coordinate above 63"),
        ("voxel/properties", (2, 4, 1), np.nan, "a property that does not go with valid"),
        ("voxel/coords", (3, 0), (1, 1, 1), "a coordinate occurs twice"),
        ("voxel/coords", (3, 1), (1, 1, 1), "a coordinate occurs twice"),
        ("voxel/feats", (4, 5, 2), np.inf, "NaN or infinite"),
        ("voxel/properties", (4, 4, 1), 1.5, "a property that does not go with valid"),
        ("voxel/material", (4, 4), 7, "a class that does not go with valid"),
        ("voxel/distance", (4, 4), -1.0, "negative or NaN"),
        ("grid/material", (4, 0, 0, 0), 9, "an unknown class"),
        ("grid/properties", (4, 0, 0, 0, 0), 0.5, "a property that does not go with grid"),
    ],
    [
        ("asset/transform", (0, 1, 1), np.nan, "is no similarity transform"),
        ("asset/transform", (1, 0, 3), np.inf, "is no similarity transform"),
        ("asset/transform", (2,), np.diag([-1.0, 1.0, 1.0, 1.0]), "is no similarity transform"),
        ("asset/transform", (3,), np.eye(4) + np.eye(4, k=1), "is no similarity transform"),
        ("asset/transform", (4,), np.diag([2.0, 2.0, 2.0, 1.0]), "is no rigid transform"),
        ("asset/fitness", (0,), 1.5, "is 1.5"),
        ("asset/verdict", (0,), "fine", "'fine'"),
        ("asset/engine", (0,), "other", "'other'"),
        ("asset/view", (1,), "/etc", "is '/etc'"),
        ("asset/object_id", (1,), "", "is ''"),
        ("asset/id", (4,), "d" * 600, "is 'ddd"),
    ],
    [
        ("asset/id", (1,), "a", "comes after 'ant'"),
        ("asset/id", (2,), "../../a", "is '../../a'"),
        ("asset/id", (3,), "a\x1b[2J", "is 'a\\x1b[2J'"),
        ("asset/id", (4,), "ant", "occurs twice"),
    ],
    [("asset/offset", (1,), -5, "-5 rows")],
    [("asset/offset", (1,), 0, "no voxels")],
]
"""Changes of an array by asset, and voxel or entry: those of one store do not hide each other."""


@pytest.mark.parametrize("faults", OUT_OF_THE_CONTRACT)
def test_values_out_of_the_contract_are_found(store, faults):
    starts = open_store(store).offsets.tolist()
    rewrite(store, "asset/model", slice(0, 4), "similarity")
    rewrite(store, "asset/model", 4, "rigid")
    for array, (asset, *rest), value, _ in faults:
        voxel = array.startswith("voxel/")
        at = (starts[asset] + rest[0], *rest[1:]) if voxel else (asset, *rest)
        rewrite(store, array, at, value)
    findings, ids = found(store), open_store(store).ids
    for array, (asset, *_), _, what in faults:
        told = [f for f in of_file(findings, array) if f.asset == ids[asset] or "offset" in array]
        assert any(what in finding.what for finding in told), (array, what, findings)


def test_a_voxel_that_is_not_valid_but_labelled_is_found(store):
    rewrite(store, "voxel/valid", 4, False)
    files = {finding.file for finding in found(store) if finding.asset == "ant"}
    assert {"voxel/material", "voxel/properties"} <= files


def test_another_confidence_of_a_voxel_is_found_and_told_of_as_of_other_code(store):
    """Each release may have weights of its own."""
    opened = open_store(store)
    changed = opened["ant"], opened["dog"]
    rewrite(store, "voxel/confidence", opened.offsets[[0, 4]] + 7, 0.5)
    edit_record(store, 4, lambda record: record.update(code="0" * 64))
    findings = of_file(found(store), "voxel/confidence")
    for finding, asset in zip(findings, changed, strict=True):
        assert asset.valid[7] and abs(asset.confidence[7] - 0.5) > 0.1
        told = f"1 of {len(asset.coords)} voxels differ"
        assert (finding.asset, finding.what) == (asset.asset_id, told)
        other = "by today's code; another made the store" in finding.expected
        assert other is (asset.asset_id == "dog")


def test_a_record_that_does_not_tell_of_its_row_or_breaks_its_schema_is_found(store):
    rewrite(store, "asset/fitness", 0, 0.123)
    edit_record(store, 1, lambda record: record["sources"][0].update(sha256="beef"))
    # Numbers beyond counting.
    edit_record(store, 2, lambda record: record["sources"][0].update(size=10**30))
    edit_record(store, 3, lambda record: record["alignment"]["candidates"][0].update(index=10**30))
    edit_record(store, 4, lambda record: record["counts"].update(valid=10**30))
    told = {one.asset: one.what for one in of_file(found(store), "asset/record")}
    assert told["ant"].startswith("fitness is ")
    assert told["bear.front"].startswith("sources/0/sha256: String should match pattern")
    assert "found 'beef'" in told["bear.front"]
    for asset_id, key in (("bear.side", "size"), ("cup", "index"), ("dog", "valid")):
        assert key in told[asset_id]


def test_a_coordinate_beyond_the_grid_is_refused_wherever_an_asset_is_read(store, tmp_path):
    rewrite(store, "voxel/coords", 3, 70)
    with pytest.raises(StoreError, match=r"voxel/coords: a coordinate above 63; expected 0 to 63"):
        open_store(store).asset("ant")
    for words in (
        ("check-alignment", "--store", store, "--asset", "ant", "--picture", "none"),
        ("export", store, "--format", "ply", "--out", tmp_path / "x"),
    ):
        assert "a coordinate above 63" in refused(*words, code=1)


@pytest.mark.parametrize(("edit", "what"), [
    (lambda d: d["attributes"].update(resolution=32), "attribute resolution is 32"),
    (lambda d: d["attributes"].update(manifest="0" * 64), "the attributes changed"),
    (lambda d: d["attributes"]["normalization"]["density"].update(lo=99), "normalization"),
    (lambda d: d.pop("consolidated_metadata"), "has no consolidated metadata"),
])  # fmt: skip
def test_edited_root_metadata_are_found(store, edit, what):
    edit_json(store / "zarr.json", edit)
    assert any(what in finding.what for finding in of_file(found(store), "zarr.json"))


@pytest.mark.parametrize("these", [[0, 4, 4], [0, 1], [], [0.0], [False], None, "0"])
def test_other_segments_than_the_ids_have_are_found(mixed_build, these):
    opened = open_store(str(mixed_build.store))
    assert not list(index_findings(opened))
    opened.attributes["segments"] = these
    (finding,) = index_findings(opened)
    assert finding.file == "zarr.json" and "segments" in finding.what


def test_metadata_that_differ_from_their_copy_are_found(store):
    edits = {"shape": [7], "data_type": "float32", "dimension_names": ["row"], "fill_value": 1.0}
    arrays = ("fitness", "overlap", "margin", "ambiguity")
    for array, edit in zip(arrays, edits.items(), strict=True):
        edit_json(store / f"asset/{array}/zarr.json", lambda d, edit=edit: d.update([edit]))

    def nested(document: dict) -> None:
        copy = document["consolidated_metadata"]["metadata"]["voxel"]
        copy["consolidated_metadata"]["must_undurstand"] = False

    edit_json(store / "zarr.json", nested)
    told = {finding.file for finding in found(store) if "differs from its copy" in finding.what}
    assert told >= {*(f"asset/{array}/zarr.json" for array in arrays), "voxel/zarr.json"}


FORGED: list[tuple[str, str, str, object]] = [
    ("asset/fitness", "chunk_grid", "name", 1e-320),
    ("asset/fitness_backward", "chunk_grid", "more", 1),
    ("asset/overlap", "chunk_key_encoding", "name", "v2"),
    ("asset/margin", "", "chunk_key_encoding", None),
    ("asset/ambiguity", "", "strange", {}),
    ("asset/valid_share", "", "fill_value", 0.5),
    ("asset/confidence", "the codec zstd", "level", {}),
    ("asset/property", "the codec zstd", "", {}),
    ("voxel/feats", "the codec blosc", "clevel", True),
    ("voxel/coords", "the codec blosc", "cname", 7),
    ("voxel/properties", "the codec blosc", "", []),
    ("voxel/distance", "the codec crc32c", "", {"x": 1}),
    ("voxel/material", "the codec sharding_indexed", "more", 0),
]
"""What the metadata of an array say: a part of them, its entry, or all of it, and the value."""


def test_forged_metadata_of_arrays_are_found(store):
    """Both copies of each are forged."""
    root = json.loads((store / "zarr.json").read_text())
    for array, part, key, value in FORGED:
        forged = root["consolidated_metadata"]["metadata"][array]
        outer = forged["codecs"]
        codecs = [*outer, *outer[0].get("configuration", {}).get("codecs", ())]
        parts = {f"the codec {one['name']}": one for one in codecs}
        if key and part in parts:
            parts[part]["configuration"][key] = value
        elif part in parts:
            parts[part]["configuration"] = value
        else:
            (forged[part] if part else forged)[key] = value
        (store / array / "zarr.json").write_text(json.dumps(forged))
    (store / "zarr.json").write_text(json.dumps(root))
    findings = found(store)
    for array, part, key, _ in FORGED:
        told = of_file(findings, f"{array}/zarr.json")
        assert any((part or key) in finding.what for finding in told), (array, told)


def test_edited_manifests_are_found(store):
    records = store.with_suffix(".manifests") / "assets.jsonl"
    lines = records.read_text().splitlines()
    records.write_text("\n".join(line.replace('"cup"', '"cop"') for line in lines) + "\n")
    findings = of_file(found(store), str(records))
    line = open_store(store).ids.index("cup") + 1
    told = [("cup", f"line {line} differs from asset/record")]
    assert [(one.asset, one.what) for one in findings] == told


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
    sound = json.loads(build.read_text())
    for entry, value in OF_THE_STORE:
        changed = placed(sound, entry, value)
        assert changed != sound
        build.write_text(json.dumps(changed))
        assert [one.file for one in manifest_findings(opened, build.parent)] == [str(build)], entry


def test_changed_and_missing_sources_are_found(store, mixed, tmp_path):
    own = Path(shutil.copytree(mixed.root, tmp_path / "own"))
    roots = SourceRoots(own / "pixieverse", own / "slat")
    result = verify_store(store, sources=True, roots=[roots])
    assert result.ok
    assert result.sources == 10
    grid, slat = roots.pixieverse / "ant/sample_0/material_grid.npy", roots.slat / "cup.npz"
    flip(grid, 1000)
    slat.unlink()
    assert [(f.file, f.asset, f.what) for f in found(store, sources=True, roots=[roots])] == [
        (str(grid), "ant", "its bytes changed"),
        (str(slat), "cup", "does not exist"),
    ]


def test_a_second_look_remembers_nothing_of_the_first(store, mixed, tmp_path):
    roots = SourceRoots(mixed.root / "pixieverse", tmp_path / "slat")
    shutil.copytree(mixed.root / "slat", roots.slat)
    assert verify_store(store, roots=[roots], sources=True).ok
    slat = roots.slat / "ant.npz"
    times = slat.stat().st_atime_ns, slat.stat().st_mtime_ns
    flip(slat, 300)
    os.utime(slat, ns=times)
    rewrite(store, "asset/id", 4, "zebra")
    findings = found(store, roots=[roots], sources=True)
    assert {"its bytes changed"} <= {f.what for f in of_file(findings, str(slat))}
    assert any(finding.asset == "zebra" for finding in findings)


def test_the_files_of_a_store_are_closed_after_its_sources_were_compared(store, mixed):
    roots = SourceRoots(mixed.root / "pixieverse", mixed.root / "slat")
    assert verify_store(store, roots=[roots], sources=True).ok
    gc.collect()
    opened = [path.readlink() for path in Path("/proc/self/fd").iterdir() if path.is_symlink()]
    assert not [path for path in opened if path.is_relative_to(store)]


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


def test_ties_that_change_properties_within_a_class_verify_as_they_were_built(make_dataset):
    """Of two bars one changes by exactly a factor of two, which rounding must not decide."""
    dataset = make_dataset()
    grid = np.zeros((64, 64, 64, 4), dtype=np.float32)
    grid[..., 3] = 7
    bar = np.zeros((64, 64, 64), dtype=bool)
    bar[12:52, 24:40, 28:36] = True
    latents = surface_latents(bar)
    for name, second in (("alloys", 2 * 7e10), ("metals", 2e11)):
        grid[12:52, 24:40, 28:36] = 2700.0, 7e10, 0.3, 1
        grid[32:52, 24:40, 28:36, 1] = second
        dataset.write_grid(name, grid)
        dataset.write_slat(f"{name}.npz", latents.coords, latents.feats + (name == "metals"))
    path = dataset.root / "store.zarr"
    build_store(dataset.parameters(), path)
    opened = open_store(path)
    assert opened.column("ambiguity").tolist() == [0.0, 1.0]
    assert opened.column("verdict").tolist() == ["good", "doubtful"]
    assert found(path) == ()
    half = {name: opened[name].confidence.mean() for name in opened.ids}
    assert half["metals"] == pytest.approx(half["alloys"] / 2, rel=0.1)
    rewrite(path, "voxel/confidence", slice(0, None), 0.9)
    assert {one.asset for one in of_file(found(path), "voxel/confidence")} == {"alloys", "metals"}

"""Finding pairs by name and by tables, of empty files; a wrong folder is told with a right one."""

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.commands import run
from support.memory import less_than
from support.published import pack
from support.raw_sources import COORDS, FEATS, grid, raw_grid, touch
from support.synthetic import Dataset

from slatprep.errors import ConfigError, InputError, MissingPartnerError
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import discover, read_field, read_latents
from slatprep.readers.files import require_complete
from slatprep.readers.joins import by_case, explain_unmatched
from slatprep.readers.patterns import match
from slatprep.records import AssetPair, SourceRoots
from slatprep.storage.place import storage_of

UID = "0123456789abcdef0123456789abcdef"
SHA = "ab" * 32


def test_default_layout(find, tmp_path):
    # Of the patterns of grids the first that is there counts.
    beside = ["a/clip_features_mask.npy", "a/clip_features.npz"]
    extra = [*beside, "a/sample_0_pred.npy", "readme.txt"]
    pairs = find([grid("b"), grid("a"), *extra], ["a.npz", "b.h5", "notes.txt"])
    pixie, slat = tmp_path / "pixie", tmp_path / "slat"
    roots, files = SourceRoots(pixie, slat), [pixie / name for name in (grid("a"), *beside)]
    first = AssetPair("a", "a", "", "", roots, *files, slat / "a.npz", sample="0")
    second = AssetPair("b", "b", "", "", roots, pixie / grid("b"), None, None, slat / "b.h5")
    assert pairs == [first, replace(second, sample="0")]


def test_the_root_of_trellis_s_toolkit(find, tmp_path):
    root = tmp_path / "slat"
    root.mkdir()
    (root / "metadata.csv").write_text(
        "sha256,file_identifier,aesthetic_score\n"
        f"{SHA},https://example.org/3d-models/a-chair-{UID},5.5\n"
        f"{'cd' * 32},https://example.org/3d-models/{'f' * 32},5.5\n"
        f"{'ef' * 32},,4\n"
    )
    shown = f"latents/dino/{SHA}.npz", f"ss_latents/enc/{SHA}.npz"
    (pair,) = find([grid(UID)], shown, map=root / "metadata.csv")
    assert (pair.asset_id, pair.object_id, pair.view, pair.problem) == (UID, UID, "", "")
    assert pair.slat == root / "latents/dino" / f"{SHA}.npz"
    (pair,) = find(slats=[f"latents/other/{SHA}.npz"], map=root / "metadata.csv")
    assert f"latents/dino/{SHA}.npz, latents/other/{SHA}.npz" in pair.problem


def test_several_samples_need_a_choice(find):
    files = ["a/sample_0/material_grid.npy", "a/sample_1/material_grid.npy"]
    (pair,) = find(files, ["a.npz"])
    assert "2 samples" in pair.problem
    assert all(file in pair.problem for file in files)
    assert "choose one with `sample` in the table [pixieverse]" in pair.problem
    with pytest.raises(InputError, match="asset 'a': id 'a' has 2 samples"):
        read_field(pair)

    (pair,) = find(pixieverse={"sample": "1"})
    assert pair.problem == ""
    assert pair.grid.parent.name == "sample_1"

    (pair,) = find([grid("b")], ["b.npz"], pixieverse={"sample": "1"})[1:]
    assert "looked for {id}/sample_1/material_grid.npy" in pair.problem
    with pytest.raises(ValueError, match="samples = 'one' where `sample` names"):
        find(pixieverse={"samples": "merge", "sample": "1"})


def test_the_sample_is_chosen_whatever_the_adapter(find, tmp_path):
    own = {"adapter": "vomp", "grid": ("{id}/{sample}.npz",), "sample": "2"}
    (pair,) = find(["a/1.npz", "a/2.npz"], ["a.npz"], pixieverse=own)
    assert (pair.grid, pair.problem) == (tmp_path / "pixie/a/2.npz", "")


def test_several_samples_by_number(find):
    numbers = (10, 0, 2)
    touched = [f"a/sample_{k}_{what}.npy" for k in numbers for what in ("pred", "mask")]
    touched += ["a/clip_features_mask.npy", grid("b"), "b/sample_0_mask.npy"]
    touched += ["b/clip_features_mask.npy"]
    pair, raw = find(touched, ["a.npz", "b.npz"], pixieverse={"samples": "first"})
    assert (pair.problem, pair.sample, pair.others) == ("", "0", ())
    assert raw.mask.name == "clip_features_mask.npy"  # The other is of a prediction.

    pair, _ = find(pixieverse={"samples": "merge"})
    assert [one.sample for one in pair.annotations] == ["0", "2", "10"]
    for one in pair.annotations:
        assert (one.problem, one.asset_id) == ("", "a")
        assert one.grid.name == f"sample_{one.sample}_pred.npy"
        assert one.mask.name == f"sample_{one.sample}_mask.npy"
        assert one.slat == pair.slat


def test_each_sample_with_each_view(find):
    files = [f"a/sample_{k}/material_grid.npy" for k in (0, 1)]
    pairs = find(files, ["a/left.npz", "a/right.npz"], pixieverse={"samples": "all"})
    names = [f"a.{view}.sample_{k}" for view in ("left", "right") for k in (0, 1)]
    assert [pair.asset_id for pair in pairs] == names
    assert {pair.view for pair in pairs} == {"left", "right"}
    assert all(not pair.problem for pair in pairs)


def test_missing_partners_are_yielded_with_what_was_looked_for(find, tmp_path):
    no_slat, no_grid = find([grid("a")], ["b.npz"])
    assert no_slat.asset_id == "a"
    assert no_slat.slat is None
    assert "no SLAT for id 'a'; looked for {id}.npz, {id}.h5" in no_slat.problem
    assert no_grid.asset_id == "b"
    assert no_grid.grid is None
    assert "no grid for id 'b'; looked for {id}/sample_*/material_grid.npy" in no_grid.problem
    for pair, root in ((no_slat, "slat"), (no_grid, "pixie")):
        for read in (read_field, read_latents):
            told = f"for id '{pair.asset_id}'; looked for"
            with pytest.raises(MissingPartnerError, match=told) as caught:
                read(pair)
            # Each is told once: the folder first, the id by itself and not in each pattern.
            assert str(caught.value).startswith(f"{tmp_path / root}: ")
            assert str(caught.value).count(str(tmp_path)) == 1
            assert str(caught.value).count(f"'{pair.asset_id}'") == 1


@pytest.mark.parametrize("own", [False, True])
def test_what_an_adapter_looked_for_is_told_unless_the_definition_says_otherwise(find, own):
    grids = ["a.npz" if own else "voxels/a_with_materials.npz"]
    slats = ["b.npz" if own else "shape_latents/dino_512/b.npz"]
    vomp: dict[str, object] = {"adapter": "vomp"}
    latents: dict[str, object] = {"encoder": "trellis2-512"}
    if own:
        vomp["grid"] = latents["pattern"] = ("{id}.npz",)
    no_slat, no_grid = find(grids, slats, pixieverse=vomp, slat=latents)
    told = "{id}.npz" if own else "voxels/{id}_with_materials.npz, {id}_with_materials.npz"
    assert no_grid.problem == f"no grid for id 'b'; looked for {told}"
    told = "for {id}.npz" if own else "latents/*/{id}.npz, shape_latents/*_512/{id}.npz"
    assert no_slat.problem.startswith("no SLAT for id 'a'; looked for {id}.npz")
    assert no_slat.problem.endswith(told)


@pytest.mark.parametrize("files", [("a.npz", "a.h5"), ("a/v.npz", "a/v.h5")])
def test_two_slats_for_one_id(find, files):
    (pair,) = find([grid("a")], files)
    assert all(file in pair.problem for file in files)
    with pytest.raises(InputError, match="2 SLATs for one id 'a'"):
        read_latents(pair)


@pytest.mark.parametrize("what", ["grid", "mask"])
def test_two_files_of_a_kind_for_one_id(find, what):
    (pair,) = find(["x/a.npy", "y/a.npy", grid("a")], ["a.npz"], pixieverse={what: ("*/{id}.npy",)})
    assert re.search(f"2 {what}(s| files) for one id .*\\(x/a.npy, y/a.npy\\)", pair.problem)


def test_several_views_are_several_rows_sorted_by_asset_id(find):
    # "-" sorts before ".", so a-b comes between a and its views.
    pairs = find([grid("a"), grid("a-b"), grid("b")], ["a/2.npz", "a/1.npz", "a-b.npz", "b/1.npz"])
    assert [(p.asset_id, p.object_id, p.view, p.slat.parent.name, p.slat.name) for p in pairs] == [
        ("a-b", "a-b", "", "slat", "a-b.npz"),
        ("a.1", "a", "1", "a", "1.npz"),
        ("a.2", "a", "2", "a", "2.npz"),
        ("b", "b", "", "b", "1.npz"),
    ]
    assert not any(p.problem for p in pairs)


def test_one_asset_id_for_two_objects(find):
    pairs = find([grid("a"), grid("a.1")], ["a/1.npz", "a/2.npz", "a.1.npz"])
    assert [p.asset_id for p in pairs] == ["a.1", "a.2"]
    assert "asset id 'a.1' would stand for" in pairs[0].problem
    assert "object 'a.1'" in pairs[0].problem
    assert pairs[1].problem == ""


def test_ids_that_are_no_plain_name(find):
    names = sorted(["a b", ".a", "ä", "a\nb", "~a", "a%20", "a;b", "b\udcff"])
    for pair in find(map(grid, names), [f"{name}.npz" for name in names]):
        name = pair.grid.parents[1].name
        files = f"{f'{name}/sample_0/material_grid.npy'!r}, {f'{name}.npz'!r}"
        assert pair.problem.startswith(f"id {pair.asset_id!r} is not allowed: rename {files}, to '")
        assert "255 letters A to Z and a to z" in pair.problem
        assert "\n" not in pair.problem
        assert pair.mask is None
        assert all(c.isascii() and (c.isalnum() or c in "%._-") for c in pair.asset_id)
        names.remove(name)
    assert not names


def hdf5(path: Path, *groups: str) -> None:
    with h5py.File(path, "w") as file:
        for group in groups:
            file[f"{group}/coords"] = COORDS
            file[f"{group}/feats"] = FEATS


def test_patterns_of_masks_that_name_no_file_are_told(tmp_path):
    dataset, told = Dataset(tmp_path).having("a"), list[str]()
    for pixieverse in ({}, {"mask": []}, {"mask": ["{id}/nope.npy"], "bounds": ["one.npz"]}):
        discover(dataset.parameters(pixieverse=pixieverse), told.append)
    root = tmp_path / "pixieverse"
    assert told == [
        f"{root}: no mask found; looked for */nope.npy",
        f"{root}: no bounds found; looked for one.npz",
    ]
    dataset.having("b", seed=1)
    mask = dataset.assets["b"].grid[..., 3] != 7
    np.save(root / "b/clip_features_mask.npy", mask)
    discover(dataset.parameters(), told.append)
    without = f"{root}: 1 object without a mask (a), where background counts as empty; "
    assert told[2:] == [f"{without}others have one"]
    roots = "--pixieverse", str(root), "--slat", str(tmp_path / "slat")
    dry = run("build-store", *roots, "--out", str(tmp_path / "s.zarr"), "--dry-run")
    assert "1 object without a mask (a)" in dry.stderr
    np.save(root / "a/clip_features_mask.npy", mask)
    discover(dataset.parameters(), told.append)
    # A mask that is found counts, also that of an object without a SLAT.
    np.save(root / "b/own.npy", mask)
    (tmp_path / "slat/b.npz").unlink()
    discover(dataset.parameters(pixieverse={"mask": ["{id}/own.npy"]}), told.append)
    assert told[3:] == [f"{without}others have one"]


def test_hdf5_with_a_group_per_asset(find, tmp_path):
    hdf5(tmp_path / "all.h5", "a", "c", "bad id")
    with h5py.File(tmp_path / "all.h5", "a") as file:
        h5py.h5g.create(file.id, b"b\xff")
        file["count"] = 3
        file["b"] = h5py.SoftLink("/a")
        file["d"] = h5py.ExternalLink("other.h5", "/")
    pairs = find([grid("a"), grid("b")], slat={"root": tmp_path / "all.h5"})
    found = {p.asset_id: p for p in pairs}
    assert list(found) == ["a", "b", "b%FF", "bad%20id", "c"]
    assert found["a"].problem == ""
    assert "id 'b%FF' is not allowed: rename 'all.h5'" in found["b%FF"].problem
    assert found["a"].slat == tmp_path / "all.h5"
    assert found["a"].slat_group == "a"
    assert f"looked for group {{id}} in {tmp_path / 'all.h5'}" in found["b"].problem

    np.save(found["a"].grid, raw_grid())
    np.testing.assert_array_equal(read_latents(found["a"]).coords, COORDS)
    assert read_field(found["a"]).material.tolist() == [0, 1, 6]


def test_hdf5_groups_by_view_in_several_files(find, tmp_path):
    (tmp_path / "slat").mkdir()
    hdf5(tmp_path / "slat" / "part_0.h5", "slats/a/v1", "slats/a/v2")
    hdf5(tmp_path / "slat" / "part_1.h5", "slats/b/v1")
    (tmp_path / "slat" / "part_2.h5").write_bytes(b"\x89HDF\r\n\x1a\n broken")
    by_view = {"pattern": ("part_*.h5",), "group": "slats/{id}/{view}"}
    pairs = find([grid("a"), grid("b")], slat=by_view)
    found = {p.asset_id: p for p in pairs}
    assert list(found) == ["a.v1", "a.v2", "b", "part_2.h5"]
    assert found["a.v2"].slat_group == "slats/a/v2"
    assert found["b"].slat.name == "part_1.h5"
    assert "part_2.h5: is no readable HDF5 file" in found["part_2.h5"].problem
    np.testing.assert_array_equal(read_latents(found["b"]).feats, FEATS)


@pytest.mark.parametrize(
    "pattern", ["/{id}.npz", "../{id}.npz", "a//{id}.npz", "{name}.npz", "{id}_{id}.npz"]
)
def test_bad_patterns(find, pattern):
    with pytest.raises(ConfigError, match="pattern"):
        find([grid("a")], ["a.npz"], slat={"pattern": (pattern,)})


def test_missing_roots_and_empty_roots(find, tmp_path):
    with pytest.raises(ConfigError, match=r"no grid found; .*\*/sample_\*/mat") as caught:
        find()
    assert "{id}" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"slat: no SLAT found; looked for \*\.npz"):
        find([grid("a")])
    for side in ("pixieverse", "slat"):
        with pytest.raises(ConfigError, match="nowhere: does not exist"):
            find(**{side: {"root": tmp_path / "nowhere"}})
    touch(tmp_path, "all.h5")
    with pytest.raises(ConfigError, match=r"all\.h5: is no readable HDF5 file"):
        find(slat={"root": tmp_path / "all.h5"})


def test_a_name_that_almost_matches_in_many_ways_takes_no_time(find):
    pairs = find(slat={"pattern": ("*a*a*a*a*a*a*a*a*a*a*ab/{id}.npz", "{id}.npz")},
                 grids=[grid("a")], slats=["a" * 120 + "/x.npz", "a.npz"])  # fmt: skip
    assert [pair.asset_id for pair in pairs] == ["a"]


def test_names_match_as_a_greedy_regular_expression_would():
    """`re` is the truth: every pattern of up to five parts on every name of three letters."""
    parts = {"*": ".*", "{id}": "(?P<id>.+)", "{view}": "(?P<view>.+)", "a": "a", ".": r"\."}
    names = ["".join(letters) for n in range(6) for letters in product("a.b", repeat=n)]
    for n in range(1, 6):
        for chosen in product(parts, repeat=n):
            if chosen.count("{id}") > 1 or chosen.count("{view}") > 1:
                continue
            expression = re.compile("".join(parts[part] for part in chosen))
            for name in names[:: (1, 1, 1, 8, 32)[n - 1]]:
                expected = expression.fullmatch(name)
                found = match("".join(chosen), {}, name)
                assert found == (expected and expected.groupdict()), (chosen, name)


def test_map_by_object_and_slat_id(find, tmp_path):
    table = tmp_path / "map.csv"
    table.write_text("object_id,slat_id\na,s1\nb,s2\nb,s3\nc,gone\n")
    slats = ["s1.npz", "s2.npz", "s3.npz", "d.npz", "e.npz"]
    pairs = find([grid(name) for name in "abcd"], slats, map=table)
    found = {p.asset_id: p for p in pairs}
    assert list(found) == ["a", "b.s2", "b.s3", "c", "d", "e"]
    names = [found[i].slat.name for i in ("a", "b.s2", "b.s3", "d")]
    assert names == ["s1.npz", "s2.npz", "s3.npz", "d.npz"]
    assert "looked for gone.npz" in found["c"].problem
    assert "no grid for id 'e'" in found["e"].problem
    assert [i for i, p in found.items() if p.problem] == ["c", "e"]


def test_map_with_views(find, tmp_path):
    table = tmp_path / "map.csv"
    table.write_text("object_id,slat_id,view\na,s1,front\na,s2,back\nb,s3,v1\nb,s3,v2\n")
    pairs = find([grid("a"), grid("b")], ["s1.npz", "s2.npz", "s3/v1.npz", "s3/v2.npz"], map=table)
    assert [(p.asset_id, p.view, p.slat.name) for p in pairs] == [
        ("a.back", "back", "s2.npz"),
        ("a.front", "front", "s1.npz"),
        ("b.v1", "v1", "v1.npz"),
        ("b.v2", "v2", "v2.npz"),
    ]
    assert not any(p.problem for p in pairs)


def test_ids_in_a_map_cannot_leave_the_folder(find, tmp_path):
    touch(tmp_path, "secret.npz")
    table = tmp_path / "map.csv"
    table.write_text("object_id,slat_id\na,../secret\n../x,s\n")
    pairs = find([grid("a")], ["s.npz"], map=table)
    assert [pair.asset_id for pair in pairs] == ["..%2Fx", "a"]
    assert "'..%2Fx' is not allowed" in pairs[0].problem
    assert pairs[1].slat is None


@pytest.mark.parametrize(("text", "message"), [
    ("id,other\na,b\n", "expected object_id and slat_id"),
    ("", "columns none"),
    ("object_id,slat_id\na,\n", "line 2: empty"),
    ("object_id,slat_id\n\x80", "cannot be read"),
    ("object_id,slat_id,object_id\na,b,c\n", "has two columns"),
    ("object_id,slat_id,view,view\na,b,c,d\n", "has two columns"),
    ("object_id;slat_id\na;1\n", "save it with commas between the columns"),
    ("\xff\xfeo\0b\0", "save it as CSV in UTF-8"),
])  # fmt: skip
def test_bad_maps(find, tmp_path, text, message):
    table = tmp_path / "map.csv"
    table.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=message) as caught:
        find([grid("a")], ["a.npz"], map=table)
    assert str(table) in str(caught.value)
    with pytest.raises(ConfigError, match="cannot be read"):
        find(map=tmp_path / "none.csv")


@pytest.mark.parametrize(("key", "size", "said"), [
    ("map", None, "cannot be read as .*no regular file"),
    ("categories", None, "cannot be read as .*no regular file"),
    ("map", 2**30, "cannot be read as .*more than 16,777,216"),  # in its only line
    ("categories", 2**40, ".*larger than 256 MiB"),
])  # fmt: skip
def test_a_table_that_is_a_pipe_or_beyond_reason_is_not_read(find, tmp_path, key, size, said):
    table = tmp_path / "table"
    if size is None:
        os.mkfifo(table)
    else:
        table.touch()
        os.truncate(table, size)  # a hole: it takes no space on disk
    most = 2**28 if key == "map" else 2**29
    with less_than(most), pytest.raises(ConfigError, match=f"table: {said}"):
        find([grid("a")], ["a.npz"], **{key: table})


def test_categories(find, tmp_path):
    table = tmp_path / "obj_ids_metadata.json"
    entry = {"obj_class": " soda_cans ", "vlm_filtering": {"is_appropriate": True}}
    table.write_text(json.dumps({"a": entry, "b": {"obj_class": "  "}}))
    pairs = find([grid("a"), grid("b")], ["a.npz", "b.npz"], categories=table)
    assert [pair.category for pair in pairs] == ["soda_cans", ""]

    for text, message in (
        ("{", "JSON"),
        ("[]", "expected an object"),
        ('{"a": 1}', "'a' has no"),
        ('{"a": {"obj_class": "x"}, "a": {"obj_class": "y"}}', "the key 'a' occurs twice"),
        ('{"a": {"obj_class": "x", "obj_class": "y"}}', "the key 'obj_class' occurs twice"),
        ('{"a": {"obj_class": "%s"}}' % ("x" * 257), "has 257 letters; expected at most 256"),
    ):
        table.write_text(text)
        with pytest.raises(ConfigError, match=message):
            find(categories=table)


@contextmanager
def unlistable(folder: Path) -> Iterator[None]:
    """Take the right to list a folder away, also from root, who is nobody meanwhile."""
    root = not os.geteuid()
    for one in folder.parents if root else ():
        one.chmod(one.stat().st_mode | 0o755)
    folder.chmod(0)
    os.seteuid(65534 if root else os.geteuid())
    try:
        yield
    finally:
        os.seteuid(os.getuid())
        folder.chmod(0o755)


@pytest.mark.parametrize("side", ["pixie", "slat"])
def test_a_folder_that_cannot_be_listed_costs_its_asset_alone(find, tmp_path, side):
    find(map(grid, "abc"), ["a/1.npz", "b/1.npz", "c.npz"])
    with unlistable(tmp_path / side / "a"):
        found = {pair.asset_id: pair for pair in find()}
    assert [name for name, pair in found.items() if not pair.problem] == ["b", "c"]
    assert f"{tmp_path / side}/a/: cannot be listed (Permission denied)" in found["a"].problem
    assert found["a"].problem.count("cannot be listed") == 1
    with pytest.raises(InputError, match="cannot be listed") as caught:
        read_field(found["a"])
    assert type(caught.value) is InputError  # not a partner that is missing


def test_a_folder_on_the_way_to_ids_that_cannot_be_listed_is_named(find, tmp_path):
    patterns = {"pixieverse": {"grid": ("*/{id}.npy",)}, "slat": {"pattern": ("*/{id}.npz",)}}
    find(["x/a.npy", "y/b.npy"], ["x/a.npz", "y/b.npz"], **patterns)
    with unlistable(tmp_path / "pixie" / "y"):
        found = {pair.asset_id: pair for pair in find(**patterns)}
    assert not found["a"].problem
    assert "no grid for id 'b'" in found["b"].problem
    assert "/y/: cannot be listed" in found["y%2F"].problem


def test_a_place_below_what_cannot_be_listed_or_is_a_file_says_so(tmp_path):
    (tmp_path / "file").touch()
    (locked := tmp_path / "locked").mkdir()
    below_file = storage_of(tmp_path / "file/x").absent()
    assert below_file == f"does not exist; {tmp_path}/file is no folder"
    with unlistable(locked):
        told = storage_of(locked / "x").absent()
    assert told == f"cannot be looked for: {locked}: Permission denied"


def test_a_mask_that_leads_nowhere_is_no_missing_mask(find, tmp_path):
    find([grid("a")], ["a.npz"])
    mask = tmp_path / "pixie/a/clip_features_mask.npy"
    mask.symlink_to("gone")
    (pair,) = find()
    assert pair.mask == mask


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An unpacked dataset of two objects, and their SLATs; what archives hold is kept here."""
    monkeypatch.setenv("SLATPREP_CACHE", str(tmp_path / "cache"))
    touch(tmp_path / "pixie" / "render_outputs", *map(grid, "ab"))
    touch(tmp_path / "pixie", "data/a/train/000.png", "outputs/a/mesh.ply")
    touch(tmp_path / "slat", "a.npz", "b.npz")
    return tmp_path


def parameters(root: Path, grids: str, slats: str = "slat") -> BuildParameters:
    return BuildParameters(PixieverseSource(root / grids), SlatSource(root / slats))


GRIDS = "pixie/render_outputs"
NO_GRIDS = "no grid found.*"
NO_SLATS = "no SLAT found.*"
UNPACK = "SLATs are read unpacked: `tar -xf ARCHIVE -C FOLDER`"


@pytest.mark.parametrize(("grids", "slats", "told", "instead"), [
    (f"{GRIDS}/a", "slat", f"{NO_GRIDS}the folder of one object", GRIDS),
    (f"{GRIDS}/a/sample_0", "slat", f"{NO_GRIDS}a sample of one object", GRIDS),
    ("pixie/data", "slat", f"{NO_GRIDS}holds Pixie's rendered views", GRIDS),
    ("pixie/data/a", "slat", f"{NO_GRIDS}holds Pixie's rendered views", GRIDS),
    ("pixie/outputs", "slat", f"{NO_GRIDS}holds Pixie's reconstructions", GRIDS),
    (".", "slat", f"{NO_GRIDS}grids lie in", "pixie"),
    ("slat", "slat", f"{NO_GRIDS}it holds a.npz, b.npz", ""),
    ("plain", "slat", f"{NO_GRIDS}it holds source.json, which describes plain voxels; say "
     'adapter = "voxels"', ""),
    ("partly", "slat", "holds Pixie's data, outputs, and no render_outputs", "partly"),
    ("slat", "pixie", "the roots are swapped: grids lie below", ""),
    ("classes.json", "slat", "is another file; expected PixieVerse's folder or an", ""),
    ("pixie", "slats.tar", UNPACK, ""),
    ("pixie", "slats.tar.gz", UNPACK, ""),
    ("pixie", "tars", UNPACK, ""),
    ("pixie", "slat/a.npz", "is one SLAT; point at its folder", "slat"),
    ("pixie", "deep", f"{NO_SLATS}SLATs lie in", "deep/trellis"),
    ("pixie", "pixie", f"{NO_SLATS}it holds data, ", ""),
])  # fmt: skip
def test_whoever_points_elsewhere_is_told_what_lies_there(root, grids, slats, told, instead):
    if grids != ".":  # There all of it would be in sight.
        touch(root, "partly/data/a/train/000.png", "partly/outputs/a/mesh.ply", "classes.json")
        touch(root, "plain/source.json", "plain/a.npz")
        touch(root, "deep/trellis/latents/model/a.npz", "tars/none")
        for name in ("slats.tar", "slats.tar.gz", "tars/slats.tar"):
            pack(root / name, [root / "slat" / "a.npz"])
    with pytest.raises(ConfigError, match=told) as caught:
        discover(parameters(root, grids, slats))
    assert str(root / instead) in str(caught.value)


def test_archives_of_another_directory_are_told_apart(root):
    for name in ("data", "render_outputs"):
        (root / "archives" / name).mkdir(parents=True)
        pack(root / "archives" / name / "tree.tar", [root / "pixie" / name / "a"])
    with pytest.raises(ConfigError) as caught:
        discover(parameters(root, "archives/data/tree.tar"))
    assert "holds Pixie's rendered views" in str(caught.value)
    assert str(root / "archives" / "render_outputs") in str(caught.value)
    (root / "archives" / "data" / "tree.tar").rename(root / "tree.tar")
    with pytest.raises(ConfigError, match=r"such as a/train/000\.png"):
        discover(parameters(root, "tree.tar"))


def test_own_patterns_begin_at_the_root(root):
    own = PixieverseSource(root / "pixie", ("render_outputs/{id}/sample_{sample}/*_grid.npy",))
    pairs = discover(BuildParameters(own, SlatSource(root / "slat")))
    grids = root / "pixie/render_outputs"
    assert [pair.grid for pair in pairs] == [grids / grid(name) for name in "ab"]


def test_id_in_other_letters_is_named_on_both_sides(root):
    (root / "slat" / "a.npz").rename(root / "slat" / "A.npz")
    problems = {pair.asset_id: pair.problem for pair in discover(parameters(root, "pixie"))}
    assert "a SLAT is called 'A'" in problems["a"]
    assert "a grid is called 'a'" in problems["A"]
    assert not problems["b"]


def test_of_several_ids_in_other_letters_the_first_is_named():
    names = [f"{a}{b}{c}" for a in "cC" for b in "uU" for c in "pP"]
    for slats in (names[1:], names[:0:-1]):
        cases = by_case(["cup"], slats)
        assert cases == {"cup": "CUP"} | dict.fromkeys(slats, "cup")
        assert by_case(slats, ["cup"]) == cases


def test_slats_one_folder_deeper_are_named(root):
    touch(root / "latents", "model/a.npz", "model/b.npz")
    chosen = parameters(root, "pixie", "latents")
    assert str(root / "latents" / "model") in explain_unmatched(discover(chosen), chosen)


def test_cache_of_the_hub_is_read_and_other_links_are_refused(tmp_path):
    snapshot = tmp_path / "datasets--me--slats" / "snapshots" / ("0" * 40)
    touch(tmp_path / "datasets--me--slats", "blobs/1234")
    touch(tmp_path, "elsewhere/1234")
    touch(snapshot, "other.npz")
    (snapshot / "a.npz").symlink_to("../../blobs/1234")
    (snapshot / "b.npz").symlink_to(tmp_path / "elsewhere" / "1234")
    blob = tmp_path / "datasets--me--slats" / "blobs" / "1234"
    assert storage_of(snapshot).locate(snapshot / "a.npz") == (blob, "a.npz")
    with pytest.raises(InputError, match="out of its root") as caught:
        storage_of(snapshot).locate(snapshot / "b.npz")
    assert f"give a root that holds both, {tmp_path}," in str(caught.value)


def test_archives_in_the_cache_of_the_hub_are_read(root):
    home = root / "datasets--vlongle--pixieverse"
    folder = home / "snapshots" / ("0" * 40) / "archives" / "render_outputs"
    folder.mkdir(parents=True)
    (home / "blobs").mkdir()
    pack(home / "blobs" / "1234", [root / "pixie" / "render_outputs" / "a"])
    (folder / "tree.tar").symlink_to("../../../../blobs/1234")
    pairs = discover(parameters(home / "snapshots", "0" * 40, str(root / "slat")))
    assert [pair.category for pair in pairs if pair.grid] == ["tree"]
    for above in (home, home / "snapshots"):
        with pytest.raises(ConfigError, match=f"grids lie in {home}/snapshots/0{{40}}; point at"):
            discover(parameters(above, ".", str(root / "slat")))


def test_archive_that_is_a_link_out_of_its_folder_names_the_way_out(root):
    pack(root / "tree.tar", [root / "pixie" / "render_outputs" / "a"])
    (root / "links").mkdir()
    (root / "links" / "tree.tar").symlink_to(root / "tree.tar")
    with pytest.raises(InputError, match=r"out of its root; .* the archive itself"):
        discover(parameters(root, "links"))


@pytest.mark.parametrize("where", ["pixie", "pixie/render_outputs"])
def test_of_the_root_or_its_grids_what_macos_writes_beside_files_is_no_asset(root, where):
    touch(root / "slat", "._a.npz", "._c.npz")
    touch(root / "pixie" / "render_outputs", grid("._a"))
    assert [pair.asset_id for pair in discover(parameters(root, where))] == ["a", "b"]


def test_name_that_is_not_allowed_comes_with_another(root):
    touch(root / "pixie" / "render_outputs", grid("Täpf mit Blüten 12"))
    touch(root / "slat", "Täpf mit Blüten 12.npz")
    (pair,) = [pair for pair in discover(parameters(root, "pixie")) if "%20" in pair.asset_id]
    with pytest.raises(InputError) as caught:
        require_complete(pair)
    assert "Blüten 12.npz', to 'T-pf-mit-Bl-ten-12' for instance" in str(caught.value)
    assert str(caught.value).count("expected") == 1

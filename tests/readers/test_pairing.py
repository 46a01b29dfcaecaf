"""Finding pairs by name; the files themselves are never opened, so they may be empty."""

import re
from itertools import product
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.raw_sources import COORDS, FEATS, grid, raw_grid, touch

from slatprep.errors import ConfigError, InputError, MissingPartnerError
from slatprep.readers import read_field, read_latents
from slatprep.readers.patterns import match

UID = "0123456789abcdef0123456789abcdef"
SHA = "ab" * 32


def test_default_layout(find, tmp_path):
    # Of the patterns of grids the first that is there counts.
    extra = ["a/clip_features_mask.npy", "a/clip_features.npz", "a/sample_0_pred.npy", "readme.txt"]
    pairs = find([grid("b"), grid("a"), *extra], ["a.npz", "b.h5", "notes.txt"])

    assert [pair.asset_id for pair in pairs] == ["a", "b"]
    first, second = pairs
    assert first.problem == second.problem == ""
    assert first.object_id == "a"
    assert first.view == first.category == first.slat_group == ""
    assert first.roots.pixieverse == tmp_path / "pixie"
    assert first.roots.slat == tmp_path / "slat"
    assert first.grid == tmp_path / "pixie/a/sample_0/material_grid.npy"
    assert first.mask == tmp_path / "pixie/a/clip_features_mask.npy"
    assert first.bounds == tmp_path / "pixie/a/clip_features.npz"
    assert first.slat == tmp_path / "slat/a.npz"
    assert second.mask is second.bounds is None
    assert second.slat == tmp_path / "slat/b.h5"


def test_the_root_of_trellis_s_toolkit(find, tmp_path):
    root = tmp_path / "slat"
    root.mkdir()
    (root / "metadata.csv").write_text(
        "sha256,file_identifier,aesthetic_score\n"
        f"{SHA},https://example.org/3d-models/a-chair-{UID},5.5\n"
        f"{'cd' * 32},https://example.org/3d-models/{'f' * 32},5.5\n"
        f"{'ef' * 32},,4\n"
    )
    shown = [f"latents/dino/{SHA}.npz", f"ss_latents/enc/{SHA}.npz"]
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


def test_several_samples_by_number(find):
    numbers = (10, 0, 2)
    touched = [f"a/sample_{k}_{what}.npy" for k in numbers for what in ("pred", "mask")]
    (pair,) = find(touched, ["a.npz"], pixieverse={"samples": "first"})
    assert (pair.problem, pair.sample, pair.others) == ("", "0", ())

    (pair,) = find(pixieverse={"samples": "merge"})
    assert [one.sample for one in pair.annotations] == ["0", "2", "10"]
    for one in pair.annotations:
        assert (one.problem, one.asset_id) == ("", "a")
        assert one.grid.name == f"sample_{one.sample}_pred.npy"
        assert one.mask.name == f"sample_{one.sample}_mask.npy"
        assert one.slat == pair.slat


def test_each_sample_with_each_view(find):
    files = [f"a/sample_{k}/material_grid.npy" for k in (0, 1)]
    pairs = find(files, ["a/left.npz", "a/right.npz"], pixieverse={"samples": "all"})
    assert [pair.asset_id for pair in pairs] == [
        f"a.{view}.sample_{k}" for view in ("left", "right") for k in (0, 1)
    ]
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


@pytest.mark.parametrize("files", [("a.npz", "a.h5"), ("a/v.npz", "a/v.h5")])
def test_two_slats_for_one_id(find, files):
    (pair,) = find([grid("a")], files)
    assert "2 SLATs for one id 'a'" in pair.problem
    assert all(file in pair.problem for file in files)
    with pytest.raises(InputError, match="2 SLATs for one id"):
        read_latents(pair)


@pytest.mark.parametrize("what", ["grid", "mask"])
def test_two_files_of_a_kind_for_one_id(find, what):
    own = {"grid": ("*/{id}.npy",)} if what == "grid" else {"mask": ("*/{id}.npy",)}
    (pair,) = find(["x/a.npy", "y/a.npy", grid("a")], ["a.npz"], pixieverse=own)
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
        assert f"id {pair.grid.parents[1].name!r} is not allowed" in pair.problem
        assert "\n" not in pair.problem
        assert pair.mask is None
        assert all(c.isascii() and (c.isalnum() or c in "%._-") for c in pair.asset_id)
        names.remove(pair.grid.parents[1].name)
    assert not names


def hdf5(path: Path, *groups: str) -> None:
    with h5py.File(path, "w") as file:
        for group in groups:
            file[f"{group}/coords"] = COORDS
            file[f"{group}/feats"] = FEATS


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
    assert r"id 'b\udcff' is not allowed" in found["b%FF"].problem
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
    pairs = find(
        [grid("a"), grid("b")], slat={"pattern": ("part_*.h5",), "group": "slats/{id}/{view}"}
    )
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
    with pytest.raises(ConfigError, match="pixie: no grid found; looked for") as caught:
        find()
    assert "{id}" not in str(caught.value)
    assert "*/sample_*/material_grid.npy" in str(caught.value)
    with pytest.raises(ConfigError, match=r"slat: no SLAT found; looked for \*\.npz"):
        find([grid("a")])
    with pytest.raises(ConfigError, match="nowhere: does not exist"):
        find(pixieverse={"root": tmp_path / "nowhere"})
    with pytest.raises(ConfigError, match="nowhere: does not exist"):
        find(slat={"root": tmp_path / "nowhere"})
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

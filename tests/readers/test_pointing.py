"""Whoever points at the wrong folder is told what lies there, and what to point at."""

from pathlib import Path

import pytest
from support.published import pack
from support.raw_sources import touch

from slatprep.errors import ConfigError, InputError
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import discover
from slatprep.readers.files import require_complete
from slatprep.readers.joins import explain_unmatched
from slatprep.storage.place import storage_of

GRID = "{}/sample_0/material_grid.npy"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLATPREP_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """An unpacked dataset of two objects, and their SLATs."""
    objects = tmp_path / "pixie" / "render_outputs"
    touch(objects, *(GRID.format(name) for name in "ab"))
    touch(tmp_path / "pixie", "data/a/train/000.png", "outputs/a/mesh.ply")
    touch(tmp_path / "slat", "a.npz", "b.npz")
    return tmp_path


def parameters(root: Path, grids: str, slats: str = "slat") -> BuildParameters:
    return BuildParameters(PixieverseSource(root / grids), SlatSource(root / slats))


@pytest.mark.parametrize("where", ["pixie", "pixie/render_outputs"])
def test_both_the_root_and_its_grids_will_do(root, where):
    assert [pair.asset_id for pair in discover(parameters(root, where))] == ["a", "b"]


NO_GRIDS = "no grid found.*"
NO_SLATS = "no SLAT found.*"
UNPACK = "SLATs are read unpacked: `tar -xf ARCHIVE -C FOLDER`"


@pytest.mark.parametrize(
    ("grids", "slats", "told", "instead"),
    [
        ("pixie/render_outputs/a", "slat", f"{NO_GRIDS}the folder of one object",
         "pixie/render_outputs"),
        ("pixie/render_outputs/a/sample_0", "slat", f"{NO_GRIDS}a sample of one object",
         "pixie/render_outputs"),
        ("pixie/data", "slat", f"{NO_GRIDS}holds Pixie's rendered views", "pixie/render_outputs"),
        ("pixie/data/a", "slat", f"{NO_GRIDS}holds Pixie's rendered views", "pixie/render_outputs"),
        ("pixie/outputs", "slat", f"{NO_GRIDS}holds Pixie's reconstructions",
         "pixie/render_outputs"),
        (".", "slat", f"{NO_GRIDS}grids lie in", "pixie"),
        ("slat", "slat", f"{NO_GRIDS}it holds a.npz, b.npz", ""),
        ("partly", "slat", "holds Pixie's data, outputs, and no render_outputs", "partly"),
        ("slat", "pixie", "the roots are swapped: grids lie below", ""),
        ("classes.json", "slat", "is another file; expected PixieVerse's folder or an", ""),
        ("pixie", "slats.tar", UNPACK, ""),
        ("pixie", "slats.tar.gz", UNPACK, ""),
        ("pixie", "tars", UNPACK, ""),
        ("pixie", "slat/a.npz", "is one SLAT; point at its folder", "slat"),
        ("pixie", "deep", f"{NO_SLATS}SLATs lie in", "deep/trellis"),
        ("pixie", "pixie", f"{NO_SLATS}it holds data, ", ""),
    ],
)  # fmt: skip
def test_whoever_points_elsewhere_is_told_what_lies_there(root, grids, slats, told, instead):
    if grids != ".":  # There all of it would be in sight.
        touch(root, "partly/data/a/train/000.png", "partly/outputs/a/mesh.ply", "classes.json")
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
    assert [pair.grid for pair in pairs] == [
        root / "pixie" / "render_outputs" / GRID.format(name) for name in "ab"
    ]


def test_id_in_other_letters_is_named_on_both_sides(root):
    (root / "slat" / "a.npz").rename(root / "slat" / "A.npz")
    problems = {pair.asset_id: pair.problem for pair in discover(parameters(root, "pixie"))}
    assert "a SLAT is called 'A'" in problems["a"]
    assert "a grid is called 'a'" in problems["A"]
    assert not problems["b"]


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


def test_what_macos_writes_beside_files_is_no_asset(root):
    touch(root / "slat", "._a.npz", "._c.npz")
    touch(root / "pixie" / "render_outputs", "._a/sample_0/material_grid.npy")
    assert [pair.asset_id for pair in discover(parameters(root, "pixie"))] == ["a", "b"]


def test_name_that_is_not_allowed_comes_with_another(root):
    touch(root / "pixie" / "render_outputs", GRID.format("Täpf mit Blüten 12"))
    touch(root / "slat", "Täpf mit Blüten 12.npz")
    (pair,) = [pair for pair in discover(parameters(root, "pixie")) if "%20" in pair.asset_id]
    with pytest.raises(InputError) as caught:
        require_complete(pair)
    assert "rename its files, to 'T-pf-mit-Bl-ten-12' for instance" in str(caught.value)
    assert str(caught.value).count("expected") == 1

"""Whoever points at the wrong folder is told what lies there, and what to point at."""

from pathlib import Path

import pytest
from support.published import pack
from support.raw_sources import touch

from slatprep.errors import ConfigError, InputError
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import discover
from slatprep.readers.files import require_complete
from slatprep.readers.joins import read_map
from slatprep.readers.unmatched import explain_unmatched
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
def test_both_the_root_and_its_grids_will_do(root: Path, where: str) -> None:
    assert [pair.asset_id for pair in discover(parameters(root, where))] == ["a", "b"]


@pytest.mark.parametrize(
    ("where", "what", "instead"),
    [
        ("pixie/render_outputs/a", "the folder of one object", "pixie/render_outputs"),
        ("pixie/render_outputs/a/sample_0", "a sample of one object", "pixie/render_outputs"),
        ("pixie/data", "holds Pixie's rendered views", "pixie/render_outputs"),
        ("pixie/data/a", "holds Pixie's rendered views", "pixie/render_outputs"),
        ("pixie/outputs", "holds Pixie's reconstructions", "pixie/render_outputs"),
        (".", "grids lie in", "pixie"),
        ("slat", "it holds a.npz, b.npz", ""),
    ],
)
def test_wrong_folder_is_told_apart(root: Path, where: str, what: str, instead: str) -> None:
    with pytest.raises(ConfigError, match="no grid found") as caught:
        discover(parameters(root, where))
    assert what in str(caught.value)
    assert str(root / instead) in str(caught.value)


def test_archives_of_another_directory_are_told_apart(root: Path) -> None:
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


def test_root_without_the_folder_of_grids_says_what_is_missing(root: Path) -> None:
    touch(root, "partly/data/a/train/000.png", "partly/outputs/a/mesh.ply")
    with pytest.raises(ConfigError, match="holds Pixie's data, outputs, and no render_outputs"):
        discover(parameters(root, "partly"))


def test_both_swapped_roots_are_told(root: Path) -> None:
    with pytest.raises(ConfigError, match="the roots are swapped: grids lie below"):
        discover(parameters(root, "slat", "pixie"))


def test_file_that_is_no_archive_is_not_called_missing(root: Path) -> None:
    touch(root, "classes.json")
    with pytest.raises(ConfigError, match="is another file; expected PixieVerse's folder or an"):
        discover(parameters(root, "classes.json"))


@pytest.mark.parametrize("where", ["slats.tar", "slats.tar.gz", "tars"])
def test_slats_in_archives_are_to_be_unpacked(root: Path, where: str) -> None:
    (root / "tars").mkdir()
    for name in ("slats.tar", "slats.tar.gz", "tars/slats.tar"):
        pack(root / name, [root / "slat" / "a.npz"])
    with pytest.raises(ConfigError, match="SLATs are read unpacked: `tar -xf ARCHIVE -C FOLDER`"):
        discover(parameters(root, "pixie", where))


def test_one_slat_is_not_a_folder_of_them(root: Path) -> None:
    with pytest.raises(ConfigError, match="is one SLAT; point at its folder") as caught:
        discover(parameters(root, "pixie", "slat/a.npz"))
    assert str(root / "slat") in str(caught.value)


def test_own_patterns_begin_at_the_root(root: Path) -> None:
    own = PixieverseSource(root / "pixie", ("render_outputs/{id}/sample_{sample}/*_grid.npy",))
    pairs = discover(BuildParameters(own, SlatSource(root / "slat")))
    assert [pair.grid for pair in pairs] == [
        root / "pixie" / "render_outputs" / GRID.format(name) for name in "ab"
    ]


def test_id_in_other_letters_is_named_on_both_sides(root: Path) -> None:
    (root / "slat" / "a.npz").rename(root / "slat" / "A.npz")
    problems = {pair.asset_id: pair.problem for pair in discover(parameters(root, "pixie"))}
    assert "a SLAT is called 'A'" in problems["a"]
    assert "a grid is called 'a'" in problems["A"]
    assert not problems["b"]


def test_slats_one_folder_deeper_are_named(root: Path) -> None:
    touch(root / "latents", "model/a.npz", "model/b.npz")
    chosen = parameters(root, "pixie", "latents")
    assert str(root / "latents" / "model") in explain_unmatched(discover(chosen), chosen)


def test_cache_of_the_hub_is_read_and_other_links_are_refused(tmp_path: Path) -> None:
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


def test_archives_in_the_cache_of_the_hub_are_read(root: Path) -> None:
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


def test_archive_that_is_a_link_out_of_its_folder_names_the_way_out(root: Path) -> None:
    pack(root / "tree.tar", [root / "pixie" / "render_outputs" / "a"])
    (root / "links").mkdir()
    (root / "links" / "tree.tar").symlink_to(root / "tree.tar")
    with pytest.raises(InputError, match=r"out of its root; .* the archive itself"):
        discover(parameters(root, "links"))


def test_what_macos_writes_beside_files_is_no_asset(root: Path) -> None:
    touch(root / "slat", "._a.npz", "._c.npz")
    touch(root / "pixie" / "render_outputs", "._a/sample_0/material_grid.npy")
    assert [pair.asset_id for pair in discover(parameters(root, "pixie"))] == ["a", "b"]


def test_name_that_is_not_allowed_comes_with_another(root: Path) -> None:
    touch(root / "pixie" / "render_outputs", GRID.format("Täpf mit Blüten 12"))
    touch(root / "slat", "Täpf mit Blüten 12.npz")
    (pair,) = [pair for pair in discover(parameters(root, "pixie")) if "%20" in pair.asset_id]
    with pytest.raises(InputError) as caught:
        require_complete(pair)
    assert "rename its files, to 'T-pf-mit-Bl-ten-12' for instance" in str(caught.value)
    assert str(caught.value).count("expected") == 1


@pytest.mark.parametrize(
    ("data", "advice"),
    [
        (b"object_id;slat_id\na;1\n", "save it with commas between the columns"),
        ("object_id,slat_id\na,1\n".encode("utf-16"), "save it as CSV in UTF-8"),
    ],
)
def test_table_in_another_form_is_told_how_to_save_it(
    tmp_path: Path, data: bytes, advice: str
) -> None:
    (tmp_path / "map.csv").write_bytes(data)
    with pytest.raises(ConfigError, match=advice):
        read_map(tmp_path / "map.csv", {"a"}, {"1"})


@pytest.mark.parametrize(
    ("where", "what"), [("deep", "SLATs lie in {}/deep/trellis"), ("pixie", "it holds data, ")]
)
def test_folder_without_slats_is_told_apart(root: Path, where: str, what: str) -> None:
    touch(root, "deep/trellis/latents/model/a.npz")
    with pytest.raises(ConfigError, match="no SLAT found") as caught:
        discover(parameters(root, "pixie", where))
    assert what.format(root) in str(caught.value)

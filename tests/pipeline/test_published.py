"""A store of PixieVerse as it is published is that of the unpacked folders."""

import gzip
import hashlib
import re
import shutil
import tarfile
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.memory import less_than
from support.published import BLOCK, IDS, add, add_link, pack, parameters, write_object, writing
from support.synthetic import make_asset
from support.trees import tree

from slatprep import InputError, StoreError, build_store, discover, open_store, read_field
from slatprep.inspect.verify import verify_store
from slatprep.storage.archives import Archive
from slatprep.storage.files import LocalFile

TAR, GZ = "tar/archives/render_outputs/tree.tar", "gz/archives/render_outputs/tree.tar.gz"
GRIDS = ("*/sample_*/material_grid.npy",)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SLATPREP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.parametrize("root", ["tar", "gz/archives/render_outputs"])
def test_store_of_archives_is_that_of_the_unpacked_folder(made, tmp_path, unpacked, root):
    summary = build_store(parameters(made, root), tmp_path / "s.zarr")
    assert summary.statuses == {"ok": 4, "failed": 0, "skipped": 1}
    assert tree(tmp_path / "s.zarr") == unpacked
    assert verify_store(tmp_path / "s.zarr", sources=True).ok


def test_from_any_folder_above_them_archives_and_grids_are_the_same(made):
    for roots, listed in (
        (("pixieverse/render_outputs", "pixieverse"), True),
        (("tar/archives/render_outputs", "tar/archives", "tar"), False),
    ):
        found = [list(discover(parameters(made, root, listed))) for root in roots]
        for pairs in zip(*found, strict=True):
            told = {(one.asset_id, one.category, str(one.grid), one.problem) for one in pairs}
            assert len(told) == 1
            assert pairs[0].problem or len({read_field(one).sources for one in pairs}) == 1


@pytest.mark.parametrize("path", [TAR, GZ])
def test_one_archive_holds_its_class(made, path):
    pairs = [one for one in discover(parameters(made, path)) if not one.problem]
    assert [one.asset_id for one in pairs] == [IDS[0], IDS[3]]
    assert {one.category for one in pairs} == {"tree"} and len(read_field(pairs[1]).voxels)


def test_needed_members_alone_are_read_once(objects, made, tmp_path, monkeypatch, files_are_old):
    pread, of_archives = LocalFile.pread, list[int]()

    def reading(file: LocalFile, length: int, offset: int) -> bytes:
        data = pread(file, length, offset)
        if ".tar" in str(Path(f"/proc/self/fd/{file.fileno()}").readlink()):
            of_archives.append(len(data))
        return data

    monkeypatch.setattr(LocalFile, "pread", reading)
    build_store(parameters(made, "tar"), tmp_path / "s.zarr")
    needed = sum(
        path.stat().st_size
        for name in IDS[:4]
        for path in (objects / name).rglob("*")
        if path.name in ("material_grid.npy", "clip_features_mask.npy", "clip_features.npz")
    )
    whole = sum(path.stat().st_size for path in (made / "tar").rglob("*.tar"))
    assert 0 < sum(of_archives) - needed < 0.1 * whole
    of_archives.clear()
    assert build_store(parameters(made, "tar"), tmp_path / "s.zarr", rehash=0).statuses["ok"] == 4
    assert not of_archives


def test_index_goes_on_where_it_was_stopped(made, tmp_path, monkeypatch):
    path = made / TAR
    archive = Archive.on_disk(path, GRIDS)
    whole, passed = archive.index(), []
    shutil.rmtree(archive.home)

    def stop(at: int) -> None:
        if at > path.stat().st_size // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        archive.index(stop)
    assert archive.index(passed.append) == whole
    assert min(passed) > path.stat().st_size // 2
    passed.clear()
    assert archive.index(passed.append) == whole and not passed


def test_stopped_reading_of_an_archive_with_gzip_begins_again_and_is_told(made):
    path = made / GZ
    archive = Archive.on_disk(path, GRIDS)
    whole, passed = archive.index(), list[int]()
    grid = next(one for name, one in whole.members.items() if "material_grid" in name)
    shutil.rmtree(archive.home)

    def stop(at: int) -> None:
        if archive.holds(grid):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        archive.index(stop)
    assert archive.holds(grid)
    assert archive.index(passed.append) == whole
    assert len(passed) == len(whole.members)
    assert passed == sorted(passed) and passed[-1] == path.stat().st_size


def test_what_changed_in_an_archive_is_built_again_alone(objects, made, tmp_path):
    folder = shutil.copytree(made / "tar", tmp_path / "tar")
    build_store(parameters(made, folder), tmp_path / "s.zarr")
    shutil.copytree(objects / IDS[0], tmp_path / "new" / IDS[0])
    write_object(tmp_path / "new" / IDS[3], make_asset(3).grid * [1, 2, 1, 1], 3)
    pack(folder / "archives/render_outputs/tree.tar", sorted((tmp_path / "new").iterdir()))
    assert build_store(parameters(made, folder), tmp_path / "s.zarr").statuses["ok"] == 4
    build_store(parameters(made, folder), tmp_path / "fresh.zarr")
    assert tree(tmp_path / "s.zarr") == tree(tmp_path / "fresh.zarr")


@pytest.fixture
def strange(tmp_path: Path) -> Path:
    """Return a folder for archives that tests write."""
    (tmp_path / "strange").mkdir()
    return tmp_path / "strange"


def grid_of(objects: Path, number: int) -> Path:
    return objects / IDS[number] / "sample_0" / "material_grid.npy"


def test_last_of_two_members_counts_and_links_stay_in_the_archive(objects, made, strange):
    name = f"{IDS[0]}/sample_0/material_grid.npy"
    with writing(strange / "tree.tar") as archive:
        archive.add(grid_of(objects, 1), arcname=f"./{name}")
        archive.add(grid_of(objects, 0), arcname=name)
        kinds = (tarfile.LNKTYPE, name), (tarfile.SYMTYPE, f"../../{name}"), (tarfile.CHRTYPE, "")
        for one, (kind, target) in zip(IDS[1:4], kinds, strict=True):
            add_link(archive, f"{one}/sample_0/material_grid.npy", target, kind)
        for other in ("/etc/passwd", f"../{IDS[4]}/sample_0/material_grid.npy"):
            archive.addfile(tarfile.TarInfo(other))
    told: list[str] = []
    pairs = {one.asset_id: one for one in discover(parameters(made, strange), told.append)}
    digest = hashlib.sha256(grid_of(objects, 0).read_bytes()).hexdigest()
    for one in IDS[:2]:
        assert read_field(pairs[one]).sources[0].sha256 == digest
    for one, said in zip(IDS[2:4], ("is a symbolic link", "is a device or a pipe"), strict=True):
        with pytest.raises(InputError, match=said):
            read_field(pairs[one])
    (line,) = [line for line in told if "twice" in line]
    assert "tree.tar: 1 name" in line and "'/etc/passwd' and 1 more" in line


def test_object_in_two_archives_is_not_taken_from_either(objects, made, strange):
    pack(strange / "sand.tar", [objects / IDS[0], objects / IDS[1]])
    pack(strange / "tree.tar", [objects / IDS[0]])
    both, one, *_ = discover(parameters(made, strange))
    with pytest.raises(InputError, match=f"lies in {strange / 'sand.tar'} as well"):
        read_field(both)
    assert len(read_field(one).voxels)


@pytest.mark.parametrize("suffix", [".tar", ".tar.gz"])
def test_a_link_holds_what_its_name_held_before_it(strange, suffix):
    """As GNU tar unpacks them; Python's tarfile writes through the link."""
    path = strange / f"tree{suffix}"
    with writing(path) as archive:
        add(archive, "a/grid.npy", b"first")
        add_link(archive, "b/grid.npy", "a/grid.npy")
        add(archive, "a/grid.npy", b"later")
    made = Archive.on_disk(path, ("*/grid.npy",))
    held = {name: made.read(entry) for name, entry in made.index().members.items()}
    assert held == {"a/grid.npy": b"later", "b/grid.npy": b"first"}


def test_builds_that_want_other_members_of_an_archive_leave_each_other_theirs(strange):
    path = strange / "tree.tar.gz"

    def of_all() -> dict[str, Archive]:
        return {name: Archive.on_disk(path, (f"*/{name}",)) for name in ("grid.npy", "mask.npy")}

    for content in (b"first", b"later"):
        with writing(path) as archive:
            for name in ("a/grid.npy", "a/mask.npy"):
                add(archive, name, content)
        one, other = of_all().values()
        for each in (one, other):
            each.index()
        assert {one.folder, other.folder} == set(one.home.iterdir())  # none of an older state


def truncated(data: bytes) -> bytes:
    return data[: len(data) * 2 // 3]


def damaged(data: bytes) -> bytes:
    at = data.index(IDS[1].encode(), len(data) // 4)
    return data[:at] + b"x" + data[at + 1 :]


@pytest.mark.parametrize(
    ("suffix", "change"), [(".tar", truncated), (".tar.gz", truncated), (".tar", damaged)]
)
def test_what_lies_before_a_break_is_built(objects, made, strange, tmp_path, suffix, change):
    path = strange / f"tree{suffix}"
    pack(path, [objects / IDS[0], objects / IDS[1]])
    path.write_bytes(change(path.read_bytes()))
    summary = build_store(parameters(made, strange), tmp_path / "s.zarr")
    (line,) = [text for about, text in summary.problems if about.startswith("tree")]
    if change is truncated:
        assert path.name in line and "download it again" in line
    else:
        assert "is damaged at byte" in line
    assert list(open_store(tmp_path / "s.zarr").ids) == [IDS[0]]


def header(size: int, kind: bytes = tarfile.REGTYPE) -> bytes:
    """Return a header with any size, which tarfile would not write."""
    block = bytearray(tarfile.TarInfo("x/y").tobuf(tarfile.GNU_FORMAT))
    block[124:136], block[156:157] = tarfile.itn(size, 12, tarfile.GNU_FORMAT), kind
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


def other_bit(data: bytes) -> bytes:
    """Change a value of the first grid in a gzip file that holds its data as they are."""
    plain = gzip.decompress(data)
    packed = bytearray(gzip.compress(plain, 0))
    at = packed.index(b"\x93NUMPY", packed.index(b"material_grid.npy")) + 500_000
    packed[at] ^= 64
    return bytes(packed)


PAX_SIZE = header(12, tarfile.XHDTYPE) + b"12 size=-99\n".ljust(BLOCK, b"\0")
COMMENT = header(30, tarfile.XHDTYPE) + b"30 comment=aaaaaaaaaaaaaaaaaa\n".ljust(BLOCK, b"\0")


@pytest.mark.parametrize("suffix", [".tar", ".tar.gz"])
@pytest.mark.parametrize(("behind", "said"), [
    (header(-BLOCK), "a header claims -512 bytes"),
    (header(2**62), "ends within 'x/y'|has no end"),
    (PAX_SIZE + header(0), "a header that claims -99 bytes|no intact"),
    (3000 * COMMENT + header(0), "recursion"),
    (header(2**30, tarfile.XHDTYPE) + bytes(2**24), "a header claims 1,073,741,824 bytes"),
    (header(2**40, tarfile.GNUTYPE_LONGNAME), "a header claims 1,099,511,627,776 bytes"),
    (b"x" * BLOCK, "is damaged at byte|invalid header"),
    (b"", "has no end"),
], ids=[
    "negative", "huge", "negative by pax", "nested", "large", "long name", "no header", "cut",
])  # fmt: skip
def test_strange_headers_end_one_archive(strange, suffix, behind, said):
    with writing(strange / "sound.tar") as archive:
        add(archive, "a/grid.npy", b"grid")
        end = archive.offset
    plain = (strange / "sound.tar").read_bytes()[:end] + behind + bytes(10 * BLOCK) * bool(behind)
    path = strange / f"b{suffix}"
    path.write_bytes(gzip.compress(plain) if suffix == ".tar.gz" else plain)
    made = Archive.on_disk(path, ("*/grid.npy",))
    with less_than(300e6):
        index = made.index()
    assert re.search(said, index.fault) and "download it again" in index.fault
    assert made.read(index.members["a/grid.npy"]) == b"grid"


def test_a_gzip_archive_of_a_wrong_checksum_gives_nothing(objects, made, strange):
    pack(strange / "a.tar", [objects / IDS[0]])
    path = strange / "b.tar.gz"
    pack(path, [objects / IDS[1]])
    path.write_bytes(other_bit(path.read_bytes()))
    pairs = discover(parameters(made, strange))
    (line,) = [one.problem for one in pairs if one.asset_id == path.name]
    assert "is no intact tar archive (CRC check failed" in line and "download it again" in line
    assert [one.asset_id for one in pairs if one.grid] == [IDS[0], path.name]


def test_no_flipped_bit_of_a_gzip_archive_changes_a_file(strange):
    rng = np.random.default_rng(5)
    wanted = {
        f"o{k}/sample_0/material_grid.npy": rng.integers(0, 9, 20_000, np.uint8) for k in range(4)
    }
    path = strange / "tree.tar.gz"
    with writing(path) as archive:
        for name, values in wanted.items():
            add(archive, name, values.tobytes())
    whole, told = path.read_bytes(), 0
    for at, bit in zip(rng.integers(20, len(whole), 60), rng.integers(0, 8, 60), strict=True):
        flipped = bytearray(whole)
        flipped[at] ^= 1 << int(bit)
        path.write_bytes(flipped)
        made = Archive.on_disk(path, GRIDS)
        index = made.index()
        told += bool(index.fault)
        for name, entry in index.members.items():
            assert made.read(entry) == wanted[name].tobytes()
    assert told > 50


def test_junk_behind_a_gzip_archive_is_left_alone(strange):
    path = strange / "tree.tar.gz"
    with writing(path) as archive:
        add(archive, "o/sample_0/material_grid.npy", b"grid")
    path.write_bytes(path.read_bytes() + b"junk")
    index = Archive.on_disk(path, GRIDS).index()
    assert not index.fault and len(index.members) == 1


def test_an_archive_that_is_none_is_named_where_it_lies(objects, made, strange, tmp_path):
    (strange / "page.tar").write_bytes(b"<html>" * 1000)
    for sound in (False, True):
        if sound:
            pack(strange / "a.tar", [objects / IDS[0]])
            told = dict(build_store(parameters(made, strange), tmp_path / "s.zarr").problems)
            said = f"{told['page.tar']}\n"
        else:
            with pytest.raises(StoreError) as raised:
                build_store(parameters(made, strange), tmp_path / "s.zarr")
            said = str(raised.value)
        assert f"{strange}: page.tar: cannot be listed (is no intact tar archive" in said
        assert "no id occurs on both sides" not in said


def test_a_damaged_archive_is_named_whatever_the_pattern(objects, made, strange, tmp_path):
    path = strange / "tree.tar"
    with writing(path) as archive:
        for number in range(2):
            archive.add(objects / IDS[number], arcname=f"below/{IDS[number]}")
    path.write_bytes(truncated(path.read_bytes()))
    whole = parameters(made, strange)
    patterns = ("below/{id}/sample_{sample}/material_grid.npy",)
    source = replace(whole.pixieverse, grid=patterns)
    summary = build_store(replace(whole, pixieverse=source), tmp_path / "s.zarr")
    assert [about for about, _ in summary.problems if about == "tree.tar"] == ["tree.tar"]
    assert open_store(tmp_path / "s.zarr").ids == [IDS[0]]


def test_what_lies_beside_archives_and_is_not_read_is_told(objects, made, strange):
    pack(strange / "a.tar", [objects / IDS[0]])
    told: list[str] = []
    discover(parameters(made, strange), told.append)
    assert not [text for text in told if "beside" in text]
    for name in (".cache", IDS[1]):
        (strange / name).mkdir()
    for name in ("._x.zip", "a.tar.sha256", "b.tar.xz"):
        (strange / name).touch()
    discover(parameters(made, strange), told.append)
    said = f"{strange}: its archives are read, but not {IDS[1]} and 1 more beside them"
    assert [text for text in told if "beside" in text] == [said]


@pytest.mark.parametrize("suffix", [".tar", ".tar.gz"])
def test_a_link_to_a_file_that_no_pattern_names(objects, made, strange, tmp_path, suffix):
    with writing(strange / f"tree{suffix}") as archive:
        add(archive, f"{IDS[0]}/other.npy", grid_of(objects, 0).read_bytes())
        add_link(archive, f"{IDS[0]}/sample_0/material_grid.npy", f"{IDS[0]}/other.npy")
    (pair,) = [one for one in discover(parameters(made, strange)) if one.grid]
    if suffix == ".tar":
        assert len(read_field(pair).voxels)
    else:
        with pytest.raises(InputError, match=r"shares the data of .*other\.npy, which is not kept"):
            read_field(pair)


def test_progress_through_archives_is_told_once_at_the_end(made):
    told: list[str] = []
    discover(parameters(made, made / "gz"), told.append)
    assert len(told) == len({*told})


def test_archive_replaced_during_a_build_is_noticed(objects, strange):
    path = strange / "tree.tar"
    pack(path, [objects / IDS[0]])
    archive = Archive.on_disk(path, GRIDS)
    (entry,) = [one for name, one in archive.index().members.items() if "material" in name]
    assert archive.read(entry) == grid_of(objects, 0).read_bytes()
    pack(path, [objects / IDS[1]])
    with pytest.raises(InputError, match="was replaced after it was looked at"):
        archive.read(entry)


def test_long_names_are_read_in_both_forms(strange):
    name = "/".join(["a" * 90] * 4) + "/material_grid.npy"
    for number, form in enumerate([tarfile.GNU_FORMAT, tarfile.PAX_FORMAT]):
        path = strange / f"{number}.tar"
        with tarfile.open(path, "w", format=form) as archive:
            add(archive, name, b"grid")
            add(archive, "b.npy", b"other")
        made = Archive.on_disk(path, ("*",))
        held = {key: made.read(entry) for key, entry in made.index().members.items()}
        assert held == {name: b"grid", "b.npy": b"other"}


@pytest.mark.parametrize("suffix", [".tar", ".tar.gz"])
def test_member_no_reader_takes_is_not_read(objects, made, strange, tmp_path, suffix, monkeypatch):
    monkeypatch.setattr("slatprep.storage.tar.MAX_KEPT", 2**20)
    monkeypatch.setattr("slatprep.readers.files.MAX_FILE_BYTES", 2**20)
    pack(strange / f"tree{suffix}", [objects / IDS[0]])
    (pair,) = [one for one in discover(parameters(made, strange)) if one.grid]
    with pytest.raises(InputError, match="is larger than 1 MiB"):
        read_field(pair)
    kept = (tmp_path / "cache").rglob("*.z")
    assert all(len(zlib.decompress(one.read_bytes())) < 2**20 for one in kept)

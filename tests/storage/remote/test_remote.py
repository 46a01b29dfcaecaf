"""Places on object stores stand where paths do; either client reads their bytes, or copies."""

import multiprocessing
import os
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from s3fs.core import S3FileSystem
from support.commands import refused

from slatprep import ConfigError, open_store
from slatprep.readers.files import load_source
from slatprep.records import Place
from slatprep.storage.cache import VARIABLE, cache_folder, cached_file, folder_for
from slatprep.storage.place import place_of, storage_of
from slatprep.storage.ranges import range_reader
from slatprep.storage.remote import (
    RemoteFile,
    RemotePlace,
    connected,
    copy_objects,
    list_objects,
    put_objects,
    remove_objects,
)


@pytest.mark.parametrize(("place", "shown"), [
    ("s3://bucket/a/b.zarr", "s3://bucket/a/b.zarr"),
    (Path("s3://bucket/a"), "s3://bucket/a"),  # pathlib has made one slash of two
    ("gs://bucket", "gs://bucket"),
    ("s3a://bucket/a", "s3://bucket/a"),  # other names of the same place
    ("S3://bucket/A", "s3://bucket/A"),
    ("gcs://bucket", "gs://bucket"),
    ("memory://a/", "memory://a"),
    ("demo.zarr", "demo.zarr"),
    ("/data/demo.zarr", "/data/demo.zarr"),
    ("file:///data/demo.zarr", "/data/demo.zarr"),
    (Path("file:///data/demo.zarr"), "/data/demo.zarr"),
    ("C:/data", "C:/data"),
])  # fmt: skip
def test_a_url_is_a_place_that_shows_as_a_url_and_all_else_a_local_path(place, shown):
    path = place_of(place)
    assert isinstance(path, RemotePlace if "://" in shown else Path)
    assert str(path) == shown
    assert place_of(str(path)) == path == pickle.loads(pickle.dumps(path))


@pytest.mark.parametrize("url", [
    "s3://b/a/../c", "s3://b/..", "s3://b/a\nc", "s3://b/\0", "s3://b/a::b", "s3://", "s3:///",
    "simplecache::s3://b/a",
])  # fmt: skip
def test_a_url_that_object_stores_take_differently_is_refused(url):
    with pytest.raises(ConfigError, match=r"expected .*(URL|s3:)"):
        place_of(url)


def test_places_below_a_url_are_named_as_paths_are():
    path = place_of("s3://bucket/a/demo.zarr")
    assert str(path / "x" / "y") == "s3://bucket/a/demo.zarr/x/y"
    assert str(path.parent) == "s3://bucket/a"
    assert str(path / "/x") == "s3://bucket/a/demo.zarr/x"
    assert (path.name, path.suffix) == ("demo.zarr", ".zarr")
    assert path.absolute() == path
    assert len({path, place_of(str(path)), path.parent}) == 2


def test_an_object_is_read_as_a_file(s3, bucket):
    s3.pipe_file(f"{bucket}/folder/text.txt", "Grüße\n".encode())
    s3.pipe_file(f"{bucket}/empty", b"")
    path = place_of(f"s3://{bucket}") / "folder" / "text.txt"
    assert path.read_text("utf-8") == "Grüße\n"
    assert path.exists()
    assert path.is_file() and not path.is_dir()
    assert path.parent.is_dir()
    assert storage_of(path).size() == 8
    with path.open("r", encoding="utf-8") as lines:
        assert list(lines) == ["Grüße\n"]
    assert place_of(f"s3://{bucket}/empty").read_bytes() == b""
    assert not place_of(f"s3://{bucket}/none").exists()


def test_what_a_path_offers_and_a_place_does_not_is_an_error():
    place = place_of("s3://bucket/new")
    offered = {name for name in dir(Path) if not name.startswith("_")}
    assert {name for name in offered if hasattr(place, name)} == offered & set(dir(Place))


def test_a_remote_place_is_not_taken_for_a_path():
    place = place_of("s3://bucket/new")
    for taken in (Path("/a").joinpath, Path, os.fspath):
        with pytest.raises(TypeError):
            taken(place)
    with pytest.raises(TypeError):
        storage_of("s3://bucket/new")
    with pytest.raises(OSError, match="s3://bucket/new: mode 'w'; expected 'r' or 'rb'"):
        place.open("w")


def test_what_cannot_be_read_is_named(s3, bucket):
    with pytest.raises(FileNotFoundError, match=f"key does not exist: 's3://{bucket}/none'"):
        place_of(f"s3://{bucket}/none").read_bytes()
    with pytest.raises(FileNotFoundError, match="bucket does not exist: 's3://no-such/none'"):
        place_of("s3://no-such/none").read_bytes()
    with pytest.raises(ConfigError, match=r"s4://bucket/x: cannot be reached .*not known"):
        place_of("s4://bucket/x").read_bytes()


def test_objects_that_no_path_could_name_are_left_out(s3, bucket):
    for key in ("a", "b/c", "../up", "b/../../up", "d//e", "./f", "g/", "back\\slash"):
        s3.pipe_file(f"{bucket}/root/{key}", b"x")
    s3.pipe_file(f"{bucket}/rooted", b"x")
    root = place_of(f"s3://{bucket}/root")
    assert storage_of(root).files() == {"a": 1, "b/c": 1}
    names = storage_of(root).listing()
    assert set(names.of_folder("", folders=False)) == {"a"}
    assert set(names.of_folder("", folders=True)) == {"b"} and names.is_file("b/c")
    assert not names.is_file("b")
    with pytest.raises(Exception, match="no plain name below its root"):
        load_source(root / "b" / ".." / "a", root, "grid")


@pytest.mark.parametrize("name", ["a[1]", "a*", "a?", "a{1,2}"])
def test_no_name_stands_for_others(s3, bucket, tmp_path, name):
    (tmp_path / "x").write_bytes(b"new")
    for folder in ("a1", "a2"):
        s3.pipe_file(f"{bucket}/{folder}/x", b"x")
    place, other = (place_of(f"s3://{bucket}/{one}") for one in (name, f"{name}b"))
    put_objects(tmp_path, place, ["x"])
    copy_objects(place, other, ["x"])
    for one in (place, other):
        assert (one / "x").read_bytes() == b"new" and [*list_objects(one)] == ["x"]
        remove_objects(one, ["x"])
        assert not (one / "x").exists()
    assert all(s3.cat_file(f"{bucket}/{folder}/x") == b"x" for folder in ("a1", "a2"))


@pytest.mark.parametrize("name", ["a1", "a*[1]?{2}"])
@pytest.mark.parametrize("protocol", ["s3", "memory"])
def test_objects_are_removed_by_name_whatever_it_is(bucket, protocol, name, requests):
    place = place_of(f"{protocol}://{bucket}/{name}")
    with connected(place) as (system, root):
        for key in ("x", "y", "z/z*"):
            system.pipe_file(f"{root}/{key}", b"x")
        requests.made.clear()
        remove_objects(place, ["x", "z/z*", *map(str, range(2000))])
        assert requests.made == []  # No folder is listed; the removal itself is not counted.
        assert [*list_objects(place)] == ["y"]
        remove_objects(place, [])


def test_an_object_that_the_server_keeps_is_an_error(bucket, s3, new_clients, monkeypatch):
    kept = {"Errors": [{"Key": "x", "Code": "AccessDenied", "Message": "Access Denied"}]}
    monkeypatch.setattr(S3FileSystem, "call_s3", lambda *args, **options: kept)
    with pytest.raises(OSError, match=f"Access Denied.*s3://{bucket}/a"):
        remove_objects(place_of(f"s3://{bucket}/a"), ["x"])


def test_a_file_that_is_too_large_is_not_read_whole(s3, bucket, monkeypatch):
    monkeypatch.setattr("slatprep.readers.files.MAX_FILE_BYTES", 2**20)
    root = place_of(f"s3://{bucket}")
    s3.pipe_file(f"{bucket}/fits", bytes(2**20))
    s3.pipe_file(f"{bucket}/large", bytes(2**20 + 1))
    s3.pipe_file(f"{bucket}/empty", b"")
    assert len(load_source(root / "fits", root, "grid")[0]) == 2**20
    with pytest.raises(Exception, match="large: is larger than 1 MiB"):
        load_source(root / "large", root, "grid")
    with pytest.raises(Exception, match="empty: has zero bytes"):
        load_source(root / "empty", root, "grid")


def test_without_the_extra_a_url_says_what_to_install(monkeypatch):
    for name in ("fsspec", "fsspec.core"):
        monkeypatch.setitem(sys.modules, name, None)
    told = refused("info", "s3://bucket/demo.zarr")
    assert "s3://bucket/demo.zarr" in told and "pip install 'slatprep[remote]'" in told


@pytest.fixture
def obstore(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("obstore")
    monkeypatch.setenv("SLATPREP_OBSTORE", "yes")


@pytest.mark.usefixtures("obstore")
def test_a_store_reads_as_by_s3fs(published, requests, monkeypatch):
    by_obstore = [asset.feats for asset in open_store(published)]
    assert requests.of("get_object") == []  # s3fs was asked for no bytes.
    monkeypatch.setenv("SLATPREP_OBSTORE", "no")
    for here, there in zip(by_obstore, open_store(published), strict=True):
        np.testing.assert_array_equal(here, there.feats)
    assert requests.of("get_object")


@pytest.mark.usefixtures("obstore")
def test_ranges_and_faults_are_those_of_a_file(bucket, s3):
    s3.pipe_file(f"{bucket}/a", b"0123456789")
    file = RemoteFile(place_of(f"s3://{bucket}/a"))  # type: ignore[arg-type]
    assert [file.pread(*at) for at in ((4, 3), (100, 8), (5, 10))] == [b"3456", b"89", b""]
    with pytest.raises(FileNotFoundError, match=f"s3://{bucket}/b"):
        RemoteFile(place_of(f"s3://{bucket}/b")).pread(1, 0)  # type: ignore[arg-type]


@pytest.mark.usefixtures("obstore")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a fork")
def test_a_forked_process_reads_by_s3fs(bucket, s3):
    s3.pipe_file(f"{bucket}/a", b"0123456789")

    def read() -> bytes:
        return RemoteFile(place_of(f"s3://{bucket}/a")).pread(4, 3)  # type: ignore[arg-type]

    assert read() == b"3456"
    forked = multiprocessing.get_context("fork")
    answers = forked.Queue()
    child = forked.Process(target=lambda: answers.put((range_reader(bucket) is None, read())))
    child.start()
    assert answers.get(timeout=300) == (True, b"3456")
    child.join()


@pytest.mark.usefixtures("obstore")
@pytest.mark.parametrize("name", ["AWS_ACCESS_KEY_ID", "AWS_SESSION_TOKEN"])
def test_credentials_that_were_renewed_are_taken(name, monkeypatch):
    first = range_reader("bucket")
    assert first is range_reader("bucket") is not None
    monkeypatch.setenv(name, "renewed")
    assert range_reader("bucket") not in (first, None)


@pytest.mark.usefixtures("obstore")
@pytest.mark.parametrize(
    ("name", "value"),
    [("AWS_SECRET_ACCESS_KEY", ""), ("AWS_PROFILE", "mine"), ("SLATPREP_OBSTORE", "no")],
)
def test_without_known_credentials_s3fs_reads(name, value, monkeypatch):
    monkeypatch.setenv(name, value)
    assert range_reader("bucket") is None


def test_a_copy_serves_while_the_object_is_the_same(s3, bucket):
    place = place_of(f"s3://{bucket}/latents.h5")
    s3.pipe_file(f"{bucket}/latents.h5", b"first")
    copy = cached_file(place)
    assert copy.read_bytes() == b"first"
    copy.write_bytes(b"mark!")  # so that one sees whether it is fetched again
    assert cached_file(place).read_bytes() == b"mark!"

    s3.pipe_file(f"{bucket}/latents.h5", b"other")
    other = cached_file(place)
    assert other.read_bytes() == b"other"
    assert list(folder_for(place).iterdir()) == [other]
    gone = place_of(f"s3://{bucket}/nothing.h5")
    with pytest.raises(FileNotFoundError):
        cached_file(gone)
    assert not folder_for(gone).exists()


def test_where_the_folder_is(monkeypatch, tmp_path):
    folders = {VARIABLE: "own", "XDG_CACHE_HOME": "xdg", "HOME": "home"}
    for variable, folder in folders.items():
        monkeypatch.setenv(variable, str(tmp_path / folder))
    for name, found in zip(folders, ("own", "xdg/slatprep", "home/.cache/slatprep"), strict=True):
        assert cache_folder() == tmp_path / found
        monkeypatch.delenv(name)

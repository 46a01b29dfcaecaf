"""Local copies of objects: made once, made again when the object is another one."""

import pytest

from slatprep.storage.cache import VARIABLE, cache_folder, cached_file, folder_for
from slatprep.storage.place import place_of
from slatprep.storage.remote import RemotePlace


def test_a_copy_serves_while_the_object_is_the_same(s3, bucket):
    place = place_of(f"s3://{bucket}/latents.h5")
    assert isinstance(place, RemotePlace)
    s3.pipe_file(f"{bucket}/latents.h5", b"first")
    copy = cached_file(place)
    assert copy.read_bytes() == b"first"
    copy.write_bytes(b"mark!")  # so that one sees whether it is fetched again
    assert cached_file(place).read_bytes() == b"mark!"

    s3.pipe_file(f"{bucket}/latents.h5", b"other")
    other = cached_file(place)
    assert other.read_bytes() == b"other"
    assert list(folder_for(place).iterdir()) == [other]


def test_an_object_that_is_not_there_leaves_no_copy(bucket):
    place = place_of(f"s3://{bucket}/nothing.h5")
    assert isinstance(place, RemotePlace)
    with pytest.raises(FileNotFoundError):
        cached_file(place)
    assert not folder_for(place).exists()


def test_where_the_folder_is(monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "slatprep"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "slatprep"

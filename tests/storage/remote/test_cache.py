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
    folders = {VARIABLE: "own", "XDG_CACHE_HOME": "xdg", "HOME": "home"}
    for variable, folder in folders.items():
        monkeypatch.setenv(variable, str(tmp_path / folder))
    for variable, found in zip(
        folders, ("own", "xdg/slatprep", "home/.cache/slatprep"), strict=True
    ):
        assert cache_folder() == tmp_path / found
        monkeypatch.delenv(variable)

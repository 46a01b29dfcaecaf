"""Reading by obstore gives what reading by s3fs gives, and leaves to s3fs what it cannot do."""

import multiprocessing
import os

import numpy as np
import pytest

from slatprep.storage.place import place_of
from slatprep.storage.ranges import range_reader
from slatprep.storage.remote import RemoteFile
from slatprep.store import open_store

pytest.importorskip("obstore")


@pytest.fixture
def obstore(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLATPREP_OBSTORE", "yes")


@pytest.mark.usefixtures("obstore")
def test_a_store_reads_as_by_s3fs(url, s3, undisturbed, requests, monkeypatch):
    s3.put(str(undisturbed[1]), url, recursive=True)
    requests.made.clear()
    by_obstore = [asset.feats for asset in open_store(url)]
    assert requests.of("get_object") == []  # s3fs was asked for no bytes.
    monkeypatch.setenv("SLATPREP_OBSTORE", "no")
    for here, there in zip(by_obstore, open_store(url), strict=True):
        np.testing.assert_array_equal(here, there.feats)
    assert requests.of("get_object")


@pytest.mark.usefixtures("obstore")
def test_ranges_and_faults_are_those_of_a_file(bucket, s3):
    s3.pipe_file(f"{bucket}/a", b"0123456789")
    file = RemoteFile(place_of(f"s3://{bucket}/a"))  # type: ignore[arg-type]
    assert file.pread(4, 3) == b"3456"
    assert file.pread(100, 8) == b"89"
    assert file.pread(5, 10) == b""
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
@pytest.mark.parametrize(
    ("name", "value"),
    [("AWS_SECRET_ACCESS_KEY", ""), ("AWS_PROFILE", "mine"), ("SLATPREP_OBSTORE", "no")],
)
def test_without_known_credentials_s3fs_reads(name, value, monkeypatch):
    monkeypatch.setenv(name, value)
    assert range_reader("bucket") is None

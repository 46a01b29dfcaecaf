"""URLs that stand where paths stand."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from slatprep.errors import ConfigError
from slatprep.readers.files import load_source
from slatprep.readers.names import RemoteNames
from slatprep.storage.remote import RemotePath, as_path, list_objects


@pytest.mark.parametrize(
    ("place", "shown"),
    [
        ("s3://bucket/a/b.zarr", "s3://bucket/a/b.zarr"),
        (Path("s3://bucket/a"), "s3://bucket/a"),  # pathlib has made one slash of two
        ("gs://bucket", "gs://bucket"),
        ("memory://a/", "memory://a"),
    ],
)
def test_a_url_is_a_path_that_shows_as_a_url(place: str | Path, shown: str) -> None:
    path = as_path(place)
    assert isinstance(path, RemotePath)
    assert str(path) == shown
    assert as_path(str(path)) == path
    again = pickle.loads(pickle.dumps(path))
    assert isinstance(again, RemotePath)
    assert again == path


@pytest.mark.parametrize(
    ("place", "local"),
    [
        ("demo.zarr", "demo.zarr"),
        ("/data/demo.zarr", "/data/demo.zarr"),
        ("file:///data/demo.zarr", "/data/demo.zarr"),
        (Path("file:///data/demo.zarr"), "/data/demo.zarr"),
        ("C:/data", "C:/data"),
    ],
)
def test_all_else_is_a_local_path(place: str | Path, local: str) -> None:
    assert as_path(place) == Path(local)
    assert not isinstance(as_path(place), RemotePath)


def test_paths_of_a_url_are_made_as_of_any_path() -> None:
    path = as_path("s3://bucket/a/demo.zarr")
    assert str(path / "x" / "y") == "s3://bucket/a/demo.zarr/x/y"
    assert str(path.parent) == "s3://bucket/a"
    assert str(path.with_name("other")) == "s3://bucket/a/other"
    assert (path / "x/y").relative_to(path).parts == ("x", "y")
    assert path.is_absolute()
    assert path.absolute() == path.resolve() == path.expanduser() == path


def test_an_object_is_read_as_a_file(s3: Any, bucket: str) -> None:
    s3.pipe_file(f"{bucket}/folder/text.txt", "Grüße\n".encode())
    s3.pipe_file(f"{bucket}/empty", b"")
    path = as_path(f"s3://{bucket}") / "folder" / "text.txt"
    assert path.read_text("utf-8") == "Grüße\n"
    assert path.exists()
    assert path.is_file()
    assert not path.is_dir()
    assert path.parent.is_dir()
    assert path.stat().st_size == 8
    with path.open(encoding="utf-8") as lines:
        assert list(lines) == ["Grüße\n"]
    assert as_path(f"s3://{bucket}/empty").read_bytes() == b""
    assert not as_path(f"s3://{bucket}/none").exists()


def test_nothing_is_made_or_removed_by_a_path(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    path = as_path("s3://bucket/new")
    for refused in (
        lambda: path.mkdir(parents=True),
        lambda: path.write_text("x"),
        lambda: path.open("w"),
        lambda: path.unlink(missing_ok=True),
        lambda: list(path.iterdir()),
    ):
        with pytest.raises(OSError, match="possible at a local path only: 's3://bucket/new'"):
            refused()
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_read_is_named(s3: Any, bucket: str) -> None:
    with pytest.raises(FileNotFoundError, match=f"key does not exist: 's3://{bucket}/none'"):
        as_path(f"s3://{bucket}/none").read_bytes()
    with pytest.raises(FileNotFoundError, match="bucket does not exist: 's3://no-such/none'"):
        as_path("s3://no-such/none").read_bytes()
    with pytest.raises(ConfigError, match=r"s4://bucket/x: cannot be reached .*not known"):
        as_path("s4://bucket/x").read_bytes()


def test_missing_credentials_are_told_of_the_place(
    bucket: str, monkeypatch: Any, new_clients: Any
) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    new_clients()
    with pytest.raises(OSError, match=f"Unable to locate credentials: 's3://{bucket}/x'"):
        as_path(f"s3://{bucket}/x").read_bytes()


def test_objects_that_no_path_could_name_are_left_out(s3: Any, bucket: str) -> None:
    for key in ("a", "b/c", "../up", "b/../../up", "d//e", "./f", "g/", "back\\slash"):
        s3.pipe_file(f"{bucket}/root/{key}", b"x")
    s3.pipe_file(f"{bucket}/rooted", b"x")
    root = as_path(f"s3://{bucket}/root")
    assert isinstance(root, RemotePath)
    assert list(list_objects(root)) == ["a", "b/c"]
    names = RemoteNames.of(root)
    assert set(names.of_folder("")) == {"a", "b"}
    assert names.is_file("b/c")
    assert not names.is_file("b")
    with pytest.raises(Exception, match="no plain name below its root"):
        load_source(root / "b" / ".." / "a", root, "grid")


def test_a_file_that_is_too_large_is_not_read_whole(s3: Any, bucket: str, monkeypatch: Any) -> None:
    monkeypatch.setattr("slatprep.readers.files.MAX_FILE_BYTES", 2**20)
    root = as_path(f"s3://{bucket}")
    s3.pipe_file(f"{bucket}/fits", bytes(2**20))
    s3.pipe_file(f"{bucket}/large", bytes(2**20 + 1))
    s3.pipe_file(f"{bucket}/empty", b"")
    assert len(load_source(root / "fits", root, "grid")[0]) == 2**20
    with pytest.raises(Exception, match="large: is larger than 1 MiB"):
        load_source(root / "large", root, "grid")
    with pytest.raises(Exception, match="empty: has zero bytes"):
        load_source(root / "empty", root, "grid")


def test_without_the_extra_a_url_says_what_to_install() -> None:
    script = (
        "import sys; sys.modules['fsspec'] = None\n"
        "from slatprep.cli import main\n"
        "sys.argv[1:] = ['info', 's3://bucket/demo.zarr']\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "s3://bucket/demo.zarr" in done.stderr
    assert "pip install 'slatprep[remote]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_local_work_imports_nothing_of_it(undisturbed: Any) -> None:
    _, store = undisturbed
    script = (
        "import sys\nfrom slatprep import open_store\nimport slatprep.cli.commands\n"
        "open_store(sys.argv[1]).read(0)\n"
        "print([name for name in sys.modules if name.split('.')[0] in ('fsspec', 's3fs')])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(store)], check=True, capture_output=True, text=True
    )
    assert done.stdout == "[]\n"

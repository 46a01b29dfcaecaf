"""A store of PixieVerse from the hub, which refuses, redirects, breaks off and changes."""

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from huggingface_hub import HfFileSystem, constants
from support.published import IDS, pack, parameters
from support.published_hub import PublishedHub
from support.trees import tree

from slatprep import ConfigError, InputError, build_store, discover, open_store
from slatprep.inspect.verify import verify_store
from slatprep.readers.published import fetch_members

NAME = "vlongle/pixieverse"
URL = f"hf://datasets/{NAME}"


@pytest.fixture
def hub(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PublishedHub]:
    """Serve the archives; nobody's own settings or token get in."""
    with PublishedHub() as server:
        server.publish(NAME, made / "tar")
        monkeypatch.setenv("HF_ENDPOINT", server.address)
        own = constants.HUGGINGFACE_CO_URL_TEMPLATE.removeprefix(constants.ENDPOINT)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", server.address + own)
        monkeypatch.setattr(constants, "ENDPOINT", server.address)
        monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "token"))
        monkeypatch.delenv("HF_TOKEN", raising=False)
        monkeypatch.setenv("SLATPREP_CACHE", str(tmp_path / "cache"))
        HfFileSystem.clear_instance_cache()
        yield server
        server.shutdown()
    HfFileSystem.clear_instance_cache()


@pytest.mark.parametrize(("root", "cut"), [("", 0), ("@main", 2)])
def test_store_of_the_hub_is_that_of_the_unpacked_folder(hub, made, tmp_path, unpacked, root, cut):
    """Also where connections end in the middle, and without members that have no SLAT."""
    hub.cut = cut
    build_store(parameters(made, URL + root), tmp_path / "s.zarr")
    assert hub.cut == 0 and tree(tmp_path / "s.zarr") == unpacked
    kept = [path for path in (tmp_path / "cache").rglob("*.z") if path.name != "index.z"]
    assert len(kept) == 4 * 3
    assert verify_store(tmp_path / "s.zarr", sources=True).ok


def test_one_archive_of_the_hub_and_one_with_gzip(objects, hub, made):
    for root, name in (("tar", "tree.tar"), ("gz", "tree.tar.gz")):
        hub.publish(NAME, made / root)
        found = discover(parameters(made, f"{URL}/archives/render_outputs/{name}"))
        pairs = [one for one in found if not one.problem]
        assert [one.asset_id for one in pairs] == [IDS[0], IDS[3]]
        own = objects / IDS[3] / "sample_0" / "material_grid.npy"
        assert pairs[1].grid.read_bytes() == own.read_bytes()


def test_second_look_reads_nothing_and_another_commit_what_changed(objects, hub, made, tmp_path):
    build_store(parameters(made, URL), tmp_path / "s.zarr")
    hub.requests.clear()
    assert build_store(parameters(made, URL), tmp_path / "s.zarr").statuses["ok"] == 4
    assert hub.ranges() == 0
    root = shutil.copytree(made / "tar", tmp_path / "next")
    pack(root / "archives/render_outputs/tree.tar", [objects / IDS[0]])
    hub.publish(NAME, root)
    build_store(parameters(made, URL), tmp_path / "s.zarr")
    asked = {path.rpartition("/")[2] for _, path in hub.requests if "/resolve/" in path}
    assert asked == {"tree.tar"}
    assert IDS[3] not in open_store(tmp_path / "s.zarr").ids


def test_bytes_are_told_and_kept_when_a_build_stops(hub, made, tmp_path, monkeypatch):
    lines: list[str] = []
    monkeypatch.setattr("slatprep.readers.published._EVERY_S", 0.0)
    monkeypatch.setattr("slatprep.storage.members._AT_ONCE", 1)
    hub.delay = 0.05

    def stop(line: str) -> None:
        lines.append(line)
        if line.startswith("fetched") and not line.startswith("fetched 0 "):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_store(parameters(made, URL), tmp_path / "s.zarr", note=stop)
    assert lines[0].startswith("archives: looked through")
    first = hub.ranges()
    hub.requests.clear()
    lines.clear()
    build_store(parameters(made, URL), tmp_path / "s.zarr", note=lines.append)
    assert 0 < hub.ranges() < first
    assert not any(line.startswith("archives") for line in lines)


def test_neighbours_come_with_one_request(objects, hub, made, tmp_path):
    pairs = [pair for pair in discover(parameters(made, URL)) if not pair.problem]
    hub.requests.clear()
    fetch_members(pairs, None)
    assert 4 <= hub.ranges() <= 8  # Four objects of three members each.
    hub.requests.clear()
    for pair in pairs:
        for place in (pair.grid, pair.mask, pair.bounds):
            own = objects / str(place).partition(".tar/")[2]
            assert place.read_bytes() == own.read_bytes()
    assert hub.ranges() == 0


def test_token_is_sent_to_the_hub_alone(hub, made, tmp_path, monkeypatch):
    hub.token = "hf_secret"
    with pytest.raises(ConfigError, match="HF_TOKEN"):
        discover(parameters(made, URL))
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    HfFileSystem.clear_instance_cache()
    with PublishedHub() as elsewhere:
        elsewhere.commits = hub.commits
        hub.elsewhere = elsewhere
        build_store(parameters(made, URL), tmp_path / "s.zarr")
        elsewhere.shutdown()
    assert elsewhere.ranges() > 0 and set(elsewhere.tokens) == {""}


def test_too_many_requests_are_waited_for_as_told(hub, made):
    pair, *_ = discover(parameters(made, URL))
    hub.refused, hub.wait = 1, 2
    begin = time.monotonic()
    pair.grid.read_bytes()
    assert hub.refused == 0 and time.monotonic() - begin >= 2


def test_build_stays_with_the_commit_that_it_began_with(objects, hub, made):
    pair, *_ = discover(parameters(made, URL))
    hub.publish(NAME, made / "gz")
    own = objects / IDS[0] / "sample_0" / "material_grid.npy"
    assert pair.grid.read_bytes() == own.read_bytes()


def test_archive_that_changes_within_a_commit_is_named(objects, hub, made, tmp_path):
    root = shutil.copytree(made / "tar", tmp_path / "own")
    hub.publish(NAME, root)
    pair, *_ = discover(parameters(made, URL))
    pack(root / "archives/render_outputs/tree.tar", [objects / IDS[1], objects / IDS[2]])
    with pytest.raises(InputError, match=r"tree\.tar: was replaced after it was looked at"):
        pair.grid.read_bytes()


def test_dataset_that_is_not_there_is_named(hub, made):
    with pytest.raises(ConfigError, match="nobody/nothing"):
        discover(parameters(made, "hf://datasets/nobody/nothing"))

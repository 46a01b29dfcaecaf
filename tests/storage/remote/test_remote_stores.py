"""Stores that lie on S3: made, replaced in one step, interrupted, read and verified."""

import errno
import gc
import multiprocessing
import pickle
import shutil
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import zarr
from botocore.exceptions import FlexibleChecksumError
from s3fs.core import S3FileSystem
from support.commands import document, refused
from support.faults import inject
from support.faulty_proxy import Faults, faulty
from support.remote import current, few_files, put, raising, versions
from support.trees import contents, tree

from slatprep import ConfigError, Store, StoreError, open_store, subset_store
from slatprep.inspect.overview import overview_of
from slatprep.inspect.verify import verify_store
from slatprep.parameters import StoreParameters
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.pipeline.decoys import measure_errors
from slatprep.storage.place import place_of, storage_of
from slatprep.storage.upload import published_state, upload_store
from slatprep.storage.versions import Pointer
from slatprep.store.shard_reader import UnreachableError
from slatprep.store.shard_writer import ShardWriter


def test_a_store_built_from_s3_to_s3_equals_the_local_one(s3, url, uploaded, undisturbed, tmp_path):
    expected = undisturbed[1]
    summary = build_store(uploaded, url, jobs=2)
    assert summary.complete
    assert str(summary.store) == url
    assert current(s3, url) == tree(expected)
    assert summary.records.read_text().count("\n") == 3
    store = open_store(url)
    assert store.name == "demo.zarr"
    assert_same(store, open_store(expected))
    # Plain zarr knows nothing of pointers, and needs none.
    group = zarr.open_group(str(store.path), mode="r")
    assert (group["voxel/coords"][:] == zarr.open_group(expected)["voxel/coords"][:]).all()
    assert verify_store(url, sources=True).findings == ()
    assert not any((tmp_path / "cache").rglob("*.arrays"))


def test_a_source_is_never_replaced_on_s3_either(s3, published, undisturbed):
    url = published
    before = versions(s3, url)
    for source in (url, str(open_store(url).path)):
        with pytest.raises(ConfigError, match="is a store to take assets from"):
            subset_store(source, url, ["a"])
    own = open_store(url).path
    for inner in (own / "inner", f"{url}/versions/a/b", f"{url}/manifests/x.zarr", f"{url}/spool"):
        with pytest.raises(StoreError, match=f"{inner} lies in the store {url}; expected"):
            subset_store(undisturbed[1], inner, ["a"])
    assert subset_store(undisturbed[1], url.replace("stores", "manifests"), ["a"]).complete
    assert versions(s3, url) == before
    assert subset_store(url, f"{url}.zarr", ["a"]).complete


def assert_same(left: Store, right: Store) -> None:
    assert left.ids == right.ids
    for row in range(len(left)):
        for name, values in left.read(row).items():
            np.testing.assert_array_equal(values, right.read(row)[name])
        np.testing.assert_array_equal(left[row].grid_properties, right[row].grid_properties)


def flipped(content: bytes) -> bytes:
    return content[:100] + bytes([content[100] ^ 1]) + content[101:]


def removed(content: bytes) -> bytes:
    return b""


def test_opening_costs_the_pointer_and_one_more_read(url, undisturbed, requests, tmp_path):
    shards = StoreParameters(voxel_chunk=128)  # One of each array, a dozen chunks an asset.
    build_store(replace(undisturbed[0].parameters("pixie"), store=shards), tmp_path / "s.zarr")
    put(tmp_path / "s.zarr", url)
    requests.made.clear()
    store = open_store(url)
    assert [method for method, _ in requests.made] == ["get_object"] * 2
    store.read(0)
    requests.made.clear()
    store.read(1)
    # The chunks of an asset lie side by side and come at once, of each of three arrays.
    assert [method for method, _ in requests.made] == ["get_object"] * 3


def test_what_did_not_change_is_neither_aligned_nor_uploaded_again(s3, url, make_dataset, requests):
    dataset = make_dataset("a", "b")
    build_store(dataset.parameters("pixie"), url)
    first = contents(s3, url)
    requests.made.clear()
    assert build_store(dataset.parameters("pixie"), url).statuses["ok"] == 2
    assert requests.of("put_object") == []
    # All done again, from nothing, gives the same bytes, which are there already.
    build_store(dataset.parameters("pixie"), url, fresh=True)
    assert {Path(key).name for key in requests.of("put_object")} <= {"assets.jsonl", "build.json"}
    assert contents(s3, url).keys() == first.keys()


def test_a_damaged_version_is_uploaded_anew(s3, url, another):
    put(another[1], url)
    for damage in (s3.rm_file, lambda name: s3.pipe_file(name, flipped(s3.cat_file(name)))):
        damage(f"{open_store(url).path}/voxel/material/c/0")
        build_store(another[0].parameters("pixie"), url, fresh=True)
        assert current(s3, url) == tree(another[1])


def test_one_older_version_is_kept_or_more_are_told(s3, url, another, new_clients, tmp_path):
    first = put(another[1], url)
    readers, known = [open_store(url), open_store(first)], open_store(another[1]).read(0)
    one, other = (few_files(tmp_path / name, name) for name in ("one", "other"))
    second = put(one, url)
    for reader in readers:
        np.testing.assert_array_equal(reader.read(0)["feats"], known["feats"])
    assert first.name in versions(s3, url)
    third = upload_store(other, published_state(place_of(url)))
    told = r"older versions could not be removed \(Access Denied\)"

    def denied(*args: Any, **options: Any) -> None:
        raise PermissionError("Access Denied")

    with pytest.MonkeyPatch.context() as client, pytest.warns(UserWarning, match=told):
        client.setattr(S3FileSystem, "call_s3", denied)
        third.publish()
    new_clients()
    assert current(s3, url) == tree(other)
    assert len(versions(s3, url)) == 3
    # The next one removes them.
    fourth = put(one, url)
    assert fourth.name != second.name
    assert versions(s3, url) == {third.version.name, fourth.name}
    for reader in readers:
        with pytest.raises(StoreError, match=r"c/0: is missing \(was the store replaced\? Open it"):
            reader.read(0, ("distance",))
    assert current(s3, url) == tree(one)


def test_who_opens_it_while_it_is_replaced_finds_one_or_the_other_whole(url, undisturbed, another):
    stores = {tuple(open_store(path).ids): open_store(path) for _, path in (undisturbed, another)}
    put(undisturbed[1], url)
    seen: list[tuple[str, ...]] = []
    stop = threading.Event()

    def read() -> None:
        while not stop.is_set():
            store = open_store(url)
            expected = stores[tuple(store.ids)]
            np.testing.assert_array_equal(store.read(0)["feats"], expected.read(0)["feats"])
            seen.append(tuple(store.ids))

    with ThreadPoolExecutor(1) as pool, ExitStack() as ending:
        ending.callback(stop.set)
        reader = pool.submit(read)
        for path in (another[1], undisturbed[1]):
            count = len(seen)
            put(path, url)
            while len(seen) < count + 3 and not reader.done():
                stop.wait(0.01)
    reader.result()
    assert set(seen) == set(stores)


def test_each_fault_of_a_store_is_named(published, damage):
    url, version = published, open_store(published).path
    for name, how in (
        ("voxel/coords/c/0/0", removed), ("voxel/feats/c/0/0", flipped),
        ("asset/fitness/c/0", lambda content: content[:-3]), ("stray", lambda _: b"x"),
    ):  # fmt: skip
        damage(name, how)
    told = document("verify", url, "--jobs", 1, code=1)
    assert told["store"] == url
    found = {(finding["file"], finding["what"]) for finding in told["findings"]}
    assert ("voxel/coords/c/0/0", "is missing") in found
    assert ("voxel/feats/c/0/0", "its bytes changed") in found
    assert ("stray", "belongs to no array") in found
    assert any(name == "asset/fitness/c/0" and "cut short" in what for name, what in found)
    store = open_store(url)
    with pytest.raises(StoreError, match=f"{version}/voxel/coords/c/0/0: is missing"):
        store.read(0, ("coords",))
    with pytest.raises(StoreError, match=f"{version}/voxel/feats/c/0/0: chunk 0 is damaged"):
        store.read(0, ("feats",))
    damage("zarr.json", removed)
    with pytest.raises(StoreError, match=f"{version}/zarr.json does not exist"):
        verify_store(url)


@pytest.mark.parametrize("error", [OSError("connection lost"), PermissionError("Denied")])
@pytest.mark.parametrize("lost", [
    "voxel/feats/c/0", "asset/id/c/0", "file/sha256/c/0", "voxel/coords/zarr.json",
])  # fmt: skip
def test_what_the_server_does_not_give_is_not_called_damaged(published, change_client, error, lost):
    client = raising(error, S3FileSystem._cat_file, lambda path, options: lost in path)
    change_client("_cat_file", client)
    told = rf"{lost}.*: cannot be read \({error}.*check the network and your permissions"
    with pytest.raises(UnreachableError, match=told) as caught:
        verify_store(published)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    if not lost.endswith("zarr.json"):
        with pytest.raises(UnreachableError, match=told):
            open_store(published).read_rows(lost.removesuffix("/0").removesuffix("/c"), 0, 1)


def test_without_the_right_to_list_what_was_never_written_is_denied(published, change_client):
    denied = raising(
        PermissionError("Denied"), S3FileSystem._cat_file, lambda path, _: gone in path
    )
    gone = "asset/category/c/0"
    change_client("_cat_file", denied)
    assert open_store(published).column("category").tolist() == [""] * 3


@pytest.mark.parametrize("obstore", ["yes", "no"])
def test_a_bucket_or_server_that_is_not_there_is_told(bucket, server, monkeypatch, obstore):
    monkeypatch.setenv("SLATPREP_OBSTORE", obstore)
    for url, told in (
        ("s3://no-such/x", "^s3://no-such/x is not a slatprep store: its bucket does not exist;"),
        (f"s3://{bucket}/x", f"store: s3://{bucket}/x/zarr.json does not exist;"),
        (f"{server}/{bucket}/x", f"store: {server}/{bucket}/x/zarr.json does not exist;"),
        ("http://127.0.0.1:1/x", "^http://127.0.0.1:1/x: cannot be reached .*connect"),
    ):
        with pytest.raises(StoreError, match=told):
            open_store(url)


@pytest.mark.parametrize(("status", "number"), [
    (403, errno.EACCES), (404, errno.ENOENT), (410, errno.ENOENT), (500, errno.EIO),
])  # fmt: skip
def test_a_web_server_says_why_it_gives_no_file(status, number):
    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(status)

        do_HEAD = do_GET  # noqa: N815

    with ThreadingHTTPServer(("127.0.0.1", 0), Answer) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        place = place_of(f"http://127.0.0.1:{server.server_port}/x.zarr/current.json")
        with pytest.raises(OSError) as caught:
            place.read_bytes()
        server.shutdown()
    assert caught.value.errno == number


@pytest.mark.parametrize("text", [
    b"", b"{", b"[]", b'{"format": "other"}', b"[" * 100_000,
    *(Pointer(*names, "", "").encode() for names in (("../../x", ""), ("0123456789abcdef", ".."))),
])  # fmt: skip
def test_a_pointer_that_is_none_is_refused(s3, url, text, undisturbed):
    s3.pipe_file(f"{url}/current.json", text)
    told = f"^{url}/current.json: names no version"
    with pytest.raises(StoreError, match=told):
        open_store(url)
    with pytest.raises(StoreError, match=told):
        build_store(undisturbed[0].parameters("pixie"), url)
    assert s3.cat_file(f"{url}/current.json") == text


def test_places_that_take_nothing_are_told_first(
    s3, bucket, published, undisturbed, monkeypatch, new_clients
):
    parameters = undisturbed[0].parameters("pixie")
    begun: list[str] = []
    inject(monkeypatch, lambda step, name: step == "asset begun" and begun.append(name))
    with pytest.raises(StoreError, match=r"^s3://no-such/a.zarr: cannot be reached .*bucket does"):
        build_store(parameters, "s3://no-such/a.zarr")
    s3.pipe_file(f"{bucket}/mine/notes.txt", b"keep")
    with pytest.raises(StoreError, match=f"^s3://{bucket}/mine holds notes.txt and is not"):
        build_store(parameters, f"s3://{bucket}/mine")
    with pytest.raises(StoreError, match=f"^s3://{bucket}/mine holds notes.txt and is not"):
        plan_build(parameters, f"s3://{bucket}/mine")
    with pytest.raises(StoreError, match=f"is one version .* expected {published}$"):
        build_store(parameters, open_store(published).path)
    with pytest.raises(StoreError, match="expected a local folder for the records"):
        build_store(parameters, published, manifests=place_of(f"s3://{bucket}/m"))
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    new_clients()
    told = r"cannot be reached .*Unable to locate credentials.*AWS_PROFILE"
    with pytest.raises(StoreError, match=told):
        build_store(parameters, published)
    with pytest.raises(StoreError, match=told):
        open_store(published)
    assert begun == []


def test_a_shard_that_finds_no_temporary_file_says_so(published, monkeypatch, tmp_path):
    store = open_store(published).path
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    with pytest.raises(StoreError, match="voxel/valid/c/0: cannot be written to s3://"):
        ShardWriter(store, "voxel/valid", 0)


@pytest.mark.parametrize("use", ["build", "verify", "info"])
def test_a_store_that_cannot_be_listed_is_refused_in_words(
    published, undisturbed, change_client, use
):
    change_client("_lsdir", raising(OSError("connection lost")))
    with pytest.raises(StoreError, match=r"cannot be listed \(connection lost"):
        if use == "build":
            build_store(undisturbed[0].parameters("pixie"), published)
        elif use == "verify":
            verify_store(published)
        else:
            overview_of(open_store(published))


@pytest.mark.parametrize("kind", ["403", "503"])
def test_a_build_over_a_store_that_does_not_answer_aligns_nothing_anew(
    published, undisturbed, server, monkeypatch, new_clients, kind
):
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")  # A refused request is not repeated.
    begun: list[str] = []
    inject(monkeypatch, lambda step, name: step == "asset begun" and begun.append(name))
    silent = Faults(chance=1.0, kinds=(kind,), lasting=True, only=r"zarr\.json")
    with faulty(server, silent) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy)
        new_clients()
        with pytest.raises(StoreError, match=r"zarr\.json: cannot be read .*run again"):
            build_store(undisturbed[0].parameters("pixie"), published)
    assert begun == []


@pytest.mark.parametrize("obstore", ["yes", "no"])
@pytest.mark.parametrize("command", ["info", "verify", "describe"])
def test_a_store_that_may_not_be_read_is_no_other_thing(
    s3, bucket, server, monkeypatch, new_clients, obstore, command
):
    s3.pipe_file(f"{bucket}/s.zarr/zarr.json", b"{}")
    monkeypatch.setenv("SLATPREP_OBSTORE", obstore)
    denied = Faults(chance=1.0, kinds=("403",), lasting=True, only=r"zarr\.json")
    with faulty(server, denied) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy)
        new_clients()
        told = refused(command, f"s3://{bucket}/s.zarr", code=1).splitlines()[-1]
    assert told.startswith(f"slatprep: error: s3://{bucket}/s.zarr/zarr.json: cannot be read (")
    assert "(None)" not in told


def test_an_answer_that_zarr_cannot_use_ends_a_command_in_words(published, change_client):
    error = FlexibleChecksumError(error_msg="another checksum")
    # zarr-python asks for files, slatprep for ranges.
    whole = raising(error, S3FileSystem._cat_file, lambda path, options: not options)
    change_client("_cat_file", whole)
    told = refused("describe", published, code=1)
    assert "bad metadata" in told and "another checksum" in told


def test_records_nobody_can_ask_for_end_a_command_in_words(published, change_client, tmp_path):
    lost = OSError("connection lost")
    deaf = raising(lost, S3FileSystem._info, lambda path, options: "/manifests/" in path)
    change_client("_info", deaf)
    with pytest.raises(StoreError, match=r"manifests/.*: cannot be reached \(connection lost"):
        verify_store(published)
    told = refused("subset", published, "--asset", "a", "--out", tmp_path / "s.zarr", code=1)
    assert "connection lost" in told
    assert not (tmp_path / "s.zarr").exists()


def test_a_store_that_is_no_folder_is_not_published_and_its_url_named(published, tmp_path):
    told = refused("publish", published, "--out", tmp_path / "hub")
    assert f"is on no local disk; `slatprep subset {published}/versions/" in told


@pytest.mark.parametrize(("call", "said"), [
    ("_put_file", "cannot be written to .*Access Denied"),
    ("_get_file", r"cannot be copied to .*Access Denied"),
])  # fmt: skip
def test_a_transfer_that_fails_ends_in_one_error(
    call, said, published, url, tmp_path, change_client, recwarn
):
    store = few_files(tmp_path / "s.zarr", "{}")

    async def denied(*given: Any, **options: Any) -> None:
        raise PermissionError("Access Denied")

    change_client(call, denied)
    with pytest.raises(StoreError, match=said):
        if call == "_get_file":
            open_store(published, copy=True)
        else:
            put(store, url)
    gc.collect()
    assert not [one for one in recwarn if "never awaited" in str(one.message)]


def test_errors_measured_where_nothing_may_be_written_are_told(published, change_client):
    change_client("_put_file", raising(PermissionError("Access Denied")))
    with pytest.warns(UserWarning, match=r"decoys.json: .* could not be kept \(Access Denied\)"):
        assert measure_errors(open_store(published), decoys=1).decoys


def test_an_error_that_no_room_has_words_for_is_one_line(another, monkeypatch):
    def lost(*args: Any) -> None:
        raise OSError(errno.EIO, "connection lost", "s3://bucket/x")

    monkeypatch.setattr("slatprep.inspect.overview.overview_of", lost)
    told = refused("info", another[1], code=1)
    assert told == "slatprep: error: s3://bucket/x: connection lost; run again\n"


def test_records_may_be_kept_on_the_local_disk(s3, url, make_dataset, tmp_path):
    parameters = make_dataset("a").parameters("pixie")
    summary = build_store(parameters, url, manifests=tmp_path / "records")
    assert summary.records == tmp_path / "records" / "assets.jsonl"
    assert not any(name.startswith("manifests/") for name in contents(s3, url))
    assert verify_store(url, manifests=tmp_path / "records").findings == ()
    # Asked for there as well, they are put there.
    again = build_store(parameters, url)
    assert again.build_id == summary.build_id
    assert again.records.read_text().count("\n") == 1


def test_a_forked_process_reads_on(published, undisturbed):
    store = open_store(published)
    store.read(0)
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=lambda: queue.put(store.read(1)["feats"]))
    child.start()
    feats = queue.get(timeout=300)
    child.join()
    np.testing.assert_array_equal(feats, open_store(undisturbed[1]).read(1)["feats"])


def test_a_copy_is_made_once_and_no_name_leads_out(s3, url, undisturbed, requests, tmp_path):
    version = put(undisturbed[1], url)
    for name in ("../../../../escaped", "../escaped", "a/../../escaped"):
        s3.pipe_file(f"{version}/{name}", b"x")
    store = open_store(url, copy=True)
    assert store.path.is_relative_to(tmp_path / "cache")
    assert store.name == "demo.zarr"
    assert tree(store.path) == tree(undisturbed[1])
    assert not list(tmp_path.rglob("escaped"))
    requests.made.clear()
    assert_same(open_store(url, copy=True), open_store(undisturbed[1]))
    assert [key for _, key in requests.made] == ["stores/demo.zarr/current.json"]
    assert storage_of(undisturbed[1]).copied_version() == undisturbed[1]


def test_a_damaged_copy_is_made_again(published, undisturbed):
    copy, whole = Path(str(open_store(published, copy=True).path)), tree(undisturbed[1])
    file, sizes = copy / "voxel/material/c/0", copy.with_name(".demo.zarr.sizes")

    def replace_by(make: Callable[[Path], object]) -> None:
        shutil.rmtree(copy)
        make(copy)

    damages: dict[str, Callable[[], object]] = {
        "removed": file.unlink,
        "cut": lambda: file.write_bytes(file.read_bytes()[:-1]),
        "emptied": lambda: replace_by(Path.mkdir),
        "flipped": lambda: (copy / "zarr.json").write_bytes(
            (copy / "zarr.json").read_bytes().replace(b"slatprep", b"slatpreq")
        ),
        "a file": lambda: replace_by(Path.touch),
        "[]": lambda: (file.unlink(), sizes.write_text("[]")),
        "{}": lambda: (file.unlink(), sizes.write_text("{}")),
    }
    for how, damage in damages.items():
        damage()
        assert Path(str(open_store(published, copy=True).path)) == copy, how
        assert tree(copy) == whole, how


def test_a_damaged_shard_of_a_copy_says_what_to_remove(published, monkeypatch):
    monkeypatch.setattr("slatprep.storage.cache.SMALL_BYTES", 0)
    copy = Path(str(open_store(published, copy=True).path))
    shard = copy / "voxel/feats/c/0/0"
    whole = shard.read_bytes()
    shard.write_bytes(flipped(whole))
    with pytest.raises(StoreError, match=f"damaged.* Remove {copy}, a copy, and open the store"):
        open_store(published, copy=True).read(0)
    own = shutil.copytree(copy, copy.with_name("own.zarr"))  # No copy, though it lies in the cache.
    with pytest.raises(StoreError, match="Copy the store again, or build it"):
        open_store(own).read(0)
    shutil.rmtree(copy)
    open_store(published, copy=True)
    assert shard.read_bytes() == whole


def test_a_copy_that_differs_from_what_was_published_is_none(published, damage, tmp_path):
    damage("voxel/feats/c/0/0", flipped)
    with pytest.raises(StoreError, match=r"copy is not what was published there.*slatprep verify"):
        open_store(published, copy=True)
    assert not list((tmp_path / "cache").rglob("zarr.json"))


@pytest.mark.parametrize("part_bytes", [None, 5 * 2**20])
def test_an_upload_that_arrives_with_another_bit_is_not_published(
    part_bytes, s3, url, server, tmp_path, monkeypatch, new_clients
):
    store, spoiled = few_files(tmp_path / "s.zarr", "{}"), "zarr.json"
    if part_bytes is not None:  # Large enough for several parts.
        monkeypatch.setattr("slatprep.storage.remote.PART_BYTES", part_bytes)
        monkeypatch.setattr("slatprep.storage.upload.PART_BYTES", part_bytes)
        (store / spoiled).write_bytes(bytes(12 * 2**20))
    faults = Faults(chance=1.0, kinds=("upload flipped",), only=spoiled)
    with faulty(server, faults) as proxy, monkeypatch.context() as through:
        through.setenv("AWS_ENDPOINT_URL", proxy)
        new_clients()
        # The client refuses to read back what has another checksum than it sent along.
        told = f"{spoiled}: is not there as it was uploaded|not match calculated checksum"
        with pytest.raises(StoreError, match=told) as raised:
            put(store, url)
        assert "nothing was replaced" in str(raised.value).replace("\n", " ")
    new_clients()
    assert faults.told["upload flipped"] > 0
    assert not s3.exists(f"{url}/current.json")
    put(store, url)
    assert current(s3, url) == tree(store)


def test_a_store_that_was_copied_there_as_it_is_can_be_read(s3, bucket, undisturbed):
    s3.put(f"{undisturbed[1]}/", f"{bucket}/plain.zarr/", recursive=True)
    assert_same(open_store(f"s3://{bucket}/plain.zarr"), open_store(undisturbed[1]))
    with pytest.raises(StoreError, match="lies there without versions"):
        open_store(f"s3://{bucket}/plain.zarr", copy=True)
    with pytest.raises(StoreError, match="is not a slatprep store with versions"):
        build_store(undisturbed[0].parameters("pixie"), f"s3://{bucket}/plain.zarr")


def test_other_file_systems_of_fsspec_do_as_well(make_dataset, tmp_path):
    dataset, place = make_dataset("a"), "memory://stores/demo.zarr"
    fsspec.filesystem("memory").rm("/", recursive=True)
    build_store(dataset.parameters("pixie"), place)
    dataset.add("b", seed=1)
    build_store(dataset.parameters("pixie"), place)
    build_store(dataset.parameters("pixie"), f"file://{tmp_path}/local.zarr")
    assert_same(open_store(place), open_store(tmp_path / "local.zarr"))
    assert verify_store(place).findings == ()
    assert plan_build(dataset.parameters("pixie"), place).actions["reuse"] == 2

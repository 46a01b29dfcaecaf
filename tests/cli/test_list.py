"""`slatprep list`, and ids given by their beginning."""

import sys

import pytest
from support.commands import document, run

from slatprep import StoreError, open_store
from slatprep.cli import output as module
from slatprep.inspect.overview import list_assets
from slatprep.store.records import StoredRecords


def test_every_asset_is_in_a_line_with_what_the_store_says(mixed_build):
    store = open_store(mixed_build.store)
    documents = document("list", store.path)["assets"]
    assert [one["asset_id"] for one in documents] == store.ids
    frame = store.to_pandas()
    for one in documents:
        for name in ("category", "verdict", "confidence", "fitness", "voxels"):
            assert one[name] == frame.loc[one["asset_id"], name]
    lines = run("list", store.path).stdout.splitlines()
    assert lines[0] == "5 of 5 assets" and len(lines) == 8
    assert run("list", store.path, "--ids").stdout.split() == store.ids


def test_filters_leave_what_they_say(mixed_build):
    store = open_store(mixed_build.store)
    frame = store.to_pandas()
    limit = float(frame["confidence"].median())
    few = list_assets(store, ("good",), ("",), limit)
    assert [one.asset_id for one in few] == list(frame.index[frame["confidence"] <= limit])
    assert list(list_assets(store, ("failed",))) == list(list_assets(store, (), ("boat",))) == []


def test_why_is_what_the_record_says(deformed_build):
    store = open_store(deformed_build.store)
    records = StoredRecords(store)
    for one in list_assets(store):
        assert one.reasons == records.of(one.asset_id).judgement.reasons
        assert (one.verdict == "good") is (one.reasons == ())


def test_a_beginning_names_an_asset_where_no_other_has_it(mixed_build):
    store = open_store(mixed_build.store)
    assert store.asset("bear.s").asset_id == "bear.side"
    assert store.asset("d").asset_id == "dog"
    for name in ("bear.", "b"):
        with pytest.raises(StoreError, match=r"2 ids begin with .* bear\.front, bear\.side; give"):
            store.match(name)
    with pytest.raises(StoreError, match="did you mean dog"):
        store.find("do")  # What looks one up by its id takes no other.
    with pytest.raises(StoreError, match="it has 5 assets"):
        store.match("")
    words = ("--store", store.path, "--picture", "none", "--asset", "bear.s")
    assert document("check-alignment", *words)["assets"][0]["asset_id"] == "bear.side"


def test_ids_on_a_terminal_are_as_long_as_tells_them_apart(monkeypatch):
    ids = ["0123456789ab", "0123456789cd", "0123zzzzzzzz"]
    assert module.Output().id_length(ids) is None
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert module.Output().id_length(ids) == 11
    assert module.Output().id_length(["a", "b"]) == 8

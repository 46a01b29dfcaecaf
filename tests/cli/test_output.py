"""What commands print, and where; `slatprep list`, and ids given by their beginning."""

import io
import json
import sys
from importlib.metadata import version

import numpy as np
import pytest
from support.commands import document, run

from slatprep import StoreError, open_store
from slatprep.cli import output as module
from slatprep.cli.output import Output, as_json
from slatprep.inspect.overview import list_assets
from slatprep.records import PropertyRange, Verdict
from slatprep.store.records import StoredRecords


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def a_terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Print to a terminal of many colours from now on."""
    stream = Terminal()
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "stderr", stream)
    return stream


ROWS = [("spot", 3, 0.98765, None), ("bunny [bold]", 12345, float("nan"), True)]


def test_plain_table_is_aligned_and_has_no_ornament(capsys):
    Output().table("Assets", ("name", "voxels", "fitness", "right"), ROWS)
    assert capsys.readouterr().out.splitlines() == [
        "Assets",
        "name          voxels  fitness  right",
        "spot               3    0.988  -",
        "bunny [bold]  12,345        -  yes",
        "",
    ]


def test_table_on_a_terminal_is_drawn_and_keeps_square_brackets(monkeypatch):
    terminal = a_terminal(monkeypatch)
    Output().table("Assets", ("name", "voxels", "fitness", "right"), ROWS)
    text = terminal.getvalue()
    assert "bunny [bold]" in text
    assert "─" in text and "\x1b[" in text


def test_narrow_terminal_cuts_no_id_and_no_number(monkeypatch):
    terminal = a_terminal(monkeypatch)
    monkeypatch.setenv("COLUMNS", "30")
    asset_id = "0123456789abcdef0123456789abcdef"
    Output().table("Assets", ("asset", "voxels"), [(asset_id, 12345)])
    assert asset_id in terminal.getvalue() and "12,345" in terminal.getvalue()


@pytest.mark.parametrize("no_color", [False, True])
def test_verdicts_are_coloured_unless_no_color_says_otherwise(monkeypatch, no_color):
    terminal = a_terminal(monkeypatch)
    if no_color:
        monkeypatch.setenv("NO_COLOR", "1")
    Output().table("Assets", ("name", "verdict"), [("spot", "good")])
    green = "\x1b[32m"
    assert "good" in terminal.getvalue()
    assert (green in terminal.getvalue()) is not no_color


def test_json_is_the_only_thing_on_standard_output(capsys):
    printer = Output(as_json=True, command="look")
    printer.note("a note")
    printer.result({"value": float("nan"), "pair": (1, 2)}, lambda: pytest.fail("not for people"))
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {
        "command": "look",
        "version": version("slatprep"),
        "ok": True,
        "value": None,
        "pair": [1, 2],
    }
    assert captured.err == "a note\n"


def test_verbosity(capsys):
    for verbosity in (-1, 0, 1):
        printer = Output(verbosity=verbosity)
        printer.note(f"note {verbosity}")
        printer.problem(f"problem {verbosity}")
    assert capsys.readouterr().err.split("\n")[:-1] == [
        "problem -1",
        "note 0",
        "problem 0",
        "note 1",
        "problem 1",
    ]


def test_json_holds_all_that_results_do(tmp_path):
    document = {
        "a": np.float32(0.5),
        "b": np.arange(2),
        3: {"c": float("inf"), "d": (Verdict.GOOD, True)},
        "e": PropertyRange("density", True, 1.0, float("nan")),
        "f": tmp_path,
    }
    assert json.loads(as_json(document)) == {
        "a": 0.5,
        "b": [0, 1],
        "3": {"c": None, "d": ["good", True]},
        "e": {"name": "density", "log10": True, "lo": 1.0, "hi": None},
        "f": str(tmp_path),
    }
    with pytest.raises(TypeError, match="object"):
        as_json({"g": object()})


def test_time_left_in_a_log_comes_from_all_assets_done(capsys, monkeypatch):
    clock = iter([0.0, 10.0, 60.0, 61.0, 120.0])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    with Output().progress("build") as update:
        update(1, 100)
        update(6, 100)
        update(7, 100)
        update(50, 100)
    assert capsys.readouterr().err.splitlines() == [
        "build: 6 of 100 assets, 15:40 left",
        "build: 50 of 100 assets, 2:00 left",
    ]


def test_no_time_is_told_from_one_asset_or_from_what_came_before_the_first(capsys, monkeypatch):
    clock = iter([0.0, 3600.0, 3640.0, 3680.0])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    with Output().progress("train", "steps") as update:
        update(0, 100)
        update(1, 100)
        update(2, 100)
    assert capsys.readouterr().err.splitlines() == ["train: 2 of 100 steps, 1:05:20 left"]


def test_quiet_shows_no_progress(capsys, monkeypatch):
    monkeypatch.setattr(module.time, "monotonic", iter(range(0, 1000, 100)).__next__)
    with Output(verbosity=-1).progress("build") as update:
        update(1, 2)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("done", [None, 0, 1, 3])
def test_bar_on_a_terminal_counts_assets_and_tells_the_time_left_once_it_can(monkeypatch, done):
    terminal = a_terminal(monkeypatch)
    with Output().progress("build") as update:
        if done is not None:
            update(done, 8)
    shown = terminal.getvalue()
    counted = "3/8 · 0:00 · 0:00 left" if done == 3 else f"{done}/8"
    assert ("starting" if done is None else counted) in shown
    assert ("left" in shown) is (done == 3)


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

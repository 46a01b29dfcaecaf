"""What commands print, and where; commands made of signatures."""

import io
import json
import sys
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import click
import numpy as np
import pytest
from click.testing import CliRunner
from support.commands import document, run

from slatprep import PropertyRange, Verdict, open_store
from slatprep.cli import output as module
from slatprep.cli.output import Output
from slatprep.cli.signature import Click, command
from slatprep.inspect.overview import list_assets
from slatprep.store.records import StoredRecords


def a_terminal(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """Print to a terminal of many colours from now on."""
    stream = io.StringIO()
    stream.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "stderr", stream)
    return stream


def test_plain_table_is_aligned_and_has_no_ornament(capsys):
    rows = [("spot", 3, 0.98765, None), ("bunny [bold]", 12345, float("nan"), True)]
    Output().table("Assets", ("name", "voxels", "fitness", "right"), rows)
    assert capsys.readouterr().out.splitlines() == [
        "Assets",
        "name          voxels  fitness  right",
        "spot               3    0.988  -",
        "bunny [bold]  12,345        -  yes",
        "",
    ]


def test_a_terminal_gets_tables_that_are_drawn_and_cut_no_id_and_no_number(monkeypatch):
    asset_id, green = "0123456789abcdef0123456789abcdef", "\x1b[32m"
    for width, no_color in ((80, ""), (30, ""), (80, "1")):
        terminal = a_terminal(monkeypatch)
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setenv("NO_COLOR", no_color)
        rows = [(asset_id, 12345, "good"), ("bunny [bold]", 3, "failed")]
        Output().table("Assets", ("asset", "voxels", "verdict"), rows)
        text = terminal.getvalue()
        assert all(word in text for word in (asset_id, "12,345", "bunny [bold]", "─", "good"))
        assert (green in text) is not no_color


def test_json_is_the_only_thing_on_standard_output_and_holds_all_that_results_do(capsys, tmp_path):
    printer = Output(as_json=True, command="look")
    printer.note("a note")
    document = {
        "a": np.float32(0.5),
        "b": np.arange(2),
        3: {"c": float("inf"), "d": (Verdict.GOOD, True)},
        "e": PropertyRange("density", True, 1.0, float("nan")),
        "f": tmp_path,
    }
    printer.result(document, lambda: pytest.fail("not for people"))
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {
        "command": "look",
        "version": version("slatprep"),
        "ok": True,
        "a": 0.5,
        "b": [0, 1],
        "3": {"c": None, "d": ["good", True]},
        "e": {"name": "density", "log10": True, "lo": 1.0, "hi": None},
        "f": str(tmp_path),
    }
    assert captured.err == "a note\n"
    with pytest.raises(TypeError, match="object"):
        printer.result({"g": object()}, lambda: None)


def test_verbosity(capsys):
    for verbosity in (-1, 0, 1):
        printer = Output(verbosity=verbosity)
        printer.note(f"note {verbosity}")
        printer.problem(f"problem {verbosity}")
    told = ["problem -1", "note 0", "problem 0", "note 1", "problem 1"]
    assert capsys.readouterr().err.splitlines() == told


@pytest.mark.parametrize(
    ("times", "updates", "told"),
    [
        # From all assets done.
        ((0, 10, 60, 61, 120), ((1, 100), (6, 100), (7, 100), (50, 100)),
         ["6 of 100 assets, 15:40 left", "50 of 100 assets, 2:00 left"]),
        # Neither from one asset nor from what came before the first.
        ((0, 3600, 3640, 3680), ((0, 100), (1, 100), (2, 100)),
         ["2 of 100 assets, 1:05:20 left"]),
    ],
)  # fmt: skip
def test_time_left_in_a_log(capsys, monkeypatch, times, updates, told):
    for verbosity in (0, -1):
        monkeypatch.setattr(module.time, "monotonic", map(float, times).__next__)
        with Output(verbosity=verbosity).progress("build") as update:
            for done, total in updates:
                update(done, total)
        shown = capsys.readouterr().err.splitlines()
        assert shown == [f"build: {line}" for line in told if verbosity == 0]


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
    assert list(list_assets(store, ("failed",))) == []


def test_why_is_what_the_record_says(deformed_build):
    store = open_store(deformed_build.store)
    records = StoredRecords(store)
    for one in list_assets(store):
        assert one.reasons == records.of(one.asset_id).judgement.reasons
        assert (one.verdict == "good") is (one.reasons == ())


def test_ids_on_a_terminal_are_as_long_as_tells_them_apart(monkeypatch):
    ids = ["0123456789ab", "0123456789cd", "0123zzzzzzzz"]
    assert module.Output().id_length(ids) is None
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert module.Output().id_length(ids) == 11
    assert module.Output().id_length(["a", "b"]) == 8
    assert module.Output().id_length(["0123456789", "0123456789"]) == 8, "of a damaged store"


Few = Annotated[int, click.IntRange(1, 3)]


@dataclass(frozen=True, kw_only=True)
class Inner:
    """A group within a group."""

    deep: Annotated[float, "How deep."] = 0.5


@dataclass(frozen=True, kw_only=True)
class Grouped:
    """Options that several commands share.

    Attributes
    ----------
    wide : METRES
        How wide.
        [default: as wide as it is]
    """

    inner: Inner
    wide: str | None = None


@command("probe")
def probe(
    output: Output,
    source: Annotated[Path, click.Path(path_type=Path)],
    targets: tuple[str, ...] = (),
    *,
    few: Annotated[Few | None, "How many."] = None,
    kind: Literal["a", "b"] = "a",
    names: Annotated[tuple[str, ...], Click("--name")] = (),
    loud: Annotated[bool, "Aloud."] = False,
    grouped: Grouped,
    wanted: Annotated[int, "Needed."],
) -> None:
    """Print what the function gets.

    Parameters
    ----------
    kind
        Which.
    names : NAME
        Called; may be repeated.

    Example
    -------
    slatprep probe x
    """
    output.result({"got": [source, targets, few, kind, names, loud, grouped, wanted]}, lambda: None)


def got(*words: str) -> Any:
    done = CliRunner().invoke(probe, [*words, "--json"], prog_name="slatprep")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)["got"]


def test_function_gets_defaults_and_what_is_given():
    group = {"inner": {"deep": 0.5}, "wide": None}
    assert got("x", "--wanted", "4") == ["x", [], None, "a", [], False, group, 4]
    words = "x y z --few 2 --kind b --name m --name n --loud --deep 2 --wide w --wanted 4"
    group = {"inner": {"deep": 2.0}, "wide": "w"}
    assert got(*words.split()) == ["x", ["y", "z"], 2, "b", ["m", "n"], True, group, 4]


def test_help_has_texts_defaults_and_sections():
    text = CliRunner().invoke(probe, ["--help"], terminal_width=90).output
    for words in ("[TARGETS]...", "Which.", "Called; may", "[required]", "Print what the function",
                  "--name NAME", "--wide METRES", "How many."):  # fmt: skip
        assert words in text
    assert "How wide.  [default: as wide as it is]" in text
    assert "Example:\n    slatprep probe x" in text
    assert "Parameters" not in text and "Attributes" not in text


def test_an_option_without_help_and_help_without_an_option_are_mistakes_of_ours() -> None:
    def silent(output: Output, *, few: Few = 1) -> None:
        """Do nothing."""

    def changed(output: Output, *, few: Annotated[Few, "How many."] = 1) -> None:
        """Do nothing.

        Parameters
        ----------
        many
            What was here before.
        """

    for function, said in ((silent, "few: an option without help"), (changed, "many: help for")):
        with pytest.raises(TypeError, match=said):
            command()(function)

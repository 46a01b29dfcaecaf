"""What commands print, and where."""

import io
import json
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from slatprep.cli import output as module
from slatprep.cli.output import Output, as_json
from slatprep.records import PropertyRange, Verdict


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


ROWS = [("spot", 3, 0.98765, None), ("bunny [bold]", 12345, float("nan"), True)]


def test_plain_table_is_aligned_and_has_no_ornament(capsys: pytest.CaptureFixture[str]) -> None:
    Output().table("Assets", ("name", "voxels", "fitness", "right"), ROWS)
    assert capsys.readouterr().out.splitlines() == [
        "Assets",
        "name          voxels  fitness  right",
        "spot               3    0.988  -",
        "bunny [bold]  12,345        -  yes",
        "",
    ]


def test_table_on_a_terminal_is_drawn_and_keeps_square_brackets(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(sys, "stdout", Terminal())
    Output().table("Assets", ("name", "voxels", "fitness", "right"), ROWS)
    text = sys.stdout.getvalue()  # type: ignore[attr-defined]
    assert "bunny [bold]" in text
    assert "─" in text and "\x1b[" in text


def test_narrow_terminal_cuts_no_id_and_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "30")
    monkeypatch.setattr(sys, "stdout", Terminal())
    asset_id = "0123456789abcdef0123456789abcdef"
    Output().table("Assets", ("asset", "voxels"), [(asset_id, 12345)])
    text = sys.stdout.getvalue()  # type: ignore[attr-defined]
    assert asset_id in text and "12,345" in text


@pytest.mark.parametrize("no_color", [False, True])
def test_verdicts_are_coloured_unless_no_color_says_otherwise(
    monkeypatch: pytest.MonkeyPatch, no_color: bool
) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    if no_color:
        monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setattr(sys, "stdout", Terminal())
    Output().table("Assets", ("name", "verdict"), [("spot", "good")])
    text = sys.stdout.getvalue()  # type: ignore[attr-defined]
    green = "\x1b[32m"
    assert "good" in text
    assert (green in text) is not no_color


def test_json_is_the_only_thing_on_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
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


def test_verbosity(capsys: pytest.CaptureFixture[str]) -> None:
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


def test_json_holds_all_that_results_do(tmp_path: Path) -> None:
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


def test_time_left_in_a_log_comes_from_all_assets_done(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_no_time_is_told_from_one_asset_or_from_what_came_before_the_first(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 3600.0, 3640.0, 3680.0])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    with Output().progress("train", "steps") as update:
        update(0, 100)
        update(1, 100)
        update(2, 100)
    assert capsys.readouterr().err.splitlines() == ["train: 2 of 100 steps, 1:05:20 left"]


def test_quiet_shows_no_progress(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module.time, "monotonic", iter(range(0, 1000, 100)).__next__)
    with Output(verbosity=-1).progress("build") as update:
        update(1, 2)
    assert capsys.readouterr().err == ""


def test_bar_on_a_terminal_counts_assets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(sys, "stderr", Terminal())
    with Output().progress("build") as update:
        update(3, 8)
    shown = sys.stderr.getvalue()  # type: ignore[attr-defined]
    assert "3/8 · 0:00 · 0:00 left" in shown


@pytest.mark.parametrize("done", [None, 0, 1])
def test_bar_tells_no_time_left_before_it_can(
    monkeypatch: pytest.MonkeyPatch, done: int | None
) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(sys, "stderr", Terminal())
    with Output().progress("build") as update:
        if done is not None:
            update(done, 8)
    shown = sys.stderr.getvalue()  # type: ignore[attr-defined]
    assert "left" not in shown
    assert ("starting" if done is None else f"{done}/8") in shown


def test_commands_print_through_one_function() -> None:
    """Which escapes what a terminal would obey."""
    folder = Path(str(module.__file__)).parent
    printing = [p.name for p in folder.glob("*.py") if "click.echo(" in p.read_text("utf-8")]
    assert printing == ["streams.py"]
    assert (folder / "streams.py").read_text("utf-8").count("click.echo(") == 1
    emitting = [p.name for p in folder.glob("*.py") if " emit(" in p.read_text("utf-8")]
    assert sorted(emitting) == ["output.py", "streams.py"]
    # `say`, and a table that rich has drawn of escaped cells.
    assert Path(str(module.__file__)).read_text("utf-8").count(" emit(") == 2

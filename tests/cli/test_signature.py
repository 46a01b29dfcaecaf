"""Commands made of signatures: what a user may type, and what the function gets."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import click
import pytest
from click.testing import CliRunner

from slatprep.cli.output import Output
from slatprep.cli.signature import Click, command

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

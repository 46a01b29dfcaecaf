"""Whatever a stranger's store, records or truth hold, no command ends in a traceback."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from support.commands import document, refused, run
from support.made_store import edit_json, rewrite
from support.predictions import write_predictions


@pytest.fixture
def store(copy: Path) -> Path:
    return copy


def every_command(store: Path) -> dict[str, Result]:
    out = store.parent / "out"
    lines = {
        "info": ("info", store),
        "verify": ("verify", store),
        "report": ("report", store, "--out", f"{out}.html"),
        "describe": ("describe", store, "--out", f"{out}.json"),
        "check": ("check-alignment", "--asset", "cup", "--store", store, "--picture", "none"),
        **{
            name: ("export", store, "--format", name, "--out", f"{out}-{name}")
            for name in ("ply", "npz", "hdf5")
        },
    }
    return {name: run(*line, code=None) for name, line in lines.items()}


def _set(*path: str, value: object) -> Callable[[dict[str, Any]], object]:
    def change(document: dict[str, Any]) -> None:
        for key in path[:-1]:
            document = document[key]
        document[path[-1]] = value

    return change


SAMPLE = ("build", "parameters", "sample")
ATTRIBUTES: dict[str, Callable[[dict[str, Any]], object]] = {
    "no build": lambda a: a.pop("build"),
    "build a list": _set("build", value=[1]),
    "no parameters": _set("build", "parameters", value={}),
    "no radius": _set("build", "parameters", "align", value={}),
    "versions a number": _set("build", "versions", value=5),
    "name a list": _set("build", "name", value=[1]),
    "no ranges": lambda a: a.pop("normalization"),
    "text for a bound": _set("normalization", "density", "lo", value="x"),
    "endless bound": _set("normalization", "density", "hi", value=1e999),
    "bounds exchanged": _set("normalization", "density", "lo", value=99),
    "no columns": lambda a: a.pop("property_columns"),
    "few columns": _set("property_columns", value=["density"]),
    "columns a number": _set("property_columns", value=5),
    "classes a number": _set("material_classes", value=[1] * 8),
    "a lone surrogate": _set("build", "name", value="\ud800"),
    "width 0": _set(*SAMPLE, "vote_width", value=0),
    "width tiny": _set(*SAMPLE, "vote_width", value=1e-300),
    "width huge": _set(*SAMPLE, "vote_width", value=1e300),
    "width text": _set(*SAMPLE, "vote_width", value="x"),
    "distance huge": _set(*SAMPLE, "max_distance", value=1e300),
    "method other": _set(*SAMPLE, "method", value="other"),
    "manifest a number": _set("manifest", value=5),
    "resolution 1": _set("resolution", value=1),
    "version true": _set("format_version", value=True),
}


@pytest.mark.parametrize("case", ATTRIBUTES)
def test_attributes(store, case):
    edit_json(store / "zarr.json", lambda document: ATTRIBUTES[case](document["attributes"]))
    for name, done in every_command(store).items():
        assert done.exit_code == 1, name
        assert "slatprep: error" in done.stderr or name == "verify"
    told = run("verify", store, "-q", code=1).stdout
    assert "zarr.json: " in told and "0 findings" not in told


def test_attributes_that_are_not_known_hinder_nobody(store):
    def change(document: dict[str, Any]) -> None:
        attributes = document["attributes"]
        attributes["mine"] = {"x": [1, None, "y"]}
        attributes["build"]["parameters"]["sample"]["of_tomorrow"] = 5
        attributes["build"]["parameters"]["align"]["engine"] = "of tomorrow"

    edit_json(store / "zarr.json", change)
    for name, done in every_command(store).items():
        assert done.exit_code == (name == "verify"), done.output


RECORDS: dict[str, tuple[str, bytes | Path | Callable[[dict[str, Any]], object]]] = {
    "a list": ("build.json", b"[1]"),
    "nested": ("build.json", b"[" * 100_000),
    "nested object": ("build.json", b'{"a":' * 100_000),
    "text": ("build.json", b"\xff\xfe"),
    "counts a list": ("build.json", _set("counts", value=[1])),
    "huge": ("build.json", b" " * (2**24 + 1)),
    "endless": ("build.json", _set("duration_s", value=1e999)),
    "lines of lists": ("assets.jsonl", b"[1]\n5\nnull\n"),
    "nested line": ("assets.jsonl", b"[" * 100_000),
    "long line": ("assets.jsonl", b"x" * 2**23),
    "no text": ("assets.jsonl", b"\xff\xfe\n"),
    "a device": ("build.json", Path("/dev/zero")),
    "a device of lines": ("assets.jsonl", Path("/dev/zero")),
    "many faults": ("assets.jsonl", b'{"status":"ok",' + b'"x":0,' * 100 + b'"y":0}\n'),
}


READERS = {"build.json": ("report", "verify"), "assets.jsonl": ("verify",)}
"""Commands that read the files beside a store; the report takes records from the store itself."""


@pytest.mark.parametrize("case", RECORDS)
def test_records_beside_a_store(store, case):
    name, content = RECORDS[case]
    file = store.with_suffix(".manifests") / name
    if isinstance(content, Path):
        file.unlink()
        file.symlink_to(content)
    elif callable(content):
        edit_json(file, content)
    else:
        file.write_bytes(content)
    for command in READERS[name]:
        out = ("--out", store.with_suffix(".html")) if command == "report" else ()
        told = run(command, store, *out, code=1).output
        assert name in told and (not isinstance(content, Path) or "no regular file" in told)


def test_escape_sequences_do_not_reach_the_terminal(store):
    for row, text in enumerate(("\x1b]0;title\x07", "\x1b[2J", "\x9b31m\u202e", "a\r\nb")):
        rewrite(store, "asset/category", row, text)
    rewrite(store, "asset/verdict", 0, "\x1b[2J")
    for line in (["info"], ["list"], ["verify"], ["report"], ["info", "--json"]):
        done = run(line[0], store, *line[1:], code=None)
        assert not set("\x1b\x07\x9b\r\u202e") & set(done.output), line
    categories = document("info", store)["categories"]
    assert {"\x1b[2J", "\x9b31m\u202e"} <= {group["name"] for group in categories}


@pytest.mark.parametrize("name", ["verdict", "model", "engine"])
def test_a_report_of_unknown_words_is_refused(store, name):
    rewrite(store, f"asset/{name}", 0, "other")
    told = refused("report", store, "--out", store.with_suffix(".html"), code=1)
    assert "'other' is none of" in told


def test_a_category_with_the_space_of_all_costs_no_memory(store):
    """One text of megabytes among few rows is refused by the reader."""
    rewrite(store, "asset/category", 0, "x" * 2**20)
    assert "expected at most" in refused("info", store, code=1)


def test_a_table_of_scores_has_no_formulas(store, tmp_path):
    predictions = write_predictions(tmp_path / "p", store)
    for row, category in enumerate(("=cmd|x", "+1", "-1", "@a\x1b[2J", " =b")):
        rewrite(store, "asset/category", row, category)
    table = tmp_path / "scores.csv"
    words = ("--store", store, "--split", "all", "--csv", table)
    run("evaluate", predictions, *words, code=None)
    with table.open(encoding="utf-8", newline="") as file:
        first = {row[0] for row in csv.reader(file)}
    # The bear's two views are one object, of the first one's category.
    assert first >= {"'=cmd|x", "'+1", "'@a\\u001b[2J", "' =b"}

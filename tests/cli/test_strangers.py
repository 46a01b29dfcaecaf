"""Whatever a stranger's store, records or truth hold, no command ends in a traceback."""

import csv
import json
from pathlib import Path

import pytest
from click.testing import Result
from support.commands import document, refused, run
from support.made_store import GONE, placed, rewrite
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


SAMPLE = "build/parameters/sample"
ATTRIBUTES: dict[str, tuple[str, object]] = {
    "no build": ("build", GONE),
    "build a list": ("build", [1]),
    "no parameters": ("build/parameters", {}),
    "no radius": ("build/parameters/align", {}),
    "versions a number": ("build/versions", 5),
    "name a list": ("build/name", [1]),
    "no ranges": ("normalization", GONE),
    "text for a bound": ("normalization/density/lo", "x"),
    "endless bound": ("normalization/density/hi", 1e999),
    "bounds exchanged": ("normalization/density/lo", 99),
    "no columns": ("property_columns", GONE),
    "few columns": ("property_columns", ["density"]),
    "columns a number": ("property_columns", 5),
    "classes a number": ("material_classes", [1] * 8),
    "a lone surrogate": ("build/name", "\ud800"),
    "width 0": (f"{SAMPLE}/vote_width", 0),
    "width tiny": (f"{SAMPLE}/vote_width", 1e-300),
    "width huge": (f"{SAMPLE}/vote_width", 1e300),
    "width text": (f"{SAMPLE}/vote_width", "x"),
    "distance huge": (f"{SAMPLE}/max_distance", 1e300),
    "method other": (f"{SAMPLE}/method", "other"),
    "manifest a number": ("manifest", 5),
    "resolution 1": ("resolution", 1),
    "version true": ("format_version", True),
}


def put(file: Path, place: str, value: object) -> None:
    """Replace a value of a JSON file."""
    file.write_text(json.dumps(placed(json.loads(file.read_text()), place, value)))


@pytest.mark.parametrize("case", ATTRIBUTES)
def test_attributes(store, case):
    place, value = ATTRIBUTES[case]
    put(store / "zarr.json", f"attributes/{place}", value)
    every = every_command(store)
    for name, done in every.items():
        assert done.exit_code == 1, name
        assert "slatprep: error" in done.stderr or name == "verify"
    assert "zarr.json: " in every["verify"].stdout


def test_attributes_that_are_not_known_hinder_nobody(store):
    for place, value in (
        ("mine", {"x": [1, None, "y"]}), (f"{SAMPLE}/of_tomorrow", 5),
        ("build/parameters/align/engine", "of tomorrow"),
    ):  # fmt: skip
        put(store / "zarr.json", f"attributes/{place}", value)
    for name, done in every_command(store).items():
        assert done.exit_code == (name == "verify"), done.output


RECORDS: dict[str, tuple[str, bytes | Path | tuple[str, object]]] = {
    "a list": ("build.json", b"[1]"),
    "nested": ("build.json", b"[" * 100_000),
    "nested object": ("build.json", b'{"a":' * 100_000),
    "text": ("build.json", b"\xff\xfe"),
    "counts a list": ("build.json", ("counts", [1])),
    "huge": ("build.json", b" " * (2**24 + 1)),
    "endless": ("build.json", ("duration_s", 1e999)),
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
    elif isinstance(content, tuple):
        put(file, *content)
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
    run("evaluate", predictions, "--store", store, "--split", "all", "--csv", table, code=None)
    with table.open(encoding="utf-8", newline="") as file:
        first = {row[0] for row in csv.reader(file)}
    # The bear's two views are one object, of the first one's category.
    assert first >= {"'=cmd|x", "'+1", "'@a\\u001b[2J", "' =b"}

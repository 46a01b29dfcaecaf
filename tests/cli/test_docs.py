"""What the documentation says is so."""

import dataclasses
import json
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import get_type_hints

import pytest
from support.commands import parse_command

from slatprep.cli.export import export
from slatprep.export import FORMATS
from slatprep.parameters import BuildParameters
from slatprep.parameters.files import load_parameters
from slatprep.store.layout import ARRAYS, MERGED

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("manifests/*.md")])


def code_lines(language: str) -> list[tuple[str, str]]:
    """Return every line of the code blocks of a language, with the page's name."""
    return [
        (page.name, line.partition("#")[0].strip())
        for page in PAGES
        for block in re.findall(rf"```{language}\n(.*?)```", page.read_text("utf-8"), re.S)
        for line in block.splitlines()
    ]


COMMANDS_SHOWN = [(page, line) for page, line in code_lines("sh") if line.startswith("slatprep ")]
TARGETS_SHOWN = [(page, line) for page, line in code_lines("sh") if line.startswith("make ")]


@pytest.mark.parametrize(("page", "line"), COMMANDS_SHOWN)
def test_command_shown_parses(page, line):
    parse_command(line)


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_targets_shown_exist():
    words = sorted({word for _, line in TARGETS_SHOWN for word in line.split()[1:]})
    done = subprocess.run(["make", "--dry-run", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_files_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text("utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_configuration_lists_every_key_with_its_default():
    text = (ROOT / "docs" / "configuration.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (.+?) \| ", text, re.M)
    documented = iter(rows)
    hints = get_type_hints(BuildParameters)
    assert next(documented) == ("name", '`""`')
    for group in dataclasses.fields(BuildParameters):
        if group.name == "name":
            continue
        if group.name == "also":
            assert "## [[also]]" in text  # with the keys of [pixieverse]
            continue
        for field in dataclasses.fields(hints[group.name]):
            assert next(documented) == (field.name, default_of(field)), group.name
    assert list(documented) == []


def default_of(field: dataclasses.Field[object]) -> str:
    if field.default_factory is not dataclasses.MISSING:
        keys = dataclasses.asdict(field.default_factory())
        return f"`{json.dumps({name: value for name, value in keys.items() if value})}`"
    if field.default is dataclasses.MISSING:
        return "required"
    return "none" if field.default is None else f"`{json.dumps(field.default)}`"


def test_each_format_of_export_is_told_of_in_help_and_page():
    page = (ROOT / "docs" / "export.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)` \| a f(?:ile|older)", page, re.M)
    commands = re.findall(r"^slatprep export .*--format (\w+)", page, re.M)
    assert set(rows) == set(commands) == FORMATS.keys()
    (kind,) = (one for one in export.params if one.name == "kind")
    assert set(re.findall(r"(\w+): ", getattr(kind, "help", ""))) == FORMATS.keys()


def test_formats_describes_every_array():
    text = (ROOT / "docs" / "formats.md").read_text("utf-8")
    rows = re.findall(r"^\| `((?:asset|voxel|grid)/\w+)` \| \(([^)]*)\) \| (\w+) \|", text, re.M)
    documented = {name: (len(re.findall(r"\w+", shape)), dtype) for name, shape, dtype in rows}
    expected = {array.name: (len(array.dimensions), array.dtype) for array in (*ARRAYS, *MERGED)}
    # (A+1,) counts as two words; it is one dimension.
    documented["asset/offset"] = (1, documented["asset/offset"][1])
    assert documented == expected


@pytest.mark.parametrize("name", ["demo.toml", "mine.example.toml"])
def test_example_definitions_are_valid(name, tmp_path):
    text = (ROOT / "manifests" / name).read_text("utf-8")
    # Every example key that is commented out counts as well.
    full = re.sub(r"^# (?=\[|\w+ = )", "", text, flags=re.M)
    for variant in (text, full):
        data = tomllib.loads(variant)
        for group, key in (("pixieverse", "root"), ("slat", "root"), ("pairing", "map"),
                           ("pairing", "categories")):  # fmt: skip
            if key in data.get(group, {}):
                (tmp_path / f"{group}.{key}").touch()
                variant = variant.replace(data[group][key], str(tmp_path / f"{group}.{key}"))
        path = tmp_path / name
        path.write_text(variant, encoding="utf-8")
        assert load_parameters(path).name == name.split(".")[0]

"""What docs/design/architecture.md and its picture say of the code is so."""

import importlib
import importlib.util
import re
import runpy
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "design" / "architecture.md").read_text("utf-8")
TOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]
LAYERS = [
    {room.strip() for room in layer.split("|")}
    for layer in TOOLS["importlinter"]["contracts"][0]["layers"]
]
NAMES = sorted(set(re.findall(r"`(slatprep(?:\.\w+)+)`", PAGE)))
PATHS = sorted(set(re.findall(r"`((?:slatprep|tests|docs)/[\w/.]*|[\w.]+\.(?:toml|yml))`", PAGE)))


def test_every_name_and_path_exists():
    assert len(NAMES) > 30 and len(PATHS) > 20
    for name in NAMES:
        parts = name.split(".")
        found = importlib.import_module(parts[0])
        for index, part in enumerate(parts[1:], 2):
            if not hasattr(found, part):
                importlib.import_module(".".join(parts[:index]))
            found = getattr(found, part)
    assert not [path for path in PATHS if not (ROOT / path).exists()]


def test_every_room_has_its_line():
    section = PAGE.split("## The rooms")[1].split("\n## ")[0]
    assert set(re.findall(r"`slatprep/(\w+)(?:/|\.py)`", section)) == set().union(*LAYERS)


def test_the_picture_has_the_floors_that_are_checked():
    svg = "{http://www.w3.org/2000/svg}"
    picture = ET.parse(ROOT / "docs" / "images" / "house.svg")
    floors = [
        {room.text for room in floor.iter(f"{svg}tspan") if room.get("class") == "room"}
        for floor in picture.iter(f"{svg}g")
        if floor.get("class") == "floor"
    ]
    assert floors == LAYERS


def test_the_index_lists_every_page():
    index = (ROOT / "docs" / "index.md").read_text("utf-8")
    docs = ROOT / "docs"
    pages = {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")} - {"index.md"}
    assert pages <= set(re.findall(r"\]\(([\w./]+)\)", index))


def test_what_changes_code_for_the_tests_names_what_there_is():
    runner = runpy.run_path(str(ROOT / "tools" / "mutants.py"))
    for module, tests in runner["TESTS"].items():
        assert (ROOT / "slatprep" / f"{module}.py").exists(), module
        assert all((ROOT / "tests" / test).exists() for test in tests), tests
    assert all(importlib.util.find_spec(library) for library in runner["LIBRARIES"])

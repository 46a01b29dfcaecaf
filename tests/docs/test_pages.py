"""What the documentation says and shows is so."""

import ast
import dataclasses
import importlib
import importlib.util
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import get_type_hints

import nbformat
import numpy as np
import pytest
from click.testing import CliRunner
from nbclient import NotebookClient
from scipy.spatial import cKDTree
from support.commands import parse_command
from support.installed import package
from support.synthetic import Dataset, make_asset

from slatprep import build_store, load_parameters, open_store
from slatprep.cli import build
from slatprep.cli.commands import COMMANDS, slatprep
from slatprep.cli.export import export
from slatprep.export import FORMATS, ExportOptions
from slatprep.parameters import (
    BuildParameters,
    NormalizeParameters,
    PixieverseSource,
    SlatSource,
)
from slatprep.readers import adapters
from slatprep.readers.splits import Shares
from slatprep.readers.voxels import _parsed
from slatprep.store.layout import ARRAYS, MERGED
from slatprep.store.records import StoredRecords

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def blocks(page: str) -> list[tuple[str, str]]:
    """Return the language and text of every code block of a page, in order."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", (DOCS / page).read_text("utf-8"), re.S | re.M)


def test_the_page_on_security_says_what_each_command_does_with_files():
    text = (ROOT / "SECURITY.md").read_text("utf-8")
    _, _, table = text.partition("| command | reads | writes |")
    rows = [row.split("|")[1] for row in table.partition("\n\n")[0].splitlines()[2:]]
    assert set(re.findall(r"`([a-z-]+)`", " ".join(rows))) == COMMANDS.keys()


def test_the_notebook_is_the_tutorial_with_its_outputs(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    notebook = importlib.import_module("notebook")
    written = json.loads((ROOT / "examples" / "tutorial.ipynb").read_text("utf-8"))
    made = json.loads(notebook.notebook((DOCS / "tutorial.md").read_text("utf-8")))
    sources = [[cell["source"] for cell in one["cells"]] for one in (written, made)]
    assert sources[0] == sources[1], "run: python tools/notebook.py"
    cells = iter(cell for cell in written["cells"] if cell["cell_type"] == "code")
    printed, pictures = "", 0
    for language, text in blocks("tutorial.md"):
        if language == "text":
            assert printed == text, "run: python tools/notebook.py"
            continue
        cell = next(cells)
        expected = f"%%sh\n{text}" if language == "sh" else text
        assert "".join(cell["source"]) == expected.strip("\n")
        printed = "".join("".join(out.get("text", "")) for out in cell["outputs"])
        pictures += sum("image/png" in out.get("data", {}) for out in cell["outputs"])
    assert pictures == 1
    assert (ROOT / "examples" / "tutorial.ipynb").stat().st_size < 300_000


def test_the_notebook_runs_in_jupyter_and_prints_what_the_tutorial_shows(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    for folder in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR"):
        monkeypatch.setenv(folder, str(tmp_path / "jupyter"))
    notebook = nbformat.read(ROOT / "examples" / "tutorial.ipynb", as_version=4)
    place = {"metadata": {"path": str(tmp_path)}}
    # Raises where a cell does, of Python or of the shell.
    # By itself it gives a kernel a minute to start, and then passes over output that takes 4 s.
    patient = {"timeout": None, "startup_timeout": 600, "iopub_timeout": 600}
    NotebookClient(notebook, resources=place, **patient).execute()
    cells = iter(cell for cell in notebook.cells if cell.cell_type == "code")
    printed, compared = "", 0
    for language, text in blocks("tutorial.md"):
        if language == "text":
            assert printed == text
            compared += 1
        else:
            outputs = next(cells).outputs
            printed = "".join(out.text for out in outputs if out.get("name") == "stdout")
    assert compared >= 10
    assert (tmp_path / "shards" / "shard-000001.tar").exists()


def test_a_long_equation_scrolls_by_itself() -> None:
    spec = importlib.util.spec_from_file_location("pages_of_site", ROOT / "tools" / "site.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    kinds = r'<div class="arithmatex">\[E = mc^2\]</div>', r'<span class="arithmatex">\(m\)</span>'
    block, inline = map(hooks.on_page_content, kinds)
    assert block.startswith('<div style="overflow-x: auto"><math') and 'display="block"' in block
    assert inline.startswith("<math")


def templates() -> str:
    """Return every text of the source, each between zeros, with … for what is filled in."""
    found = []
    for path in (ROOT / "slatprep").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = (
                    part.value if isinstance(part, ast.Constant) else "…" for part in node.values
                )
                found.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return "\0".join(found)


def test_messages_of_troubleshooting_are_those_of_the_source():
    said = templates()
    messages = [
        message
        for section in (DOCS / "troubleshooting.md").read_text("utf-8").split("\n## ")
        if not section.startswith("Results")
        for message in re.findall(r"^\| `([^`]+)` \|", section, re.M)
    ]
    assert len(messages) >= 30
    assert len(set(messages)) == len(messages)
    for message in messages:
        pattern = "[^\0]*".join(map(re.escape, message.strip("…").split("…")))
        assert re.search(pattern, said), message


def complete(words: str) -> str:
    """Return what the entry answers to a shell that asks."""
    last = str(len(words.split()) - 1)
    asked = {"_SLATPREP_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": last}
    result = CliRunner().invoke(slatprep, env=asked, prog_name="slatprep")
    assert result.exit_code == 0, result.output
    return result.stdout


def test_completion_is_documented_for_every_shell_click_knows():
    text = (DOCS / "shell.md").read_text("utf-8")
    for shell in ("bash", "zsh", "fish"):
        assert f"_SLATPREP_COMPLETE={shell}_source slatprep" in text


def test_commands_options_and_values_complete():
    entry = [sys.executable, "-m", "slatprep"]
    asked = {"_SLATPREP_COMPLETE": "bash_complete", "COMP_WORDS": "slatprep exp", "COMP_CWORD": "1"}
    done = subprocess.run(entry, capture_output=True, text=True, env=os.environ | asked)
    assert "Traceback" not in done.stderr, done.stderr
    assert done.stdout.splitlines() == ["plain,export"]
    assert complete("slatprep export x --format w").splitlines() == ["plain,webdataset"]
    assert "plain,--verdict" in complete("slatprep export x --verd").splitlines()


def test_asset_ids_complete_from_the_store(mixed_build, monkeypatch):
    monkeypatch.chdir(mixed_build.store.parent)
    offered = complete("slatprep export mixed.zarr --asset bear")
    assert offered.splitlines() == ["plain,bear.front", "plain,bear.side"]
    later = "slatprep export mixed.zarr --format npz --asset cup --asset d"
    assert complete(later).splitlines() == ["plain,dog"]
    assert complete("slatprep export no.zarr --asset b").strip() == ""


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
    documented = iter(re.findall(r"^\| `(\w+)` \| (.+?) \| ", text, re.M))
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


def test_two_folders_are_read_by_the_definition_that_is_shown(tmp_path):
    for number, name in enumerate(("first", "second")):
        dataset = Dataset(tmp_path / name).having(f"{name}-cup", seed=number)
        mask = dataset.assets[f"{name}-cup"].grid[..., 3] != 7
        np.save(tmp_path / name / f"pixieverse/{name}-cup/clip_features_mask.npy", mask)
    _, folders, ranges = (text for kind, text in blocks("configuration.md") if kind == "toml")
    (tmp_path / "ranges.toml").write_text(ranges)
    config = tmp_path / "dataset.toml"
    more = f'\n[normalize]\nranges = "{tmp_path / "ranges.toml"}"\n'
    config.write_text(folders.replace("/data", str(tmp_path)) + more)
    store = tmp_path / "s.zarr"
    assert build_store(load_parameters(config), store).problems == ()
    opened = open_store(store)
    assert opened.ids == ["first-cup", "second-cup"]
    assert [(one.lo, one.hi) for one in opened.normalization.ranges] == [(3, 12), (1, 4), (0, 0.5)]
    assert "mask" in {source.role for source in StoredRecords(opened).of("second-cup").sources}


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
    helps = {one.name: getattr(one, "help", "") for one in export.params}
    assert set(rows) == FORMATS.keys(), "a row of docs/export.md begins with '| `name` | a file'"
    assert set(commands) == FORMATS.keys(), "docs/export.md has an example of each"
    assert set(re.findall(r"(\w+): ", helps["kind"])) == FORMATS.keys(), "help of --format"
    for field in dataclasses.fields(ExportOptions):
        own = [name for name, one in FORMATS.items() if field.name in one.options]
        assert helps[field.name].partition(":")[0] == ", ".join(own)


@pytest.mark.parametrize(("command", "name", "default"), [
    (export, "frame", ExportOptions.frame),
    (export, "shard_size", ExportOptions.shard_size),
    (export, "materials", ExportOptions.materials),
    (export, "size", f"{ExportOptions.size:g}"),
    (build.build_store, "samples", PixieverseSource.samples),
    (build.build_store, "encoder", SlatSource.encoder),
    (build.build_store, "ranges", NormalizeParameters.ranges),
    (build.build_store, "ranges_of", NormalizeParameters.objects),
    (build.build_store, "split_by", NormalizeParameters.split_by),
    (build.build_store, "shares", ",".join(map(str, dataclasses.astuple(Shares())))),
])  # fmt: skip
def test_a_default_that_help_states_is_that_of_the_parameters(command, name, default):
    (option,) = (one for one in command.params if one.name == name)
    assert f"[default: {default}]" in option.help


@pytest.mark.parametrize("name", ["decoys", "rehash"])
def test_a_default_of_the_command_is_that_of_the_function(name):
    (option,) = (one for one in build.build_store.params if one.name == name)
    assert option.default == inspect.signature(build_store).parameters[name].default


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


# -- the page about other sources: its adapter is run as an installed package ----


def of_adapters(language: str) -> list[str]:
    return [text for kind, text in blocks("adapters.md") if kind == language]


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install the page's adapter: a module, and what a package's metadata say."""
    name, value = re.findall(r'^(\w+) = "(mine:\w+)"$', "\n".join(of_adapters("toml")), re.M)[0]
    modules, points = {"mine": of_adapters("python")[0]}, f"[slatprep.sources]\n{name} = {value}\n"
    with package(tmp_path / "site", "mine", modules, points, monkeypatch):
        yield


@pytest.mark.usefixtures("installed")
def test_the_adapter_of_the_page_builds_a_store(tmp_path):
    assert len(of_adapters("python")[0].splitlines()) <= 45
    (tmp_path / "points").mkdir()
    (tmp_path / "slat").mkdir()
    asset = make_asset(1)
    voxels = np.argwhere(asset.grid[..., 3] != 7)
    points = (voxels + 0.5) / 64 - 0.5
    conductivity = 10.0 ** (voxels[:, 0] / 16)
    rows = np.column_stack([points, np.full(len(voxels), 800.0), conductivity])
    header = "x,y,z,density,conductivity"
    np.savetxt(tmp_path / "points" / "a.csv", rows, "%.9g", ",", header=header, comments="")
    (tmp_path / "points" / "b.csv").write_text(f"{header}\n1,2\n")
    for name in "ab":
        np.savez(tmp_path / "slat" / f"{name}.npz", coords=asset.coords, feats=asset.feats)
    config = tmp_path / "dataset.toml"
    config.write_text(
        '[pixieverse]\nroot = "points"\nadapter = "points"\n[slat]\nroot = "slat"\n'
        '[sample]\nmethod = "nearest"\n'
    )
    summary = build_store(load_parameters(config), tmp_path / "s.zarr")
    assert summary.statuses == {"ok": 1, "failed": 1, "skipped": 0}
    assert "x,y,z,density,conductivity" in summary.problems[0][1]
    (stored,) = open_store(tmp_path / "s.zarr")
    assert stored.store.attributes["property_units"] == ["kg/m^3", "W/(m K)"]
    places = np.asarray(stored.place, np.float64) * 64 + 31.5
    _, used = cKDTree(voxels).query(places)
    np.testing.assert_allclose(stored.properties_si[:, 1], conductivity[used], rtol=1e-5)


def test_the_dataset_definition_and_the_description_of_the_page_are_valid(tmp_path):
    for folder in ("gvm", "latents"):
        (tmp_path / folder).mkdir()
    (tmp_path / "dataset.toml").write_text(of_adapters("toml")[0])
    assert load_parameters(tmp_path / "dataset.toml").pixieverse.adapter == "vomp"
    (text,) = of_adapters("json")
    said = _parsed(text.encode(), "page")
    assert [one.name for one in said.table] == [p["name"] for p in json.loads(text)["properties"]]


def test_the_page_names_every_source_adapter():
    page = (DOCS / "adapters.md").read_text("utf-8")
    assert not [name for name in adapters.SOURCES if f"| `{name}` |" not in page]

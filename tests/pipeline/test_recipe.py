"""What decides an asset's key, its code among it, and what is said when it has another one."""

import ast
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import pytest
from support.commands import python

from slatprep.judge.calibration import NUMBERS
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.pipeline import fingerprint
from slatprep.pipeline.dataset import BuildSummary
from slatprep.pipeline.fingerprint import code_fingerprint, numeric_modules
from slatprep.pipeline.recipe import Recipe
from slatprep.readers import reading_of
from slatprep.readers.adapters import SOURCES
from slatprep.records import SourceRoots
from slatprep.store.record import AssetRecord, StageParameters
from slatprep.store.record_json import read_record

STAGES = StageParameters(AlignParameters(), SampleParameters())
RECIPE = Recipe(STAGES, {"numpy": "2.0", "scipy": "1.11"}, "c0de")
DIGESTS = {"grid": "0" * 64, "slat": "1" * 64}


@pytest.fixture(scope="module")
def record(mixed_build: BuildSummary) -> AssetRecord:
    first, *_ = Path(str(mixed_build.records)).read_text("utf-8").splitlines()
    return read_record(AssetRecord, first, "its first line")


def test_all_that_touches_the_numbers_is_in_the_key_and_no_order():
    nearer = replace(STAGES, sample=SampleParameters(max_distance=1.0))
    others = (
        RECIPE.key("b", DIGESTS),
        RECIPE.key("a", {**DIGESTS, "slat": "2" * 64}),
        RECIPE.key("a", {"grid": DIGESTS["slat"], "slat": DIGESTS["grid"]}),
        replace(RECIPE, versions={"numpy": "2.1", "scipy": "1.11"}).key("a", DIGESTS),
        replace(RECIPE, code="c0de2").key("a", DIGESTS),
        replace(RECIPE, parameters=nearer).key("a", DIGESTS),
    )
    key = RECIPE.key("a", DIGESTS)
    assert len({key, *others}) == 1 + len(others)
    turned = replace(RECIPE, versions=dict(reversed(RECIPE.versions.items())))
    assert turned.key("a", dict(reversed(DIGESTS.items()))) == key


def test_what_changed_is_said(record):
    same = Recipe(record.parameters, dict(record.versions), record.code)
    assert same.difference(record, record.sources) == "how sources are read changed"
    grid, slat = record.sources
    other = replace(slat, sha256="f" * 64)
    assert same.difference(record, (grid, other)) == f"sources changed: {slat.role}"
    assert same.difference(record, (grid,)) == f"sources changed: {slat.role}"
    both = (replace(grid, sha256="e" * 64), other)
    assert same.difference(record, both) == f"sources changed: {grid.role}, {slat.role}"
    assert replace(same, code="other").difference(record, record.sources) == "code changed"
    newer = replace(same, versions={**record.versions, "numpy": "99.0"})
    was = record.versions["numpy"]
    assert newer.difference(record, ()) == f"libraries changed: numpy was {was}, is 99.0"
    unknown = replace(same, versions={"small_gicp": "1.0"})
    assert unknown.difference(record, ()) == "libraries changed: small_gicp was None, is 1.0"


def test_the_library_that_voxelises_parts_counts():
    pytest.importorskip("trimesh")
    roots = SourceRoots(Path("/a"), Path("/b"), adapter="parts")
    assert reading_of(roots) == {"adapter": f"parts trimesh {metadata.version('trimesh')}"}
    assert reading_of(replace(roots, adapter="voxels")) == {"adapter": "voxels "}


def test_statements_count_and_words_do_not(tmp_path, monkeypatch):
    module = tmp_path / "m.py"
    monkeypatch.setattr(fingerprint, "numeric_modules", lambda: {"m": module})

    def of(text: str) -> str:
        module.write_text(text)
        return str(code_fingerprint.__wrapped__())

    words = '"""Words."""\n\nA = 2\n"""Of A."""\n\n\ndef f(x):\n    """More."""\n'
    first = of(words + "    return x + 1  # why\n")
    assert of("A = 2\ndef f(x):\n    return (x +\n            1)\n") == first
    assert of("A = 2\ndef f(x):\n    return x + 2\n") != first
    assert of("A = 3\ndef f(x):\n    return x + 1\n") != first


def test_numbers_beside_a_module_count(tmp_path, monkeypatch):
    module, numbers = tmp_path / "m.py", tmp_path / "m.json"
    monkeypatch.setattr(fingerprint, "numeric_modules", lambda: {"m": module})
    module.write_text("x = 1\n")
    digests = [code_fingerprint.__wrapped__()]
    for text in ("[1.0]", "[1.5]"):
        numbers.write_text(text)
        digests.append(code_fingerprint.__wrapped__())
    assert len(set(digests)) == 3
    assert numeric_modules()["slatprep.judge.calibration"].with_suffix(".json") == NUMBERS
    assert NUMBERS.is_file()


def test_a_tree_is_written_alike_under_every_python():
    text = "class C[T]: x: int = None" if sys.version_info >= (3, 12) else "class C: x: int = None"
    tree = ast.parse("def f(a, *, b=[]): return f'{a!r:>{b}}' 'x'")
    assert fingerprint._dump(tree) == (
        "Module(body=[FunctionDef(name='f', args=arguments(args=[arg(arg='a')], "
        "kwonlyargs=[arg(arg='b')], kw_defaults=[List(ctx=Load())]), body=[Return("
        "value=JoinedStr(values=[FormattedValue(value=Name(id='a', ctx=Load()), conversion=114, "
        "format_spec=JoinedStr(values=[Constant(value='>'), FormattedValue(value=Name(id='b', "
        "ctx=Load()), conversion=-1)])), Constant(value='x')]))])])"
    )
    assert ("type_params" in fingerprint._dump(ast.parse(text))) == ("[" in text)


@pytest.mark.parametrize("minor", [11, 12, 13, 14])
def test_it_is_the_same_under_another_python(minor):
    python = shutil.which(f"python3.{minor}")
    if minor == sys.version_info[1] or not python or subprocess.run([python, "-c", ""]).returncode:
        pytest.skip("this Python, or none")
    # The module alone, as another Python need not have the libraries.
    code = f"import runpy; print(runpy.run_path({fingerprint.__file__!r})['code_fingerprint']())"
    told = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == code_fingerprint()


def test_it_covers_every_module_that_an_asset_runs_through_and_is_the_same_elsewhere():
    """Trace what is loaded for one asset, in a process that has loaded nothing else."""
    code = (
        "import sys; from slatprep.readers.pixieverse import PixieVerse; "
        "from slatprep.readers.slat import read_slat; from slatprep.sample import sample; "
        "from slatprep.judge import judge; from slatprep.align import quality, field; "
        "print(*(m for m in sys.modules if m.startswith('slatprep'))); "
        "from slatprep.pipeline.fingerprint import code_fingerprint; print(code_fingerprint())"
    )
    modules, key = python("-c", code).stdout.splitlines()
    assert key == code_fingerprint()
    loaded = set(modules.split())
    # Packages that only gather names, words of errors, and values that the key holds.
    uncounted = {"slatprep", *(f"slatprep.{name}" for name in ("storage", "errors", "parameters"))}
    # Whichever way bytes come, their digests tell them.
    carrying = {name for name in loaded if name.startswith("slatprep.storage.")}
    assert loaded - set(numeric_modules()) <= uncounted | carrying


def test_what_it_covers_imports_nothing_else_that_makes_numbers():
    modules = numeric_modules()
    nodes = (node for path in modules.values() for node in ast.walk(ast.parse(path.read_bytes())))
    found = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    every = {name for one in found for name in (one.module, *(f"{one.module}.{alias.name}"
             for alias in one.names)) if str(name).startswith("slatprep")}  # fmt: skip
    # A name that is no module is defined in one.
    there = {str(name) for name in every if fingerprint._source(str(name)).is_file()}
    others = {name for name in there - modules.keys() if not name.startswith("slatprep.storage")}
    # Words, values that the key holds, forms of records, and what runs tasks.
    words = ("errors", "parameters", "store.record", "workers", "workers.local")
    assert others <= {"slatprep", *(f"slatprep.{name}" for name in words)}


def test_what_makes_numbers_is_in_it_and_nothing_else():
    modules = numeric_modules()
    readers = {name.partition(":")[0] for name in SOURCES.values()}
    merging = {f"slatprep.{name}" for name in ("pipeline.annotate", "storage.chunks")}
    assert readers | merging | {"slatprep.storage.chunks"} <= modules.keys()
    others = ("slatprep.storage.pl", "slatprep.cli", "slatprep.store")
    assert not [name for name in modules if name.startswith((*others, "slatprep.pipeline.dataset"))]
    for path in modules.values():
        ast.parse(path.read_text())


def test_what_packs_rows_makes_columns_and_records_is_in_the_other(monkeypatch, tmp_path):
    """Code that is in no key, and still decides bytes."""
    wanted = {"normalize", "pipeline.pack", "pipeline.recipe", "store.record_json",
              "store.shard_writer", "store.layout", "store.attributes", "pipeline.settle",
              "pipeline.passes"}  # fmt: skip
    assert {f"slatprep.{name}" for name in wanted} <= set(fingerprint.PACKING)
    before = fingerprint.packing_fingerprint.__wrapped__()
    source = fingerprint._source
    for name in fingerprint.PACKING:
        changed = tmp_path / f"{name}.py"
        changed.write_bytes(source(name).read_bytes() + b"\nCHANGED = 1\n")
        monkeypatch.setattr(
            fingerprint, "_source", lambda one, n=name, c=changed: c if one == n else source(one)
        )
        assert fingerprint.packing_fingerprint.__wrapped__() != before
    monkeypatch.setattr(fingerprint, "_source", source)
    assert fingerprint.packing_fingerprint.__wrapped__() == before

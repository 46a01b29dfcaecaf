"""The commands as a user calls them: help, exit codes, JSON, errors."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from click.testing import CliRunner, Result

from slatprep.cli.commands import COMMANDS, slatprep

THREE_ASSETS = ("--assets", "3", "--seed", "3", "--level", "0")


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(slatprep, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three easy demo assets and the store that `build-store` makes of them."""
    folder = tmp_path_factory.mktemp("cli")
    made = run("make-demo", folder / "demo", *THREE_ASSETS, "-q")
    assert made.exit_code == 0, made.output
    built = run(
        "build-store", "--config", folder / "demo" / "dataset.toml",
        "--out", folder / "demo.zarr", "-q",
    )  # fmt: skip
    assert built.exit_code == 0, built.output
    return folder


def ids_of(store: Path) -> list[str]:
    return [str(asset_id) for asset_id in zarr.open_group(store, mode="r")["asset/id"][:]]


# -- help ---------------------------------------------------------------------


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example_that_parses(name: str, parse_command: Callable[[str], None]) -> None:
    result = run(name, "--help")
    assert result.exit_code == 0
    examples = re.findall(r"^ +(slatprep .+)$", result.output.partition("Example:")[2], re.M)
    assert examples
    for example in examples:
        assert example.split()[1] == name
        parse_command(example)


def test_help_lists_every_command_and_the_exit_codes() -> None:
    output = run("--help").output
    for name in COMMANDS:
        assert re.search(rf"^  {name} +\S", output, re.M), name
    assert re.search(r"0 +all went in", output) and re.search(r"2 +wrong use", output)
    assert "..." not in output.partition("Make and build:")[2].partition("Exit codes:")[0]


def test_help_groups_commands_as_people_work() -> None:
    shown = re.findall(r"^([A-Z][a-z ]+):\n((?:  .*\n)+)", run("--help").output, re.M)
    groups = {title: re.findall(r"^  ([a-z-]+) ", body, re.M) for title, body in shown}
    assert groups.keys() >= {"Make and build", "Look and check", "Take elsewhere", "Learn"}
    assert "build-store" in groups["Make and build"] and "verify" in groups["Maintain"]
    assert all(body.count("\n") <= 24 for _, body in shown)


def modules_of(*words: str | Path) -> tuple[str, str]:
    """Run a command in a process; return what it printed, and the packages that it imported."""
    script = (
        "import sys\n"
        "try:\n    from slatprep.cli import main; main()\n"
        "except SystemExit: pass\n"
        "print(sorted({name.partition('.')[0] for name in sys.modules}), file=sys.stderr)\n"
    )
    command = [sys.executable, "-c", script, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout, done.stderr


def test_help_imports_nothing_heavy() -> None:
    printed, modules = modules_of("--help")
    assert "build-store" in printed
    heavy = ("numpy", "zarr", "scipy", "open3d", "h5py", "joblib", "pydantic", "rich", "numba")
    for module in heavy:
        assert f"'{module}'" not in modules


@pytest.mark.parametrize("name", ["info", "list"])
def test_whoever_only_looks_at_a_store_loads_no_compiler(name: str, demo: Path) -> None:
    printed, modules = modules_of(name, demo / "demo.zarr")
    assert "good" in printed
    assert "'numpy'" in modules
    for module in ("numba", "scipy", "open3d"):
        assert f"'{module}'" not in modules


def test_entry_holds_libraries_to_one_thread() -> None:
    script = (
        "import sys, os\n"
        "sys.argv = ['slatprep', '--version']\n"
        "try:\n    from slatprep.cli import main; main()\n"
        "except SystemExit: pass\n"
        "import numpy, threadpoolctl\n"
        "print([pool['num_threads'] for pool in threadpoolctl.threadpool_info()])\n"
        "print(os.environ['NUMBA_NUM_THREADS'], os.environ['OMP_NUM_THREADS'])\n"
    )
    environment = os.environ | {"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment
    )
    *_, pools, variables = done.stdout.splitlines()
    assert set(json.loads(pools)) == {1}
    assert variables == "1 1"


# -- end to end ---------------------------------------------------------------


def test_what_one_command_writes_the_others_read(demo: Path) -> None:
    store = demo / "demo.zarr"
    ids = ids_of(store)
    assert len(ids) == 3
    described = json.loads(run("info", store, "--json", "-q").stdout)
    assert described["total"]["assets"] == 3
    offsets = zarr.open_group(store, mode="r")["asset/offset"][:]
    assert described["total"]["voxels"] == int(offsets[-1])
    assert sum(group["assets"] for group in described["categories"]) == 3

    scored = json.loads(run("score", store, demo / "demo" / "truth", "--json").stdout)
    assert [row["asset_id"] for row in scored["assets"]] == ids
    assert scored["missing"] == []

    checked = run("check-alignment", "--asset", ids[0], "--store", store)
    assert checked.exit_code == 0, checked.output


def test_align_writes_one_record_an_asset(demo: Path) -> None:
    out = demo / "alignments.jsonl"
    result = run(
        "align", "--pixieverse", demo / "demo" / "pixieverse", "--slat", demo / "demo" / "slat",
        "--out", out, "--json", "-q",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["statuses"]["ok"] == 3
    records = [json.loads(line) for line in out.read_text().splitlines()]
    assert [record["asset_id"] for record in records] == ids_of(demo / "demo.zarr")
    stored = zarr.open_group(demo / "demo.zarr", mode="r")["asset/transform"][:]
    np.testing.assert_array_equal([r["alignment"]["transform"] for r in records], stored)


def test_preset_paper_is_the_protocol_on_open3d(demo: Path, tmp_path: Path) -> None:
    grid = next((demo / "demo" / "pixieverse").iterdir())
    shutil.copytree(grid, tmp_path / "pixieverse" / grid.name)
    out = tmp_path / "paper.jsonl"
    result = run(
        "align", "--pixieverse", tmp_path / "pixieverse", "--slat", demo / "demo" / "slat",
        "--preset", "paper", "--out", out, "-q",
    )  # fmt: skip
    assert result.exit_code == 1  # the other objects are not there
    by_status: dict[str, list[dict[str, Any]]] = {}
    for record in map(json.loads, out.read_text().splitlines()):
        by_status.setdefault(record["status"], []).append(record)
    (aligned,) = by_status["ok"]
    assert aligned["asset_id"] == grid.name
    assert aligned["alignment"]["engine"] == "open3d"
    assert len(aligned["alignment"]["candidates"]) == 64
    assert len(by_status["skipped"]) == 2
    assert len(result.stderr.splitlines()) == 2


def test_options_win_over_the_dataset_definition(demo: Path) -> None:
    (demo / "empty").mkdir()
    arguments = ("align", "--config", demo / "demo" / "dataset.toml", "--out", demo / "no.jsonl")
    for name, said in (("empty", str(demo / "empty")), ("absent", "option --pixieverse: ")):
        result = run(*arguments, "--pixieverse", demo / name)
        assert result.exit_code == 2
        assert result.stderr.startswith("slatprep: error: ") and said in result.stderr
        assert len(result.stderr.splitlines()) == 1
    assert f"{demo} does, and holds the folders " in result.stderr


def test_asset_that_cannot_go_in_is_named_and_exit_code_is_one(demo: Path, tmp_path: Path) -> None:
    assert run("make-demo", tmp_path / "demo", *THREE_ASSETS, "-q").exit_code == 0
    broken = sorted((tmp_path / "demo" / "slat").glob("*.npz"))[0]
    broken.write_bytes(broken.read_bytes()[:100])
    arguments = ("build-store", "--config", tmp_path / "demo" / "dataset.toml",
                 "--out", tmp_path / "demo.zarr", "--json")  # fmt: skip
    result = run(*arguments)
    assert result.exit_code == 1
    document = json.loads(result.stdout)
    assert document["statuses"] == {"ok": 2, "failed": 1, "skipped": 0}
    assert document["ok"] is False
    (line,) = [line for line in result.stderr.splitlines() if line]
    assert line.startswith(f"{broken.stem}: ") and broken.name in line and "expected" in line
    assert broken.stem not in ids_of(tmp_path / "demo.zarr")

    strict = run(*arguments, "--strict")
    assert strict.exit_code == 1
    assert broken.name in json.loads(strict.stdout).pop("error")
    assert "slatprep: error: " in strict.stderr and broken.name in strict.stderr
    assert "Traceback" not in strict.stderr
    assert len(ids_of(tmp_path / "demo.zarr")) == 2  # the store that was there is still there

    missing = run("score", tmp_path / "demo.zarr", tmp_path / "demo" / "truth", "--json")
    assert missing.exit_code == 1
    assert json.loads(missing.stdout)["missing"] == [broken.stem]


# -- wrong use ----------------------------------------------------------------


def test_config_error_is_one_line_and_exit_code_two(tmp_path: Path) -> None:
    config = tmp_path / "mine.toml"
    config.write_text('[pixieverse]\nrot = "x"\n')
    result = run("build-store", "--config", config, "--out", tmp_path / "s.zarr")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"slatprep: error: {config}: pixieverse.rot: unknown key")
    assert "did you mean 'root'" in result.stderr
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ("no-such-command",),
        ("build-store", "--no-such-option"),
        ("build-store", "--pixieverse", ".", "--slat", "."),  # no --out
        ("align", "--out", "x.jsonl"),  # no sources
        ("make-demo", "x", "--assets", "0"),
        ("make-demo", "x", "--level", "8"),
        ("info", "no-such-store.zarr"),
        ("check-alignment", "--store", "."),  # no --asset
    ],
)
def test_wrong_use_is_exit_code_two(
    arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert "rror: " in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_unknown_asset_is_wrong_use_and_gets_a_suggestion(demo: Path) -> None:
    asset_id = ids_of(demo / "demo.zarr")[0]
    result = run("check-alignment", "--asset", asset_id[:-1] + "_", "--store", demo / "demo.zarr")
    assert result.exit_code == 2
    assert "did you mean" in result.stderr and asset_id in result.stderr


def test_store_built_last_is_the_default(demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = demo / "elsewhere"
    (elsewhere / "data").mkdir(parents=True)
    monkeypatch.chdir(elsewhere)
    result = run("info")
    assert result.exit_code == 2
    assert "make align" in result.stderr
    (elsewhere / "data" / "demo.zarr").symlink_to(demo / "demo.zarr")
    assert run("info", "--json").exit_code == 0
    assert run("check-alignment", "--asset", ids_of(demo / "demo.zarr")[0]).exit_code == 0


def test_interrupt_is_clean_and_says_that_nothing_was_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("slatprep.demo.make_demo", interrupted)
    result = run("make-demo", tmp_path / "demo")
    assert result.exit_code == 130
    assert "nothing was replaced" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_build_leaves_the_older_store_and_nothing_else(
    demo: Path, tmp_path: Path, signal_number: signal.Signals
) -> None:
    store = tmp_path / "demo.zarr"
    shutil.copytree(demo / "demo.zarr", store)
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    build = subprocess.Popen(
        [sys.executable, "-m", "slatprep", "build-store", "--config",
         demo / "demo" / "dataset.toml", "--out", store, "--jobs", "2", "--fresh"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        # A shell that starts the tests in the background has them ignore SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    while len(list(tmp_path.iterdir())) == 1 and build.poll() is None:
        time.sleep(0.05)
    build.send_signal(signal_number)
    _, said = build.communicate(timeout=600)
    assert build.returncode == 130, said
    assert "stopped; nothing was replaced" in said and "Traceback" not in said
    assert list(tmp_path.iterdir()) == [store]
    assert {path: path.read_bytes() for path in store.rglob("*") if path.is_file()} == before

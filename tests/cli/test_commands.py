"""The commands as a user calls them: help, exit codes, JSON, errors, output that is lost."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.commands import document, parse_command, python, refused, run
from support.trees import tree

from slatprep import ConfigError, open_store
from slatprep.cli.commands import COMMANDS
from slatprep.inspect.verify import verify_store
from slatprep.parameters import PRESETS, BuildParameters

THREE_ASSETS = ("--assets", "3", "--seed", "3", "--level", "0")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three easy demo assets and the store that `build-store` makes of them."""
    folder = tmp_path_factory.mktemp("cli")
    run("make-demo", folder / "demo", *THREE_ASSETS, "-q")
    config = folder / "demo" / "dataset.toml"
    run("build-store", "--config", config, "--out", folder / "demo.zarr", "-q")
    return folder


# -- help ---------------------------------------------------------------------


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example_that_parses(name):
    output = run(name, "--help").output
    examples = re.findall(r"^ +(slatprep .+)$", output.partition("Example:")[2], re.M)
    assert examples
    for example in examples:
        assert example.split()[1] == name
        parse_command(example)


def test_help_lists_every_command_in_groups_as_people_work_and_the_exit_codes():
    output = run("--help").output
    for name in COMMANDS:
        assert re.search(rf"^  {name} +\S", output, re.M), name
    assert re.search(r"0 +all went in", output) and re.search(r"2 +wrong use", output)
    assert "..." not in output.partition("Make and build:")[2].partition("Exit codes:")[0]
    shown = re.findall(r"^([A-Z][a-z ]+):\n((?:  .*\n)+)", output, re.M)
    groups = {title: re.findall(r"^  ([a-z-]+) ", body, re.M) for title, body in shown}
    assert groups.keys() >= {"Make and build", "Look and check", "Take elsewhere", "Learn"}
    assert "build-store" in groups["Make and build"] and "verify" in groups["Maintain"]
    assert all(body.count("\n") <= 24 for _, body in shown)


def test_a_command_imports_no_more_than_it_needs(demo):
    """Of commands in one process, each imports what those before it have and little more."""
    script = (
        "import json, sys\n"
        "from slatprep.cli import main\n"
        "for words in json.loads(sys.argv[1]):\n"
        "    sys.argv = ['slatprep', *words]\n"
        "    try: main()\n"
        "    except SystemExit: pass\n"
        "    print('#' * 9)\n"
        "    print(sorted({name.partition('.')[0] for name in sys.modules}), file=sys.stderr)\n"
    )
    store = str(demo / "demo.zarr")
    unchanged = ["build-store", "--config", str(demo / "demo" / "dataset.toml"), "--out", store]
    lines = (["--help"], ["check-alignment", "--help"], ["info", store], ["list", store], unchanged)
    done = python("-c", script, json.dumps(lines))
    for word, printed in zip(
        ("build-store", "The exit code is 1 unless", "good", "good", "3 taken over"),
        done.stdout.split("#" * 9)[:5], strict=True,
    ):  # fmt: skip
        assert word in printed
    slow = ("scipy", "open3d", "numba")
    heavy = (*slow, "numpy", "zarr", "h5py", "joblib", "pydantic", "rich", "matplotlib")
    *helped, info, listed, built = (m for m in done.stderr.splitlines() if m.startswith("['"))
    assert len(helped) == 2
    for modules, absent in (
        (helped[0], heavy), (helped[1], heavy), (info, slow), (listed, slow), (built, slow),
    ):  # fmt: skip
        assert not [name for name in absent if f"'{name}'" in modules]
    assert "'numpy'" in info


def test_a_backend_that_matplotlib_does_not_know_hinders_no_picture():
    script = (
        "import sys\nfrom slatprep.cli import main\nsys.argv = ['slatprep', '--version']\n"
        "try: main()\nexcept SystemExit: import matplotlib\nprint(matplotlib.get_backend())"
    )
    assert python("-c", script, MPLBACKEND="none-such").stdout.split()[-1].lower() == "agg"


def test_entry_holds_libraries_to_one_thread():
    script = (
        "import sys, os\n"
        "sys.argv = ['slatprep', '--version']\n"
        "try:\n    from slatprep.cli import main; main()\n"
        "except SystemExit: pass\n"
        "import numpy, threadpoolctl\n"
        "print([pool['num_threads'] for pool in threadpoolctl.threadpool_info()])\n"
        "print(os.environ['NUMBA_NUM_THREADS'], os.environ['OMP_NUM_THREADS'])\n"
    )
    done = python("-c", script, OMP_NUM_THREADS="2", OPENBLAS_NUM_THREADS="2")
    *_, pools, variables = done.stdout.splitlines()
    assert set(json.loads(pools)) == {1}
    assert variables == "1 1"


# -- end to end ---------------------------------------------------------------


def test_preset_paper_is_asked_of_the_build(demo, monkeypatch):
    asked: list[BuildParameters] = []

    def stop(parameters: BuildParameters, *_: object, **__: object) -> None:
        asked.append(parameters)
        raise ConfigError("far enough")

    monkeypatch.setattr("slatprep.pipeline.dataset.align_pairs", stop)
    words = ("--config", demo / "demo" / "dataset.toml", "--out", demo / "paper.jsonl")
    assert "far enough" in refused("align", *words, "--preset", "paper")
    assert asked[0].align == PRESETS["paper"].align


def test_options_win_over_the_dataset_definition(demo):
    (demo / "empty").mkdir()
    words = ("align", "--config", demo / "demo" / "dataset.toml", "--out", demo / "no.jsonl")
    told = refused(*words, "--pixieverse", demo / "empty")
    assert told.startswith("slatprep: error: ") and str(demo / "empty") in told
    assert len(told.splitlines()) == 1


def test_asset_that_cannot_go_in_is_named_and_exit_code_is_one(demo, tmp_path):
    shutil.copytree(demo / "demo", tmp_path / "demo")
    broken = sorted((tmp_path / "demo" / "slat").glob("*.npz"))[0]
    broken.write_bytes(broken.read_bytes()[:100])
    arguments = ("build-store", "--config", tmp_path / "demo" / "dataset.toml",
                 "--out", tmp_path / "demo.zarr", "--json")  # fmt: skip
    result = run(*arguments, code=1)
    told = json.loads(result.stdout)
    assert told["statuses"] == {"ok": 2, "failed": 1, "skipped": 0}
    assert told["ok"] is False
    (line,) = [line for line in result.stderr.splitlines() if line]
    assert line.startswith(f"{broken.stem}: ") and broken.name in line and "expected" in line
    assert broken.stem not in open_store(tmp_path / "demo.zarr").ids

    strict = run(*arguments, "--strict", code=1)
    assert broken.name in json.loads(strict.stdout).pop("error")
    assert "slatprep: error: " in strict.stderr and broken.name in strict.stderr
    assert len(open_store(tmp_path / "demo.zarr")) == 2  # the store that was there is still there

    scored = document("score", tmp_path / "demo.zarr", tmp_path / "demo" / "truth", code=1)
    assert scored["missing"] == [broken.stem]


# -- wrong use ----------------------------------------------------------------


def test_store_built_last_is_the_default(demo, monkeypatch):
    elsewhere = demo / "elsewhere"
    (elsewhere / "data").mkdir(parents=True)
    monkeypatch.chdir(elsewhere)
    (elsewhere / "data" / "gone.zarr").symlink_to(demo / "gone.zarr")
    assert "make align" in refused("info")
    (elsewhere / "data" / "demo.zarr").symlink_to(demo / "demo.zarr")
    assert run("info").stdout.startswith("Store data/demo.zarr\n")
    words = ("check-alignment", "--asset", "0", "--picture", "none", "--json")
    last, store = run(*words).stdout, demo / "demo.zarr"
    assert run(*words, store).stdout == run(*words, "--store", store).stdout
    assert json.loads(last)["assets"] == document(*words[:-1], store)["assets"]
    both = refused(*words, store, "--store", store)
    assert "STORE and --store both name the store" in both


def test_stopped_build_leaves_the_older_store_and_nothing_else(demo, tmp_path):
    store = tmp_path / "demo.zarr"
    shutil.copytree(demo / "demo.zarr", store)
    before = tree(store)
    build = subprocess.Popen(
        [sys.executable, "-m", "slatprep", "build-store", "--config",
         demo / "demo" / "dataset.toml", "--out", store, "--jobs", "2", "--fresh"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    while len(list(tmp_path.iterdir())) == 1 and build.poll() is None:
        time.sleep(0.05)
    build.terminate()
    _, said = build.communicate(timeout=600)
    # Where it was importing a module, Python ends by the signal, which a shell calls 130, too.
    assert build.returncode in (130, -signal.SIGINT), said
    assert "stopped; nothing was replaced" in said and "Traceback" not in said
    assert list(tmp_path.iterdir()) == [store]
    assert tree(store) == before


# -- standard output or standard error is closed, or full ---------------------------


def shell(words: str, redirected: str) -> subprocess.CompletedProcess[str]:
    line = f"{sys.executable} -m slatprep {words} {redirected}"
    return subprocess.run(["sh", "-c", line], capture_output=True, text=True, timeout=600)


@pytest.mark.parametrize(
    ("words", "redirected"), [("info {}", ">&-"), ("list {} --json", "> /dev/full")]
)
def test_lost_output_is_told_on_standard_error(mixed_build, words, redirected):
    if "full" in redirected and not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    done = shell(words.format(mixed_build.store), redirected)
    assert done.returncode == 3
    told = [line for line in done.stderr.splitlines() if line.startswith("slatprep: error:")]
    assert len(told) == 1 and "standard output cannot be written to" in told[0]
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr


@pytest.mark.parametrize("redirected", ["2> /dev/full", ">&- 2>&-"])
def test_a_subset_is_whole_whatever_happens_to_what_it_prints(mixed_build, tmp_path, redirected):
    out = tmp_path / "s.zarr"
    done = shell(f"subset {mixed_build.store} --verdict good --out {out}", redirected)
    assert "Traceback" not in done.stdout + done.stderr
    assert done.returncode in (0, 3)
    store = open_store(out)
    assert len(store) and all(asset.columns["verdict"] == "good" for asset in store)
    assert verify_store(out).ok


def test_lost_notes_are_told_on_standard_output_and_never_within_json(mixed_build, tmp_path):
    store = mixed_build.store
    done = shell(f"describe {store}", "2>&-")  # It notes what is not stated.
    assert done.returncode == 3
    assert "standard error cannot be written to" in done.stdout
    # It notes how many objects are in each split.
    done = shell(f"export {store} --format npz --out {tmp_path}/n --split train --json", "2>&-")
    assert done.returncode == 3
    told = json.loads(done.stdout)
    assert (told["command"], told["store"]) == ("export", str(store))


def test_a_reader_that_has_read_enough_is_no_fault(mixed_build, tmp_path):
    store = mixed_build.store
    done = shell(f"list {store} --ids", "| head -1")
    assert done.stdout.count(os.linesep) == 1 and "rror" not in done.stderr
    for words, code in (("--verdict good", 0), ("--asset nobody", 2)):
        reading, writing = os.pipe()
        os.close(reading)
        line = f"subset {store} {words} --out {tmp_path}/s.zarr".split()
        done = subprocess.run(
            [sys.executable, "-m", "slatprep", *line], stdout=writing, stderr=writing, check=False
        )
        os.close(writing)
        assert done.returncode == code, words
    assert verify_store(tmp_path / "s.zarr").ok


def test_a_python_without_docstrings_is_told_that_the_commands_are_made_of_them():
    for words in (["--help"], ["info"]):
        done = python("-OO", "-m", "slatprep", *words, code=2)
        assert done.stdout == ""
        assert done.stderr.startswith("slatprep: error: ") and "-OO" in done.stderr
        assert done.stderr.count("\n") == 1

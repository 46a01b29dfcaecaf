"""What commands say to somebody who meets them for the first time, and with which exit code."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from click.testing import CliRunner, Result
from support.rights import BOUND_BY_PERMISSIONS
from support.synthetic import Dataset

from slatprep import open_store
from slatprep.cli.commands import slatprep
from slatprep.cli.info import show_quality
from slatprep.cli.output import Output
from slatprep.inspect.overview import overview_of
from slatprep.learn.runs import EpochRecord
from slatprep.pipeline.dataset import BuildSummary, build_store
from slatprep.storage.place import place_of


def run(*words: object) -> Result:
    result = CliRunner().invoke(slatprep, [str(word) for word in words])
    assert "Traceback" not in result.output
    return result


@pytest.fixture
def store(mixed_build: BuildSummary) -> Path:
    assert mixed_build.store is not None
    return Path(str(mixed_build.store))


@pytest.mark.parametrize(
    "words",
    [
        ("check-alignment", "--store", "STORE", "--asset", "NOBODY", "--picture", "none"),
        ("export", "STORE", "--asset", "NOBODY", "--format", "npz", "--out", "OUT"),
        ("subset", "STORE", "--asset", "NOBODY", "--out", "OUT"),
        ("transfer", "POINTS", "--store", "STORE", "--asset", "NOBODY", "--out", "OUT"),
    ],
)
def test_a_name_that_no_asset_has_is_wrong_use_in_every_command(
    words: tuple[str, ...], store: Path, tmp_path: Path
) -> None:
    np.save(tmp_path / "p.npy", np.zeros((3, 3), np.float32))
    places = {"STORE": store, "OUT": tmp_path / "out", "POINTS": tmp_path / "p.npy"}
    for name, said in (("nobody", "has no asset 'nobody'"), ("be", "2 ids begin with 'be'")):
        result = run(*(places.get(word, name if word == "NOBODY" else word) for word in words))
        assert result.exit_code == 2 and said in result.stderr


@pytest.mark.parametrize(
    ("words", "number"),
    [
        (("train", "STORE", "--out", "OUT", "--learning-rate"), "nan"),
        (("train", "STORE", "--out", "OUT", "--learning-rate"), "inf"),
        (("train", "STORE", "--out", "OUT", "--max-ambiguity"), "nan"),
        (("make-demo", "OUT", "--habitual-share"), "nan"),
    ],
)
def test_numbers_are_finite(
    words: tuple[str, ...], number: str, store: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    places = {"STORE": store, "OUT": out}
    result = run(*(places.get(word, word) for word in words), number)
    assert result.exit_code == 2 and f"{number} is no finite number" in result.stderr
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("evaluate", "--store", "nothing-here", "--json"), "nothing-here"),
        (("make-demo", "--json", "d", "--assets", "0"), "0 is not in the range"),
        (("info", "--json", "--colour"), "--colour"),
    ],
)
def test_wrong_use_is_told_as_json(words: tuple[str, ...], said: str) -> None:
    result = run(*words)
    document = json.loads(result.stdout)
    assert result.exit_code == 2 and said in document["error"] and said in result.stderr
    command = " ".join(word for word in words[:2] if word in ("evaluate", "make-demo", "info"))
    assert (document["command"], document["ok"]) == (command, False)


def test_a_misspelt_command_is_told_with_the_one_meant() -> None:
    result = run("chek-alignment", "--worst", "3")
    assert result.exit_code == 2 and "did you mean check-alignment?" in result.stderr
    assert run("xyzzy").exit_code == 2


def test_what_catalogues_ask_for_is_named_where_it_is_not_stated(store: Path) -> None:
    told = run("describe", store, "--license", "https://spdx.org/licenses/MIT")
    assert "also ask for --cite-as, --date-published" in told.stderr


def test_capitals_of_an_id_are_forgiven_in_words(store: Path) -> None:
    result = run("check-alignment", "--store", store, "--asset", "BEAR.S", "--picture", "none")
    assert result.exit_code == 2 and "did you mean bear.side?" in result.stderr


@pytest.mark.parametrize("command", ["list", "subset"])
def test_a_category_that_no_asset_has_is_told_with_the_one_meant(
    command: str, mixed: Dataset, tmp_path: Path
) -> None:
    (tmp_path / "kinds.json").write_text(json.dumps({"cup": {"obj_class": "vessels"}}))
    config = tmp_path / "dataset.toml"
    config.write_text(
        f'[pixieverse]\nroot = "{mixed.root}/pixieverse"\n[slat]\nroot = "{mixed.root}/slat"\n'
        f'[pairing]\ncategories = "kinds.json"\n'
    )
    built = run("build-store", "--config", config, "--out", tmp_path / "s.zarr")
    assert built.exit_code == 1 and "unknown: the category of 4" in built.stdout
    out = ("--out", tmp_path / "x.zarr") if command == "subset" else ()
    result = run(command, tmp_path / "s.zarr", "--category", "vessel", *out)
    assert result.exit_code == 2 and "expected vessels" in result.stderr
    assert run(command, tmp_path / "s.zarr", "--category", "vessels", *out).exit_code == 0


def test_no_category_is_known_where_no_table_is_named(store: Path) -> None:
    assert "[pairing]" in run("info", store).stdout
    result = run("list", store, "--category", "cup")
    assert result.exit_code == 2 and "no category is known" in result.stderr


def test_ambiguous_means_the_same_wherever_it_is_counted(store: Path, tmp_path: Path) -> None:
    copied = tmp_path / "copy.zarr"
    assert run("subset", store, "--verdict", "good", "--out", copied, "-q").exit_code == 0
    zarr.open_group(copied, mode="r+")["asset/ambiguity"][:] = [0.0, 0.2, 0.9, 0.05, 0.01]
    assert "2 of 5: other placements" in run("info", copied).stdout
    drawn = run("check-alignment", "--store", copied, "--ambiguous", "--picture", "none", "--json")
    told = [one["asset_id"] for one in json.loads(drawn.stdout)["assets"]]
    assert told == ["bear.side", "bear.front"]


def test_info_and_verify_count_the_same_files(store: Path) -> None:
    told = (run(command, store, "--json") for command in ("info", "verify"))
    one, other = (json.loads(result.stdout)["files"] for result in told)
    assert one == other == sum(file.is_file() for file in store.rglob("*"))


@pytest.mark.parametrize(
    ("place", "named"),
    [
        ("s3://b/x.zarr/versions/0123456789abcdef", "s3://b/x.zarr"),
        ("/d/versions/0123456789abcdef", "/d/versions/0123456789abcdef"),
    ],
)
def test_advice_names_the_store_and_not_a_version_that_is_removed_later(
    store: Path, place: str, named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    overview = overview_of(open_store(store))
    total = replace(overview.total, verdicts={"good": 0, "doubtful": 1, "failed": 0}, ambiguous=1)
    show_quality(Output(), replace(overview, store=place_of(place), total=total), advise=False)
    lines = capsys.readouterr().out.splitlines()
    advice = {line.partition(":")[0]: line.split()[1:] for line in lines if " slatprep " in line}
    assert advice["why"] == ["slatprep", "list", named, "--verdict", "doubtful"]
    assert advice["look"] == ["slatprep", "check-alignment", "--ambiguous", "--store", named]


@pytest.mark.parametrize("command", ["build-store", "align"])
def test_swapped_roots_are_recognised(command: str, mixed: Dataset, tmp_path: Path) -> None:
    words = (command, "--pixieverse", mixed.root / "slat", "--slat", mixed.root / "pixieverse")
    result = run(*words, "--out", tmp_path / "out.zarr")
    assert result.exit_code == 2
    assert f"the roots are swapped: grids lie below {mixed.root}/pixieverse" in result.stderr


def test_a_folder_that_is_no_store_is_called_so_by_every_command(tmp_path: Path) -> None:
    for command in ("info", "list", "verify", "report", "describe"):
        result = run(command, tmp_path)
        assert result.exit_code == 1 and f"{tmp_path} is not a slatprep store" in result.stderr


def test_quiet_commands_that_make_something_print_nothing(store: Path, tmp_path: Path) -> None:
    made = run("subset", store, "--asset", "cup", "--out", tmp_path / "cup.zarr", "-q")
    assert made.output == "" and len(open_store(tmp_path / "cup.zarr")) == 1
    assert run("report", tmp_path / "cup.zarr", "-q").output == ""
    assert "cup" in run("list", tmp_path / "cup.zarr", "-q").stdout
    assert json.loads(run("export", store, "--format", "npz", "--out", tmp_path / "n", "-q",
                          "--json").stdout)["assets"] == 5  # fmt: skip


def test_sources_of_a_joined_store_are_said_to_lie_apart(
    store: Path, mixed: Dataset, tmp_path: Path
) -> None:
    other = Dataset(tmp_path / "other")
    other.add("elk", seed=8)
    pixieverse = other.root / "pixieverse"
    build_store(other.parameters(), tmp_path / "elk.zarr")
    both = tmp_path / "both.zarr"
    assert run("concat", store, tmp_path / "elk.zarr", "--out", both).exit_code == 0
    result = run("verify", both, "--sources")
    assert result.exit_code == 1 and len(result.stderr.splitlines()) == 1
    assert "sources lie apart" in result.stderr and str(pixieverse) in result.stderr
    pixieverse.rename(tmp_path / "moved")
    moved = run("verify", tmp_path / "elk.zarr", "--sources").stderr
    assert f"its sources are not at {pixieverse} any more; name the roots" in moved


def test_our_own_cloud_in_the_frame_of_pixieverse_is_recognised(
    store: Path, tmp_path: Path
) -> None:
    pytest.importorskip("plyfile")
    for frame in ("pixieverse", "slat"):
        words = ("--format", "ply", "--frame", frame, "--points", "grid", "--asset", "cup")
        assert run("export", store, *words, "--out", tmp_path / frame).exit_code == 0
    words = ("--store", store, "--asset", "cup", "--out", tmp_path / "m.ply")
    result = run("transfer", tmp_path / "pixieverse" / "cup.ply", *words)
    assert result.exit_code == 1 and "slatprep export --frame slat" in result.stderr
    assert run("transfer", tmp_path / "slat" / "cup.ply", *words).exit_code == 0


@pytest.mark.parametrize("command", ["info", "list", "verify", "stats", "check-alignment"])
def test_documents_begin_alike_and_say_which_store(command: str, store: Path) -> None:
    words = ("--worst", "1", "--picture", "none", "--store") if command == "check-alignment" else ()
    document = json.loads(run(command, *words, store, "--json").stdout)
    assert list(document)[:3] == ["command", "version", "ok"]
    assert (document["command"], document["ok"]) == (command, True)
    assert document["store"] == str(store)


def test_what_ends_a_command_is_json_too(store: Path, tmp_path: Path) -> None:
    for words, code, said in (
        (("info", tmp_path, "--json"), 1, "is not a slatprep store"),
        (("check-alignment", "--asset", "cuo", "--store", store, "--json"), 2, "did you mean cup?"),
        (("check-alignment", "--store", store, "--json"), 2, "say which assets"),
        (
            ("report", store, "--out", "s3://nowhere/p.html", "--json"),
            2,
            "expected a path of the local",
        ),
    ):
        result = run(*words)
        assert result.exit_code == code
        document = json.loads(result.stdout)
        assert said in document["error"] and said in result.stderr and document["ok"] is False
    assert document["command"] == "report"


def test_a_store_that_may_not_be_read_is_no_other_kind_of_folder(
    store: Path, tmp_path: Path
) -> None:
    own = tmp_path / "s.zarr"
    shutil.copytree(store, own)
    (own / "zarr.json").chmod(0)
    script = f"{BOUND_BY_PERMISSIONS}\nfrom slatprep.cli import main; main()"
    command = [sys.executable, "-c", script, "info", str(own)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert "zarr.json: may not be read (Permission denied)" in done.stderr
    assert "is not a slatprep store" not in done.stderr


def test_nothing_is_written_to_memory_that_goes_with_the_command(store: Path) -> None:
    result = run("subset", store, "--verdict", "good", "--out", "memory://s.zarr")
    assert result.exit_code == 2 and "gone when the command ends" in result.stderr


def test_a_single_asset_is_counted_in_the_singular(store: Path, tmp_path: Path) -> None:
    out = tmp_path / "one.zarr"
    assert run("subset", store, "--asset", "0", "--out", out, "-q").exit_code == 0
    told = run("verify", out)
    assert told.exit_code == 0 and "1 asset," in told.stderr and "0 sources" not in told.stderr


def test_ctrl_c_says_what_is_kept_and_how_to_go_on(
    store: Path, mixed: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def built(*_: object, progress: Callable[[int, int], None], **__: object) -> None:
        progress(2, 3)
        raise KeyboardInterrupt

    monkeypatch.setattr("slatprep.pipeline.dataset.build_store", built)
    parts = mixed.parameters()
    sources = ("--pixieverse", parts.pixieverse.root, "--slat", parts.slat.root)
    stopped = run("build-store", *sources, "--out", tmp_path / "new.zarr")
    assert stopped.exit_code == 130
    assert "2 of 3 assets are done and kept; the same command goes on from there" in stopped.stderr

    def trained(*_: object, progress: Callable[[EpochRecord], None], **__: object) -> None:
        progress(EpochRecord(4, 1e-3, 0.5, 0.6, 0.7, 0.8))
        raise KeyboardInterrupt

    monkeypatch.setattr("slatprep.learn.train.train", trained)
    stopped = run("train", store, "--out", tmp_path / "run", "--keep", "last")
    assert stopped.exit_code == 130, stopped.output
    assert (
        "epochs up to 4 are kept, and the steps of epoch 5 but for the last 30 s" in stopped.stderr
    )

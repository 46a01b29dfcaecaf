"""What commands say to somebody who meets them for the first time, and with which exit code."""

import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from support.commands import document, python, refused, run
from support.faults import no_room
from support.made_store import rewrite
from support.predictions import write_predictions
from support.rights import BOUND_BY_PERMISSIONS
from support.synthetic import Dataset, definition

from slatprep import build_store, open_store
from slatprep.cli.info import show_quality
from slatprep.cli.output import Output
from slatprep.inspect.overview import overview_of
from slatprep.learn.runs import EpochRecord
from slatprep.storage import atomic
from slatprep.storage.place import place_of
from slatprep.store.integrity import digests_in

NOWHERE = Path("/proc/nobody-may-write-here")


@pytest.fixture(scope="module")
def of_kinds(mixed: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build `mixed` with a table that has the category of the cup alone."""
    folder = tmp_path_factory.mktemp("kinds")
    (folder / "kinds.json").write_text(json.dumps({"cup": {"obj_class": "vessels"}}))
    kinds = '[pairing]\ncategories = "kinds.json"\n'
    (folder / "dataset.toml").write_text(definition(mixed.parameters()) + kinds)
    words = ("--config", folder / "dataset.toml", "--out", folder / "s.zarr")
    assert "unknown: the category of 4" in run("build-store", *words, code=1).stdout
    return folder / "s.zarr"


@pytest.mark.parametrize("words", [
    ("check-alignment", "--store", "STORE", "--asset", "NOBODY", "--picture", "none"),
    ("export", "STORE", "--asset", "NOBODY", "--format", "npz", "--out", "OUT"),
    ("subset", "STORE", "--asset", "NOBODY", "--out", "OUT"),
    ("transfer", "POINTS", "--store", "STORE", "--asset", "NOBODY", "--out", "OUT"),
])  # fmt: skip
def test_a_number_is_told_with_its_asset_and_no_asset_is_wrong_use(words, store, tmp_path):
    np.save(tmp_path / "p.npy", np.zeros((3, 3), np.float32))
    places = {"STORE": store, "OUT": tmp_path / "out", "POINTS": tmp_path / "p.npy"}
    for name, said in (
        ("nobody", "has no asset 'nobody'"), ("be", "2 ids begin with 'be'"),
        ("BEAR.S", "did you mean bear.side?"),  # Capitals are forgiven in words.
    ):  # fmt: skip
        given = (places.get(word, name if word == "NOBODY" else word) for word in words)
        assert said in refused(*given)
    given = (places.get(word, "3" if word == "NOBODY" else word) for word in words)
    third = open_store(store).ids[3]
    assert f"row 3 is taken, {third}\n" in run(*given, code=None).stderr


@pytest.mark.parametrize(("words", "code", "said"), [
    ("evaluate --store nothing-here", 2, "nothing-here"),
    ("build-store --pixieverse . --slat .", 2, "Missing option '--out'"),
    ("align --out NEW", 2, "pixieverse.root: not given"),
    ("make-demo NEW --level 8", 2, "8 is not in the range"),
    ("make-demo d --assets 0", 2, "0 is not in the range"),
    ("info --colour", 2, "No such option '--colour'"),
    ("score STORE", 2, "Missing argument 'TRUTH_DIR'"),
    ("stats STORE --weight x", 2, "'x' is not one of 'voxel', 'asset'"),
    ("info FOLDER", 1, "FOLDER is not a slatprep store"),
    ("check-alignment --asset cuo --store STORE", 2, "did you mean cup?"),
    ("check-alignment --store STORE", 2, "say which assets"),
    ("check-alignment --asset cup --store STORE --picture NEW.jpg", 2, "ends in .png, .svg, .pdf"),
    ("report STORE --out s3://nowhere/p.html", 2, "expected a path of the local"),
    ("subset STORE --verdict good --out memory://s.zarr", 2, "gone when the command ends"),
    ("verify FOLDER", 1, "FOLDER is not a slatprep store"),
    ("train STORE --out NEW --learning-rate nan", 2, "nan is no finite number"),
    ("train STORE --out NEW --learning-rate inf", 2, "inf is no finite number"),
    ("train STORE --out NEW --max-ambiguity nan", 2, "nan is no finite number"),
    ("make-demo NEW --habitual-share nan", 2, "nan is no finite number"),
    ("measure-errors STORE --seed -1", 2, "-1 is not in the range"),
    ("train STORE --out NEW --seed -1", 2, "-1 is not in the range"),
    ("align --pixieverse SLAT --slat GRIDS --out NEW", 2, "swapped: grids lie below GRIDS"),
    ("build-store --pixieverse SLAT --slat GRIDS --out NEW", 2, "swapped: grids lie below"),
    # A variable of the shell that is not set, and a name that is too long.
    ("stats STORE --csv=", 2, "Invalid value for '--csv': is empty; expected a path"),
    ("build-store --pixieverse= --slat SLAT --out NEW", 2, "'--pixieverse': is empty"),
    ("build-store --pixieverse GRIDS --slat SLAT --out NEW --manifests=", 2, "is empty"),
    ("subset STORE --asset cup --out=", 2, "'--out': is empty"),
    (f"report STORE --out NEW{300 * 'w'}", 1, "File name too long"),
    ("train STORE --out NEW --all-sizes --size small", 2, "both say which sizes"),
    # Numbers beyond reason, and words in place of numbers.
    ("build-store --rehash nan", 2, "Invalid value for '--rehash'"),
    (f"measure-errors --seed {10**26}", 2, "Invalid value for '--seed'"),
    (f"train --batch-size {10**22}", 2, "Invalid value for '--batch-size'"),
    (f"extract-slat --seed {2**32}", 2, "Invalid value for '--seed'"),
    ("list --max-confidence nan", 2, "Invalid value for '--max-confidence'"),
    ("build-store --jobs two", 2, "'two' is no whole number; expected a whole number of"),
    ("make-demo d --level x", 2, "expected a whole number of at least 0 and at most 7"),
    ("simulate --height x", 2, "'x' is no number; expected a number of at least 0"),
    ("build-store --jobs 0", 2, "0 is not in the range x>=1"),
    ("build-store --jobs 2 --scheduler tcp://h:1 --out NEW", 2, "--jobs is for this machine"),
    ("check-alignment --worst 2 --store STORE --picture NEW.png", 2, "need a folder"),
    ("stats STORE --picture NEW.gif", 2, "none of .png, .svg, .pdf"),
    ("stats STORE --category boat", 2, "boat"),
    ("subset STORE --verdict failed --out NEW", 2,
     "no asset of STORE is chosen; expected one at least: there are 5 good"),
    ("build-store --slat SLAT --out NEW --pixieverse ROOT/pixeverse", 2,
     "did you mean ROOT/pixieverse?"),
    ("build-store --slat SLAT --out NEW --pixieverse ROOT/absent", 2, "option --pixieverse: "),
    ("build-store --slat SLAT --out NEW --pixieverse ROOT/absent", 2,
     "ROOT does, and holds the folders "),
    ("info ROOT/pixeverse", 2, "ROOT/pixeverse does not exist; did you mean ROOT/pixieverse?"),
    ("build-store --config STORE/zarr.jsn", 2, "did you mean STORE/zarr.json?"),
    ("build-store --config ROOT/pixeverse", 2, "ROOT does, and holds the files "),
    ("list STORE/zarr.jsn", 2, "STORE does, and holds the folders asset, "),
    ("info ROOT/.pixieverse", 2, "did you mean ROOT/pixieverse?"),
])  # fmt: skip
def test_what_ends_a_command_is_told_as_json(words, code, said, store, mixed, tmp_path):
    places = {"STORE": store, "FOLDER": tmp_path, "NEW": tmp_path / "new"}
    places |= {"SLAT": mixed.root / "slat", "GRIDS": mixed.root / "pixieverse", "ROOT": mixed.root}
    for word, place in places.items():
        words, said = words.replace(word, str(place)), said.replace(word, str(place))
    command, *rest = words.split()
    result = run(command, "--json", *rest, code=code)
    told = json.loads(result.stdout)
    assert said in told["error"] and said in " ".join(result.stderr.split())
    assert (told["command"], told["ok"]) == (command, False)
    assert list(tmp_path.iterdir()) == []


def test_a_lost_file_of_a_column_is_named_and_one_never_written_is_fine(copy):
    written = {"asset/category/c/0", "asset/verdict/c/0"} & digests_in(open_store(copy)).keys()
    assert written == {"asset/verdict/c/0"}  # All categories are empty.
    (copy / "asset/verdict/c/0").unlink()
    for words in (("info",), ("list",), ("stats",), ("diff", copy)):
        told = refused(words[0], copy, *words[1:], code=1)
        assert f"{copy}/asset/verdict/c/0: is missing (was the store replaced? Open" in told


def test_what_is_absent_is_told_by_how_far_its_path_leads(tmp_path, monkeypatch):
    (tmp_path / "dang").symlink_to("nowhere")
    (tmp_path / "far").symlink_to(os.fsdecode(b"\xff"))
    (tmp_path / ".cups").mkdir()
    nowhere, no_unicode = "is a link that leads nowhere (nowhere)", tmp_path / "\ufffd"
    for path, said in [
        ("dang", f"{tmp_path / 'dang'} does not exist; {tmp_path / 'dang'} {nowhere}"),
        ("dang/x", f"{tmp_path / 'dang/x'} does not exist; {tmp_path / 'dang'} {nowhere}"),
        ("far", "is a link that leads nowhere (\ufffd)"),
        ("a" * 300, "cannot be looked for"),
        ("dung", f"{tmp_path} does, and holds the folders (none)"),
        ("cups", f"{tmp_path} does, and holds the folders (none)"),
        ("\udcff", f"{no_unicode} does not exist"),
    ]:
        error = " ".join(run("info", "--json", str(tmp_path / path), code=2).stderr.split())
        assert said in error
    for k in range(1000):
        (tmp_path / f"{k:03}").mkdir()
    told = " ".join(run("info", str(tmp_path / "absent"), code=2).stderr.split())
    assert f"{tmp_path} does, and holds the folders 000, 001, " in told
    assert told.endswith(" and others")
    (gone := tmp_path / "gone").mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert "cannot be looked for" in run("info", "x", code=2).stderr
    stored = ("build-store", "--pixieverse", "a", "--slat", "b", "--out", str(tmp_path / "s.zarr"))
    assert "working folder" in run(*stored, code=1).stderr


def test_a_misspelt_command_is_told_with_the_one_meant():
    assert "did you mean check-alignment?" in refused("chek-alignment", "--worst", "3")
    refused("xyzzy")


def test_no_default_is_printed_of_an_option_that_is_empty_without_it():
    assert '""' not in run("publish", "--help").stdout


def test_names_that_were_looked_for_are_told_once(make_dataset, tmp_path):
    dataset = make_dataset(*"abc")
    for name in "ab":
        (dataset.root / "slat" / f"{name}.npz").unlink()
    told = refused("build-store", *dataset.sides, "--out", tmp_path / "s.zarr", code=1)
    assert "a: " in told and "no SLAT for id 'b'" in told
    assert told.count("looked for") == 1


def test_a_category_with_the_name_of_another_row_is_in_quotes(store, copy, tmp_path):
    names = ("all", "class jelly", "class jelly", "mean of the training voxels")
    for row, name in enumerate(names):
        rewrite(copy, "asset/category", row, name)
    predictions, table = write_predictions(tmp_path / "p", store), tmp_path / "scores.csv"
    lines = {
        "info": ("info", copy),
        "stats": ("stats", copy),
        "evaluate": ("evaluate", predictions, "--store", copy, "--split", "all", "--csv", table),
    }
    told = {name: run(*line).stdout for name, line in lines.items()}
    for text in told.values():
        rows = [line for line in text.splitlines() if line.lstrip().startswith(("all ", '"all" '))]
        assert {row.split()[0] for row in rows} == {"all", '"all"'}
    assert '\n"class jelly" ' in told["stats"] and "\nclass jelly " in told["stats"]
    assert '\n"mean of the training voxels" ' in told["evaluate"]
    assert table.read_text().count("all") == 2


@pytest.mark.parametrize("command", ["list", "subset"])
def test_a_category_that_no_asset_has_is_told_with_the_one_meant(command, of_kinds, tmp_path):
    out = ("--out", tmp_path / "x.zarr") if command == "subset" else ()
    assert "expected vessels" in refused(command, of_kinds, "--category", "vessel", *out)
    run(command, of_kinds, "--category", "vessels", *out)


def test_a_table_of_categories_is_asked_for_unless_it_was_given(store, of_kinds):
    for path, given in ((store, False), (of_kinds, True)):
        (line,) = (x for x in run("info", path).stdout.splitlines() if x.startswith("unknown:"))
        assert ("does not have their ids" in line) == given
        assert ("[pairing]" in line) != given
    assert "no category is known" in refused("list", store, "--category", "cup")
    every, unknown = (run("list", store, *of).stdout for of in ((), ("--category", "(unknown)")))
    assert unknown == every


def test_advice_names_the_store_as_it_was_typed(store, capsys):
    overview = overview_of(open_store(store))
    total = replace(overview.total, verdicts={"good": 0, "doubtful": 1, "failed": 0}, ambiguous=1)
    show_quality(Output(), replace(overview, total=total), place_of("s3://b/x.zarr"), advise=False)
    lines = capsys.readouterr().out.splitlines()
    advice = {line.partition(":")[0]: line.split()[1:] for line in lines if " slatprep " in line}
    assert advice["why"] == ["slatprep", "list", "s3://b/x.zarr", "--verdict", "doubtful"]
    words = ["slatprep", "check-alignment", "--ambiguous", "--store", "s3://b/x.zarr"]
    assert advice["look"] == words


def test_quiet_commands_that_make_something_print_nothing(store, tmp_path):
    made = run("subset", store, "--asset", "cu", "--out", tmp_path / "cup.zarr", "-q")
    assert made.output == "" and open_store(tmp_path / "cup.zarr").ids == ["cup"]
    assert run("report", tmp_path / "cup.zarr", "-q").output == ""
    assert "cup" in run("list", tmp_path / "cup.zarr", "-q").stdout
    words = ("export", store, "--format", "npz", "--out", tmp_path / "n", "-q")
    assert document(*words)["assets"] == 5
    told = run("verify", tmp_path / "cup.zarr").stderr
    assert "1 asset," in told and "0 sources" not in told  # In the singular.


def test_sources_of_a_joined_store_are_said_to_lie_apart(store, mixed, tmp_path):
    other = Dataset(tmp_path / "other").having("elk", seed=8)
    pixieverse = other.root / "pixieverse"
    build_store(other.parameters(), tmp_path / "elk.zarr")
    both = tmp_path / "both.zarr"
    run("concat", store, tmp_path / "elk.zarr", "--out", both)
    assert open_store(both).ids == [*open_store(store).ids, "elk"]
    told = refused("verify", both, "--sources", code=1)
    assert len(told.splitlines()) == 1
    assert "sources lie apart" in told and str(pixieverse) in told
    pixieverse.rename(tmp_path / "moved")
    moved = refused("verify", tmp_path / "elk.zarr", "--sources", code=1)
    assert f"its sources are not at {pixieverse} any more; name the roots" in moved


def test_documents_begin_alike_and_say_which_store_as_it_was_typed(store, monkeypatch):
    monkeypatch.chdir(store.parent)
    typed = store.name
    told = {name: document(name, typed) for name in ("info", "list", "verify", "stats")}
    words = ("--worst", "1", "--picture", "none", "--store", typed)
    told["check-alignment"] = document("check-alignment", *words)
    told["diff"] = document("diff", typed, typed)
    for command, one in told.items():
        assert list(one)[:3] == ["command", "version", "ok"]
        assert (one["command"], one["ok"]) == (command, True)
        assert one.get("store", one.get("a")) == one.get("store", one.get("b")) == typed
    assert run("info", store).stdout.startswith(f"Store {store}\n")
    monkeypatch.chdir(store)  # where a picture called none could not be written
    assert document("check-alignment", *words[:4], ".")["assets"][0]["picture"] is None
    files = sum(file.is_file() for file in store.rglob("*"))
    assert told["info"]["files"] == told["verify"]["files"] == files


@pytest.mark.parametrize("denied", ["zarr.json", "asset/fitness/c/0", "voxel"])
def test_a_store_that_may_not_be_read_is_neither_damaged_nor_another_folder(denied, copy, mixed):
    (copy / denied).chmod(0)
    script = (
        f"{BOUND_BY_PERMISSIONS}\nimport json, sys\nfrom slatprep.cli import main\n"
        "for words in json.loads(sys.argv[1]):\n"
        "    sys.argv = ['slatprep', *words]\n"
        "    try: main()\n"
        "    except SystemExit as end: print('#' * 9, end.code, file=sys.stderr)\n"
    )
    into = ("build-store", *mixed.sides, "--out", copy)
    lines = [[str(word) for word in words] for words in (("info", copy), ("verify", copy), into)]
    *told, rest = python("-c", script, json.dumps(lines)).stderr.split("######### 1\n")
    assert len(told) == len(lines) and rest == ""
    for said in told:
        assert "(Permission denied)" in said and str(copy / denied) in said
        assert "is not a slatprep store" not in said and "Copy the store again" not in said


def test_a_folder_that_may_be_entered_and_not_read_hides_no_store(store, tmp_path):
    (folder := tmp_path / "home" / "own").mkdir(parents=True)
    folder.parent.chmod(0o111)
    script = f"{BOUND_BY_PERMISSIONS}\nfrom slatprep.cli import main; main()"
    python("-c", script, "subset", store, "--asset", "cup", "--out", folder / "s.zarr")
    assert open_store(folder / "s.zarr").ids == ["cup"]


def test_a_store_may_be_named_by_the_folder_one_is_in(copy, monkeypatch):
    told = run("list", copy).stdout
    for folder, name in ((copy, "."), (copy / "asset", "..")):
        monkeypatch.chdir(folder)
        assert run("list", name).stdout == told.replace(str(copy), name)
        assert len(open_store(name).column("fitness")) == 5
        assert "is a store" in refused("subset", name, "--asset", "cup", "--out", name)
        assert document("report", name)["path"] == str(copy.with_suffix(".html"))
    assert document("verify", "..")["findings"] == []


def test_ctrl_c_says_what_is_kept_and_how_to_go_on(store, mixed, tmp_path, monkeypatch):
    def built(*_: object, progress: Callable[[int, int], None], **__: object) -> None:
        progress(0, 3)
        progress(2, 3)
        raise KeyboardInterrupt

    def trained(*_: object, progress: Callable[[EpochRecord], None], **__: object) -> None:
        progress(EpochRecord(4, 1e-3, 0.5, 0.6, 0.7, 0.8))
        raise KeyboardInterrupt

    def made(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("slatprep.pipeline.dataset.build_store", built)
    monkeypatch.setattr("slatprep.learn.train.train", trained)
    monkeypatch.setattr("slatprep.demo.make_demo", made)
    stopped = refused("build-store", *mixed.sides, "--out", tmp_path / "new.zarr", code=130)
    assert "2 of 3 assets are done and kept; the same command goes on from there" in stopped
    stopped = refused("train", store, "--out", tmp_path / "run", "--keep", "last", code=130)
    assert "epochs up to 4 are kept, and the steps since then but for the last 30 s" in stopped
    assert "epoch 5" not in stopped  # Epoch 4 may have been the last.
    assert "nothing was replaced" in refused("make-demo", tmp_path / "demo", code=130)


# -- disks ----------------------------------------------------------------------


@pytest.mark.parametrize(("words", "fault", "said"), [
    *((words, no_room, r"(cata.*\n)?.* cannot be written to .*No space left on device.*ake room.*")
      for words in ("report --out", "describe --out", "check-alignment --asset ant --picture")),
    ("report --out", Mock(side_effect=MemoryError),
     re.escape("slatprep: error: memory ran out; run where more is free, or with fewer --jobs")),
])  # fmt: skip
def test_a_full_disk_or_memory_is_a_line(store, tmp_path, monkeypatch, words, fault, said):
    monkeypatch.setattr(atomic, "flush", fault)
    line = refused(*words.split(), tmp_path / "result.png", store, code=1)
    assert re.fullmatch(rf"{said}\n", line)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_takes_nothing_is_a_line(store):
    pytest.importorskip("torch")
    train = ("train", store, "--out", NOWHERE, "--epochs", 1, "--size", "small")
    for words in (("make-demo", NOWHERE, "--assets", 1), train):
        assert "cannot be written to" in refused(*words, code=1)


# -- where `verify` looks for records -------------------------------------------


def test_records_of_its_own_build_are_found(mixed_build, deformed_build, tmp_path, monkeypatch):
    """Where make leaves them, too; those of another build are not taken."""
    monkeypatch.chdir(tmp_path)
    store = Path(shutil.copytree(str(mixed_build.store), "data/demo.zarr"))
    shutil.copytree(deformed_build.records.parent, "manifests/build/demo")
    assert "records: none beside the store" in run("verify", store).output
    assert "no records of data/demo.zarr found" in run("report", store).output
    Path("manifests/build/demo").rename("data/demo.manifests")
    for command in ("verify", "report"):
        said = " ".join(run(command, store, code=1).output.split())
        assert "records with --manifests, or build again" in said
    shutil.copytree(mixed_build.records.parent, "manifests/build/demo")
    for others in (True, False):
        if not others:
            shutil.rmtree("data/demo.manifests")
        assert "records: manifests/build/demo" in run("verify", store).output
        printed = run("report", store).output
        assert "page:" in printed and "no records" not in printed

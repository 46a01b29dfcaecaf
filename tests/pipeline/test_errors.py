"""Decoys of a real store: drawn by ids and size, aligned once, with builds too, told in words."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import document, run
from support.made_store import edit_record, rewrite
from support.trees import copied, tree

from slatprep import Store, StoreError, open_store
from slatprep.inspect.pictures.statistics import draw_errors
from slatprep.pipeline import decoys
from slatprep.pipeline.dataset import BuildSummary, build_store
from slatprep.pipeline.decoys import allowed_decoys, draw_decoys, measure_errors, unrelated_objects
from slatprep.pipeline.measured import measured_errors, told_of
from slatprep.store.records import ERRORS, manifests_of


@pytest.fixture(scope="module")
def store(mixed_build: BuildSummary, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Copy a store with its records, beside which decoys are kept."""
    path = tmp_path_factory.mktemp("errors") / "s.zarr"
    return open_store(copied(Path(str(mixed_build.store)), path))


def objects_of(store: Store) -> dict[str, str]:
    return dict(zip(store.ids, map(str, store.column("object_id")), strict=True))


def test_decoys_are_of_other_objects_and_are_aligned_once(store):
    aligned: list[tuple[int, ...]] = []
    first = measure_errors(store, decoys=3, seed=1, progress=lambda *at: aligned.append(at))
    objects = objects_of(store)
    assert len(first.decoys) == 3
    assert aligned == [(1, 3), (2, 3), (3, 3)]
    assert all(objects[one.grid] != objects[one.slat] for one in first.decoys)
    text = (manifests_of(store.path) / ERRORS).read_bytes()
    measure_errors(store, decoys=3, seed=1, progress=lambda *at: aligned.append(at))
    assert len(aligned) == 3, "they were taken over"
    assert (manifests_of(store.path) / ERRORS).read_bytes() == text
    assert told_of(store) == first.sentences()


def test_decoys_are_drawn_by_ids_and_seed_with_the_slat_of_the_nearest_size(store):
    keys, own = dict.fromkeys(store.ids, ""), unrelated_objects(store, [""] * len(store))
    few, more, drawn = (draw_decoys(store, keys, own, count, 1) for count in (2, 4, 100))
    assert drawn[:4] == more and more[:2] == few
    of_another_seed = draw_decoys(store, keys, own, 100, 2)
    assert [one.grid for one in of_another_seed] != [one.grid for one in drawn]
    sizes = dict(zip(store.ids, np.diff(store.offsets).tolist(), strict=True))
    objects = objects_of(store)
    for one in drawn:
        others = [other for other in store.ids if objects[other] != objects[one.grid]]
        nearest = min(abs(sizes[other] - sizes[one.grid]) for other in others)
        assert abs(sizes[one.slat] - sizes[one.grid]) == nearest


def test_pairs_that_share_a_slat_or_a_grid_are_no_decoys(make_dataset, tmp_path):
    dataset, out = make_dataset("a", "b", "c", "d"), tmp_path / "s.zarr"
    slats, grid = dataset.root / "slat", dataset.assets["b"].grid
    (slats / "b.npz").write_bytes((slats / "a.npz").read_bytes())
    dataset.write_grid("c", grid)
    build_store(dataset.parameters(), out)
    pairs = {(one.grid, one.slat) for one in measure_errors(open_store(out), decoys=9).decoys}
    # Those that are related through others count as one object, which meets no other one twice.
    of = {"a": "abc", "b": "abc", "c": "abc", "d": "d"}
    assert sorted((of[grid], of[slat]) for grid, slat in pairs) == [("abc", "d"), ("d", "abc")]
    shared = "share the same SLAT (a = b)"
    assert shared in run("info", out).output and shared in run("list", out).output
    run("report", out, "--out", tmp_path / "page.html")
    assert shared in (tmp_path / "page.html").read_text()
    run("subset", out, "--asset", "a", "--asset", "b", "--out", tmp_path / "two.zarr")
    said = run("measure-errors", tmp_path / "two.zarr", code=1).output
    assert "decoys need two objects that share neither grid nor SLAT" in said


def test_each_object_has_a_decoy_before_any_has_two(make_dataset, tmp_path):
    dataset, out = make_dataset("a", "b", "c"), tmp_path / "s.zarr"
    dataset.add("d", 3, views=("front", "side", "top", "back", "left"))
    build_store(dataset.parameters(), out)
    store = open_store(out)
    objects = objects_of(store)
    own = unrelated_objects(store, decoys._evidence_of(store)[1])
    for seed in range(6):
        drawn = draw_decoys(store, dict.fromkeys(store.ids, ""), own, 99, seed)
        assert sorted(objects[one.grid] for one in drawn[:4]) == ["a", "b", "c", "d"]
        met = [(objects[one.grid], objects[one.slat]) for one in drawn]
        assert len(set(met)) == len(met) == 3 + 3
        assert {other for own, other in met if own == "d"} == {"a", "b", "c"}


def test_a_disk_that_cannot_be_written_is_told_before_decoys_are_aligned(store, monkeypatch):
    monkeypatch.setattr(decoys, "align_decoy", None)
    monkeypatch.setattr("os.access", lambda path, mode: mode != os.W_OK)  # As on a read-only disk.
    with pytest.raises(StoreError, match=r"cannot be written to; expected a folder for .*decoys"):
        measure_errors(store)


def test_a_store_with_figures_of_another_version_is_told(mixed_build, tmp_path):
    out = copied(Path(str(mixed_build.store)), tmp_path / "s.zarr")
    for row in range(5):
        edit_record(out, row, lambda one: one["judgement"]["evidence"].pop())
    with pytest.raises(StoreError, match="hold other evidence; build it again"):
        measure_errors(open_store(out))
    rewrite(out, "asset/record", 0, "[]")
    with pytest.raises(StoreError, match="cannot be read; run `slatprep verify`"):
        measure_errors(open_store(out))


def test_few_assets_are_said_to_be_few_and_the_picture_is_drawn(store):
    found = measure_errors(store, decoys=3, seed=1)
    assert "3 of 3 decoys are called good, too" in found.sentences()[0], "all are the same L"
    others = tuple(replace(one, verdict="failed") for one in found.decoys)
    few = replace(found, decoys=others, good=4, good_wrong=0.1, good_wrong_range=(0.0, 0.3))
    needed = "50 objects and decoys of 40 are needed"
    too_few = f"3 decoys of 5 assets are too few to estimate errors: {needed}"
    assert few.sentences() == [too_few]
    likely = "likely at most 1 of the 4 called good show another object, and at most 50.0% of all "
    for most, told in ((0.5, [likely + "assets"]), (0.501, [])):
        assert replace(few, wrong_share_range=(0.0, most)).sentences() == [*told, too_few]
    enough = replace(few, refitted=True)
    assert "about 0 show another object (0 to 0; measured on 3 decoys" in enough.sentences()[0]
    passed = replace(others[0], grid="cup", slat="mug", verdict="good")
    assert replace(enough, decoys=(passed, *others * 2)).sentences() == [
        "of the 4 called good about 0 show another object (0 to 0; measured on 7 decoys of this "
        "dataset)",
        enough.sentences()[1],
        "called good of 7 decoys: 1, such as the grid of cup with the SLAT of mug",
    ]
    assert enough.tells and not few.tells and not replace(found, refitted=True).tells
    picture = draw_errors(found, store.name)
    assert picture.startswith(b"\x89PNG")
    assert picture == draw_errors(found, store.name)


def test_commands_tell_what_was_measured_and_where_that_is_of_before(store, tmp_path):
    options = ("--decoys", 3, "--seed", 1, "--picture", tmp_path / "errors.svg")
    found = document("measure-errors", store.path, *options)
    assert found["decoys"] == 3 and found["assets"] == len(store)
    assert set(found["errors"]) <= set(store.ids)
    assert (tmp_path / "errors.svg").read_text().startswith("<?xml")
    measured, asset_id = measured_errors(store.path), store.ids[0]
    for command in ("info", "list"):
        output = run(command, store.path).output
        assert all(f"wrong pairs: {sentence}" in output for sentence in measured.sentences())
    assert "wrong pairs" not in run("list", store.path, "--verdict", "failed").output
    words = ("check-alignment", "--asset", asset_id, "--store", store.path, "--picture", "none")
    assert "the probability of another object" not in run(*words).output
    assert "another_object" not in document(*words)["assets"][0]
    told = run("measure-errors", store.path, *options).output
    assert "Assets that can be kept" not in told and "Most likely another" not in told
    others = tuple(replace(one, verdict="failed") for one in measured.decoys)
    telling = replace(measured, decoys=others, refitted=True)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("slatprep.pipeline.measured.measured_errors", lambda _: telling)
        assert telling.of_asset(asset_id) in run(*words).output
        (found,) = document(*words)["assets"]
    assert found["another_object"] == measured.errors.get(asset_id, 0.0)
    assert "is below 0.1%" in replace(measured, errors={}).of_asset(asset_id)
    assert "is 25.0%" in replace(measured, errors={asset_id: 0.25}).of_asset(asset_id)

    file = manifests_of(store.path) / ERRORS
    file.write_text(json.dumps(json.loads(file.read_bytes()) | {"build": "another"}))
    assert told_of(store)[:-1] == measured.sentences()
    assert told_of(store)[-1].startswith("measured before the last update, when there were 5")
    kept = json.loads(file.read_bytes())
    gone = [{**one, "grid": f"gone-{one['grid']}"} for one in kept["decoys"]]
    file.write_text(json.dumps(kept | {"decoys": gone}))
    assert told_of(store)[0].startswith("not measured; ")
    file.write_text(json.dumps(kept))
    file.write_text("{")
    assert measured_errors(store.path) is None
    assert told_of(store) == [
        "not measured; `slatprep measure-errors` does it, and so does a build of 50 objects or more"
    ]


OBJECTS = ("ant", "bear", "cup", "dog", "eel", "fox")


@pytest.fixture
def few_suffice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let six assets be enough, and every second one have a decoy."""
    monkeypatch.setattr(decoys, "LEAST_TARGETS", 4)
    monkeypatch.setattr("slatprep.pipeline.measured.LEAST_TARGETS", 4)
    monkeypatch.setattr(decoys, "EVERY", 2)


@pytest.mark.parametrize(("assets", "decoys"), [
    (19, 0), (20, 1), (799, 39), (800, 40), (2_459, 40), (2_460, 41), (12_000, 200),
])  # fmt: skip
def test_how_many_decoys_a_build_may_align(assets, decoys):
    assert allowed_decoys(assets) == decoys


@pytest.mark.usefixtures("few_suffice")
def test_a_build_measures_errors_the_same_for_any_number_of_jobs(make_dataset, tmp_path):
    parameters = make_dataset(*OBJECTS).parameters()
    one, two, none = (tmp_path / f"{name}.zarr" for name in ("one", "two", "none"))
    build_store(parameters, one)
    build_store(parameters, two, jobs=2)
    build_store(parameters, none, decoys=0)
    assert len(measured_errors(one).decoys) == len(OBJECTS) // decoys.EVERY
    assert (manifests_of(one) / ERRORS).read_bytes() == (manifests_of(two) / ERRORS).read_bytes()
    assert tree(one) == tree(two) == tree(none)
    assert not (manifests_of(none) / ERRORS).exists()
    assert told_of(open_store(none))[0].endswith("`slatprep measure-errors` does it")


@pytest.mark.usefixtures("few_suffice")
def test_stores_with_one_folder_of_records_keep_their_own_errors(make_dataset, tmp_path):
    parameters = make_dataset(*OBJECTS).parameters()
    one, two, link = (tmp_path / name for name in ("demo.zarr", "demo", "link.zarr"))
    build_store(parameters, one)
    build_store(replace(parameters, name="two"), two, manifests=tmp_path / "records")
    link.symlink_to("demo")
    for store in (one, two, link):
        assert measured_errors(store).build == open_store(store).about.manifest
    assert measured_errors(one) != measured_errors(two)


def align_decoy(*task: object) -> None:
    raise ValueError("singular")


def run_unordered(function: object, tasks: Any, jobs: object, died: Any) -> Any:
    return (died(*task) for task in tasks)


@pytest.mark.usefixtures("few_suffice")
@pytest.mark.parametrize(
    ("fault", "said"), [(align_decoy, "singular"), (run_unordered, "killed its worker process")]
)
def test_a_decoy_not_aligned_costs_no_build(make_dataset, tmp_path, monkeypatch, fault, said):
    monkeypatch.setattr(decoys, fault.__name__, fault)
    summary = build_store(make_dataset(*OBJECTS).parameters(), tmp_path / "s.zarr")
    assert summary.complete
    assert summary.warnings[-1].startswith("errors were not measured")
    assert said in summary.warnings[-1] and "replaced" not in summary.warnings[-1]


@pytest.mark.usefixtures("few_suffice")
def test_a_fault_of_our_own_is_raised_though_there_is_a_store(make_dataset, tmp_path, monkeypatch):
    def faulty(*task: object) -> None:
        raise TypeError("not callable")

    monkeypatch.setattr(decoys, "align_decoy", faulty)
    with pytest.raises(TypeError):
        build_store(make_dataset(*OBJECTS).parameters(), tmp_path / "s.zarr")
    assert len(open_store(tmp_path / "s.zarr")) == len(OBJECTS)


@pytest.mark.usefixtures("few_suffice", "few_are_new")
def test_a_small_update_measures_nothing_and_a_larger_one_takes_decoys_over(make_dataset, tmp_path):
    out, dataset = tmp_path / "s.zarr", make_dataset(*OBJECTS)
    build_store(dataset.parameters(), out)
    first, text = measured_errors(out), (manifests_of(out) / ERRORS).read_bytes()
    verdicts = open_store(out).column("verdict").tolist()
    dataset.add("gnu", seed=9)
    build_store(dataset.parameters(), out)
    store = open_store(out)
    assert store.column("verdict").tolist()[:-1] == verdicts
    assert (manifests_of(out) / ERRORS).read_bytes() == text
    assert told_of(store)[-1].startswith("measured before the last update, when there were 6")
    other = dataset.parameters(align={"radius": 2.0})
    other_store = copied(out, tmp_path / "other.zarr")
    build_store(other, other_store, decoys=0)
    assert told_of(open_store(other_store))[0].startswith("not measured; ")
    for seed, name in enumerate(("hen", "ibis"), 8):
        dataset.add(name, seed)
    build_store(dataset.parameters(), out)
    after = measured_errors(out)
    assert after.build == open_store(out).about.manifest != first.build
    # Not by their evidence, in which two NaN are not equal.
    old = {(one.grid, one.slat, one.keys) for one in first.decoys}
    new = [one for one in after.decoys if (one.grid, one.slat, one.keys) not in old]
    assert len(new) <= 1, "two assets were aligned"
    assert len(after.decoys) - len(new) >= 1

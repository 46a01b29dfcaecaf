"""Decoys with each build: few, the same for any number of jobs, and no part of the store."""

from __future__ import annotations

import pytest
from support.trees import tree

from slatprep.pipeline import decoys
from slatprep.pipeline.dataset import build_store
from slatprep.pipeline.decoys import FILE, measured_errors, told_of
from slatprep.store import open_store
from slatprep.store.records import manifests_of

OBJECTS = ("ant", "bear", "cup", "dog", "eel", "fox")


@pytest.fixture
def few_suffice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let six assets be enough, and every second one have a decoy."""
    monkeypatch.setattr(decoys, "LEAST_TARGETS", 4)
    monkeypatch.setattr(decoys, "EVERY", 2)


@pytest.mark.usefixtures("few_suffice")
def test_a_build_measures_errors_the_same_for_any_number_of_jobs(make_dataset, tmp_path):
    parameters = make_dataset(*OBJECTS).parameters()
    one, two, none = (tmp_path / f"{name}.zarr" for name in ("one", "two", "none"))
    build_store(parameters, one)
    build_store(parameters, two, jobs=2)
    build_store(parameters, none, decoys=0)
    measured = measured_errors(one)
    assert measured is not None
    assert len(measured.decoys) == len(OBJECTS) // decoys.EVERY
    assert (manifests_of(one) / FILE).read_bytes() == (manifests_of(two) / FILE).read_bytes()
    assert tree(one) == tree(two) == tree(none)
    assert not (manifests_of(none) / FILE).exists()
    assert told_of(open_store(none))[0].startswith("not measured; run")


@pytest.mark.usefixtures("few_suffice", "few_are_new")
def test_a_small_update_measures_nothing_and_says_so(make_dataset, tmp_path):
    out = tmp_path / "s.zarr"
    dataset = make_dataset(*OBJECTS)
    build_store(dataset.parameters(), out)
    before, text = open_store(out), (manifests_of(out) / FILE).read_bytes()
    verdicts = dict(zip(before.ids, map(str, before.column("verdict")), strict=True))
    dataset.add("gnu", seed=9)
    build_store(dataset.parameters(), out)
    after = open_store(out)
    assert len(after) == len(before) + 1
    now = dict(zip(after.ids, map(str, after.column("verdict")), strict=True))
    assert {one: now[one] for one in verdicts} == verdicts
    assert (manifests_of(out) / FILE).read_bytes() == text
    assert told_of(after)[-1].startswith("measured before the last update, when there were 6")


@pytest.mark.usefixtures("few_suffice", "few_are_new")
def test_a_larger_update_takes_the_decoys_of_before_over(make_dataset, tmp_path):
    out = tmp_path / "s.zarr"
    dataset = make_dataset(*OBJECTS)
    build_store(dataset.parameters(), out)
    before = measured_errors(out)
    for seed, name in enumerate(("gnu", "hen"), 8):
        dataset.add(name, seed)
    build_store(dataset.parameters(), out)
    after = measured_errors(out)
    assert before is not None
    assert after is not None
    assert after.build == open_store(out).about.manifest != before.build
    # Not by their evidence, in which two NaN are not equal.
    old = {(one.grid, one.slat, one.keys) for one in before.decoys}
    new = [one for one in after.decoys if (one.grid, one.slat, one.keys) not in old]
    assert len(new) <= 1, "two assets were aligned"
    assert len(after.decoys) - len(new) >= 1


def test_of_few_assets_there_are_no_decoys_and_that_is_said(undisturbed):
    _, out = undisturbed
    assert measured_errors(out) is None
    assert told_of(open_store(out)) == ["not measured; decoys need 50 assets"]

"""Splits by rules and by files of ids."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slatprep import ConfigError, InputError
from slatprep.readers.splits import (
    Assignment,
    Shares,
    assign_splits,
    pixie_test_objects,
    split_objects,
)

OBJECTS = {f"{k:032x}": ("tree", "rocks", "")[k % 3] for k in range(60)}
SOME = sorted(OBJECTS)[:6]


@pytest.mark.parametrize("count", [1, 2, 9, 10, 11, 157, 1577])
def test_pixie_s_rule_is_torch_s_random_split(count):
    torch = pytest.importorskip("torch")
    ids = [f"{k:032x}" for k in range(count)]
    permutation = torch.randperm(count, generator=torch.Generator().manual_seed(42)).tolist()
    assert pixie_test_objects(reversed(ids)) == [ids[k] for k in permutation[int(0.9 * count) :]]


def test_pixie_s_rule_without_torch():
    # The last 3 of torch.randperm(30, generator=torch.Generator().manual_seed(42)), torch 2.13.
    letters = [f"{k:02d}" for k in range(30)]
    assert pixie_test_objects(letters) == ["05", "24", "03"]
    assert len(pixie_test_objects(OBJECTS)) == 6


@pytest.mark.parametrize("shares", [Shares(), Shares(0.5, 0.25, 0.25), Shares(1.0, 0.0, 0.0)])
def test_what_no_rule_tests_on_is_parted_by_the_hash(shares):
    trees = {name for name, category in OBJECTS.items() if category == "tree"}
    for by, test in (("pixie", set(pixie_test_objects(OBJECTS))), ("category:tree", trees)):
        splits = assign_splits(by, OBJECTS, shares).splits
        assert splits.keys() == OBJECTS.keys()
        assert {name for name, split in splits.items() if split == "test"} == test
        train = shares.train / (shares.train + shares.val)
        rest = split_objects(OBJECTS.keys() - test, Shares(train, 1 - train, 0.0))
        assert {name: split for name, split in splits.items() if split != "test"} == rest


def test_a_path_is_a_file_even_if_it_is_called_as_a_rule(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("pixie").write_text("\n".join(SOME))
    splits = assign_splits(Path("pixie"), OBJECTS).splits
    named = {name for name, split in splits.items() if split == "test"}
    assert named == set(SOME)


def test_a_category_that_is_not_there_is_named():
    with pytest.raises(ConfigError, match="'cars'; expected one of: rocks, tree"):
        assign_splits("category:cars", OBJECTS)


def test_shares_without_training_are_refused():
    with pytest.raises(ConfigError, match="nothing to train"):
        assign_splits("pixie", OBJECTS, Shares(0.0, 0.0, 1.0))
    with pytest.raises(ConfigError, match="add up to 1"):
        Shares(math.nan, 0.5, 0.5)


def written(path: Path, ids: Any) -> str:
    if path.suffix == ".npy":
        np.save(path, ids)
    elif isinstance(ids, bytes):
        path.write_bytes(ids)
    else:
        path.write_text(json.dumps(ids))
    return str(path)


@pytest.mark.parametrize(("name", "ids"), [
    ("test.json", SOME),
    ("test.npy", np.array(SOME)),
    ("bytes.npy", np.array(SOME, "S32")),
    ("test.txt", "\n".join(SOME).encode()),
    ("windows.txt", b"\xef\xbb\xbf" + "\r\n\r\n  ".join(SOME).encode() + b"\r\n"),
])  # fmt: skip
def test_a_single_list_is_what_is_tested_on(tmp_path, name, ids):
    found = assign_splits(written(tmp_path / name, ids), OBJECTS)
    assert found.lists()["test"] == SOME
    assert found.splits.keys() == OBJECTS.keys()
    assert (found.unknown, found.unlisted) == ((), ())


def test_lists_are_taken_as_they_are(tmp_path):
    lists = {"train": [SOME[0], "nobody", "nobody"], "test": [SOME[1], SOME[1], "view"]}
    path = written(tmp_path / "splits.json", lists)
    found = assign_splits(path, OBJECTS, assets={"view": SOME[2]})
    assert found.lists() == {"train": [SOME[0]], "val": [], "test": SOME[1:3]}
    assert found.unknown == ("nobody",)
    assert found.unlisted == tuple(sorted(OBJECTS)[3:])
    # What a run keeps is such a file, and says the same.
    kept = written(tmp_path / "kept.json", found.lists())
    assert assign_splits(kept, OBJECTS) == Assignment(found.splits, (), found.unlisted)


def test_an_object_in_two_lists_is_an_error(tmp_path):
    path = written(tmp_path / "two.json", {"train": SOME, "test": ["view"]})
    with pytest.raises(ConfigError, match="'view' is in the lists train and test"):
        assign_splits(path, OBJECTS, assets={"view": SOME[4]})


@pytest.mark.parametrize(("name", "ids", "message"), [
    ("a.json", {"train": SOME, "valid": []}, "has a list 'valid'"),
    ("a.json", {"train": SOME[0]}, "holds str for train"),
    ("a.json", [SOME[0], 3], "'3', which is no text"),
    ("a.json", "x", "holds str for test"),
    ("a.json", b'{"test":[' + 1000 * b"[" + 1000 * b"]" + b"]}", "nested more deeply than 64"),
    ("a.json", {"train": [], "test": []}, "has no id"),
    ("a.json", b'{"test": ["x"], "test": ["y"]}', "the key 'test' occurs twice"),
    ("a.json", ["nobody"], "has none of the dataset's 60 objects"),
    ("a.npy", np.array(SOME, object), "Python objects"),
    ("a.npy", np.arange(4), "dtype"),
    ("a.npy", np.array([SOME]), "shape"),
    ("a.npy", np.array([], "U32"), "has no id"),
    ("a.npy", np.frombuffer(b"\xff\xff\xff\x7f", "U1"), "cannot be read"),
    ("a.npy", np.array([b"\xff"]), "cannot be read"),
    ("a.txt", b"\xff\xfe", "cannot be read"),
    ("a.txt", b" \n \n", "has no id"),
    ("missing.txt", None, "does not exist; expected hash, pixie, category:NAME, or a file"),
    ("a.json", b"[" * 100_000, "cannot be read"),
    ("large.txt", b"", "larger than"),
])  # fmt: skip
def test_files_that_are_no_lists_are_named(tmp_path, name, ids, message):
    path = tmp_path / name
    if ids is not None:
        written(path, ids)
    if name == "large.txt":
        os.truncate(path, 2**40)
    with pytest.raises(InputError, match=message) as caught:
        assign_splits(str(path), OBJECTS)
    assert str(path) in str(caught.value)

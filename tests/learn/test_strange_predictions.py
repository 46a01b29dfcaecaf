"""Stores, predictions and checkpoints of strangers: nothing outside, nothing huge, no traceback."""

import dataclasses
import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import zarr
from support.commands import refused
from support.made_store import rewrite
from support.memory import less_than
from support.predictions import right, write_one, write_predictions, zeros

from slatprep.errors import InputError
from slatprep.learn.decoder import make_decoder
from slatprep.learn.evaluate import evaluate_store
from slatprep.learn.metrics import OURS
from slatprep.learn.predict import checkpoint_state, load_checkpoint
from slatprep.learn.predictions import check_prediction, open_predictions, selection_of_run
from slatprep.learn.runs import LAST
from slatprep.learn.splits import assign_store
from slatprep.learn.train import TrainParameters, train
from slatprep.normalize import PIXIE_RANGES
from slatprep.readers.splits import Shares
from slatprep.store import open_store

SHARES = Shares(0.4, 0.3, 0.3)
SHORT = TrainParameters(size="tiny", epochs=1, shares=SHARES)
LONGER = dataclasses.replace(SHORT, epochs=2)


def test_nothing_is_read_or_written_outside(learn_copy, tmp_path):
    """The ids of the store lead out of any folder."""
    names = [f"../../../../up{k}" for k in range(4)] + [f"{tmp_path}/abs{k}" for k in range(5)]
    rewrite(learn_copy, "asset/id", slice(None), np.array(names, object))
    summary = train(learn_copy, tmp_path / "deep" / "runs" / "x", SHORT)
    written = list(summary.predictions.iterdir())
    assert written and all(path.name.startswith(("%2E%2E%2F", "%2F", "%2E.")) for path in written)
    assert {path.name for path in tmp_path.iterdir()} == {"s.zarr", "deep"}
    store, folder = open_store(learn_copy), tmp_path / "predictions"
    splits = assign_store(store, shares=SHARES).splits
    assert evaluate_store(summary.predictions, learn_copy, "test", splits=splits).missing == []

    folder.mkdir()
    np.savez(f"{store.ids[4]}.npz", **zeros(store.read(4, ("coords",))))
    with pytest.raises(InputError, match=r"no prediction of an asset.*ids of that split"):
        evaluate_store(folder, learn_copy, None)
    inside = store.ids[0].replace("/", "%2F").replace("..", "%2E.", 1)
    (folder / f"{inside}.npz").symlink_to(f"{store.ids[4]}.npz")
    with pytest.raises(InputError, match="out of its root"):
        evaluate_store(folder, learn_copy, None)


@pytest.mark.parametrize(("name", "value", "message"), [
    ("properties", "x", "has dtype"),
    ("properties", 1j, "has dtype"),
    ("properties", np.zeros((), [("a", "i4"), ("b", "i4")]), "has dtype"),
    ("properties", np.zeros((5, 3)), "properties has shape"),
    ("properties", np.nan, "not all finite"),
    ("properties", 7850.0, "properties reach 7850; expected normalised properties"),
    ("material", "1", "has dtype"),
    ("material", 0.5, "has class 0.5"),
    ("material", np.nan, "has class nan"),
    ("material", 9, "class 9"),
    ("logits", np.nan, "not all numbers"),
    ("logits", 1j, "has dtype"),
    ("logits", "5", "has dtype"),
    ("coords", np.nan, "has coordinate nan"),
    ("coords", 1.5, "has coordinate 1.5"),
    ("coords", 1, "occurs twice"),
    ("valid", False, "row 0 is not valid"),
    ("valid", 0.5, "has valid 0.5"),
    ("valid", np.nan, "has valid nan"),
    ("resolution", np.array(32), r"has a grid of 32\^3; expected 64\^3"),
    ("E", np.zeros(3), "expected properties"),
])  # fmt: skip
@pytest.mark.parametrize("form", ["npz", "hdf5", "zarr"])
def test_values_that_are_no_prediction_are_named(learn_store, tmp_path, name, value, message, form):
    count = open_store(learn_store).rows(0)[1]
    widths = {"properties": (3,), "material": (), "coords": (3,), "logits": (8,), "valid": ()}
    whole = {} if name == "E" else {"properties": np.zeros((count, 3))}
    as_it_is = isinstance(value, np.ndarray)
    whole[name] = value if as_it_is else np.full((count, *widths[name]), value)
    path = tmp_path / "p"
    write_one(path, form, "a", whole)
    if form == "zarr":
        message = rf"{message}|data_type is"
    with pytest.raises(InputError, match=message) as caught:
        evaluate_store(path, learn_store, None)
    assert f"{path}/a" in str(caught.value).replace(f"{path} [a", f"{path}/a")


def test_what_lies_beside_a_prediction_is_not_unpacked(learn_store, tmp_path):
    more = {"beside": np.array([{}], object)}
    write_predictions(tmp_path / "p", learn_store, lambda truth: zeros(truth) | more)
    for file in (tmp_path / "p").iterdir():
        with zipfile.ZipFile(file, "a") as archive:
            archive.writestr("worse.npy", b"no array")
    assert evaluate_store(tmp_path / "p", learn_store, None).missing == []


def test_zarr_predictions_of_any_cut_are_read(learn_store, tmp_path):
    store = open_store(learn_store)
    root = zarr.open_group(tmp_path / "p.zarr", mode="w")
    cuts: list[dict[str, Any]] = [
        {}, {"chunks": (100, 2)}, {"chunks": (128, 3), "shards": (1024, 3)},
        {"compressors": None}, {"compressors": zarr.codecs.BloscCodec()},
    ]  # fmt: skip
    whole: Any = {"write_empty_chunks": True}
    for row, asset_id in enumerate(store.ids):
        arrays = right(store.read(row, ("properties", "material")))
        group, values = root.create_group(asset_id), arrays["properties"]
        how = cuts[row % 5] | {"shape": values.shape, "dtype": "f4", "config": whole}
        group.create_array("properties", **how)[:] = values
        group.create_array("material", data=arrays["material"], config=whole)
    means = evaluate_store(tmp_path / "p.zarr", learn_store, None).methods[OURS].means
    assert list(means.values()) == [0.0, 0.0, 0.0, 0.0, 1.0]


def cut(*shape: float) -> dict[str, Any]:
    return {"chunk_grid": {"configuration": {"chunk_shape": list(shape)}}}


@pytest.fixture
def ones(tmp_path: Path) -> Any:
    """Make an array of ones (8, 3) cut in some way, and return its folder and what reads it."""

    def make(**cut: Any) -> tuple[Path, Any]:
        group = zarr.open_group(tmp_path / "p.zarr", mode="w").create_group("a")
        group.create_array("coords", shape=(8, 3), dtype="uint8", **cut)[:] = 1

        def read() -> Any:
            with open_predictions(tmp_path / "p.zarr") as of:
                return of("a")["coords"]

        return tmp_path / "p.zarr/a/coords", read

    return make


@pytest.mark.parametrize(("change", "message"), [
    ({"fill_value": 300}, "out of bounds"),
    ({"shape": [8.9, 3]}, "sizes are"),
    (cut(4.0, 3), "sizes are"),
    (cut(8, 64), "chunks of"),
    ({"storage_transformers": [{"name": "x"}]}, "storage_transformers are"),
    ({"codecs": [{"name": "bytes"}, {"name": "gzip"}]}, "codecs"),
    ({"codecs": [{"name": "numcodecs.pickle"}]}, "codecs"),
    ({"zarr_format": 2}, "no array of Zarr format 3"),
    ({"shape": [2**40, 3]}, "has shape"),
    (cut(2**40, 2**40), "chunks of"),
    (cut(1, 1), "it holds 12 bytes|chunks of"),
    (cut(0, 3), "must not be zero"),
    ({"chunk_grid": 5}, "not subscriptable"),
    ({"fill_value": "x"}, "invalid literal"),
])  # fmt: skip
@pytest.mark.parametrize("shards", [None, (8, 3)])
def test_metadata_of_arrays_are_taken_at_their_word(ones, change, message, shards):
    folder, read = ones(chunks=(4, 3), shards=shards)
    assert read().tolist() == [[1, 1, 1]] * 8
    file = folder / "zarr.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(InputError, match=rf"p\.zarr/a \[coords\].*({message})"):
        read()


def test_a_lost_file_of_a_prediction_and_a_chunk_that_unpacks_to_much_are_refused(ones):
    for shards in None, (4, 3):
        folder, read = ones(chunks=(4, 3), shards=shards)
        (folder / "c/1/0").unlink()
        with pytest.raises(InputError, match=r"its file coords/c/1/0 is missing; .* all chunks"):
            read()
        much = (2**25, 3)  # 96 MiB, of 3 kB packed
        folder, read = ones(chunks=much, shards=shards and much)
        assert sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) < 20_000
        with pytest.raises(InputError, match="chunks of"):
            read()


def test_log10_is_no_prediction_and_a_bad_one_is():
    coords = np.argwhere(np.ones((5, 5, 4))).astype(np.uint8)
    log10, bad = np.tile([6.3, 3.0, 0.4], (100, 1)), np.random.default_rng(0).normal(size=(100, 3))
    with pytest.raises(InputError, match=r"half of the values of a property are beyond 6\.3"):
        check_prediction("a", {"properties": log10}, coords, PIXIE_RANGES)
    check_prediction("a", {"properties": 2 * bad}, coords, PIXIE_RANGES)


def test_a_pipe_is_not_waited_for(learn_store, tmp_path):
    (tmp_path / "p").mkdir()
    os.mkfifo(tmp_path / "p/a.npz")
    os.mkfifo(tmp_path / "p.h5")
    for path in ("p", "p.h5"):
        words = ("evaluate", tmp_path / path, "--store", learn_store, "--split", "all")
        assert "regular file" in refused(*words, code=1)


@pytest.fixture(scope="module")
def trained(learn_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "run"
    train(learn_store, out, LONGER, stop_after=1)
    return out


@pytest.fixture
def stopped(trained: Path, tmp_path: Path) -> Path:
    """A run that may be changed, stopped after one epoch of two."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


CHECKPOINTS: dict[str, Any] = {
    "no model": lambda state: state.pop("model"),
    "no history": lambda state: state.pop("history"),
    "empty history": lambda state: state.update(history=[]),
    "history of text": lambda state: state["history"][0].update(val_loss="x"),
    "history of others": lambda state: state.update(history=[{"a": 1}]),
    "model of others": lambda state: state.update(model={"x": torch.zeros(3)}),
    "model no table": lambda state: state.update(model=5),
    "optimizer of others": lambda state: state.update(optimizer={"state": {}, "param_groups": []}),
    "moments of others": lambda state: state["optimizer"]["state"][0].update(exp_avg=torch.ones(1)),
}


@pytest.mark.parametrize("case", CHECKPOINTS)
def test_checkpoints_of_others_are_named(learn_store, stopped, case):
    state = torch.load(stopped / LAST, weights_only=True)
    CHECKPOINTS[case](state)
    torch.save(state, stopped / LAST)
    with pytest.raises(InputError, match=r"last\.pt: cannot be read"):
        train(learn_store, stopped, LONGER)


def test_compressed_and_foreign_files_of_a_run_are_named(learn_store, trained, stopped):
    file, packed = stopped / LAST, zipfile.ZIP_DEFLATED
    with zipfile.ZipFile(trained / LAST) as old, zipfile.ZipFile(file, "w", packed) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    for change, said in (
        (lambda: None, "it is compressed"),
        (lambda: torch.save([1], file), "it holds list"),
        (lambda: (file.unlink(), os.mkfifo(file)), "no regular file"),
    ):
        change()
        with pytest.raises(InputError, match=said):
            train(learn_store, stopped, LONGER)
    parameters = json.loads((trained / "run.json").read_text())
    for content in (b"\xff", b"[" * 100_000, b"5"):
        (stopped / "run.json").write_bytes(content)
        with pytest.raises(InputError, match=r"run\.json: cannot be read"):
            train(learn_store, stopped, LONGER)
    for other in ({"shares": 5}, {"verdicts": [1]}, {"max_ambiguity": "x"}):
        (stopped / "run.json").write_text(json.dumps(parameters | other))
        with pytest.raises(InputError, match="does not say which assets"):
            selection_of_run(stopped / "predictions")


@pytest.mark.parametrize("linked", ["", "properties", "properties/zarr.json", "properties/c"])
def test_a_link_in_zarr_predictions_leads_nowhere_else(learn_store, tmp_path, linked):
    store = open_store(learn_store)
    for row, asset_id in enumerate(store.ids):
        write_one(tmp_path / "p", "zarr", asset_id, zeros(store.read(row, ("coords",))))
    place = tmp_path / "p" / store.ids[0] / linked
    outside, inside = tmp_path / "elsewhere", tmp_path / "p" / "inside"
    place.rename(outside)
    place.symlink_to(outside)
    (problem,) = evaluate_store(tmp_path / "p", learn_store, None).problems
    assert "out of its root" in problem
    place.unlink()
    outside.rename(inside)
    place.symlink_to(inside)
    assert evaluate_store(tmp_path / "p", learn_store, None).problems == []


def shared() -> list[Any]:
    """Return a list of 10 ** 9 leaves that takes no memory: one list holds another."""
    inner: list[Any] = [0.0] * 10
    for _ in range(8):
        inner = [inner] * 10
    return inner


def told(state: dict[str, Any], change: Callable[[dict[str, Any]], object]) -> None:
    """Change what a checkpoint says of its decoder."""
    about = json.loads(state["about"])
    change(about)
    state["about"] = json.dumps(about)


def with_contents(state: dict[str, Any], **change: object) -> None:
    told(state, lambda about: about["contents"].update(change))


def with_range(state: dict[str, Any], **change: object) -> None:
    told(state, lambda about: about["normalization"]["ranges"][0].update(change))


def retyped(state: dict[str, Any], kind: torch.dtype) -> None:
    state["model"].update({name: weight.to(kind) for name, weight in state["model"].items()})


NONE = r"best\.pt: holds no decoder with its ranges"
CHANGES: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "what it says without end": (lambda s: s.update(about=shared()), "about is list, not a text"),
    "a range that is none": (lambda s: with_range(s, lo="0"), "valid number"),
    "ranges beyond floats": (lambda s: with_range(s, hi=1e308), "not finite"),
    "ranges beyond float32": (lambda s: with_range(s, hi=300.0), "not finite"),
    "ranges without an end": (lambda s: with_range(s, hi=float("inf")), "ranges are"),
    "ranges of other properties": (lambda s: with_range(s, name="mass"), "properties differ"),
    "one name for two classes": (lambda s: with_contents(s, classes=["a", "a"]), "a name each"),
    "too many": (lambda s: with_contents(s, classes=[*map(str, range(300))]), "at most 254"),
    "no property": (lambda s: with_contents(s, properties=[]), "properties differ"),
    "whole weights": (lambda s: retyped(s, torch.int8), "torch.int8, not real numbers"),
    "complex weights": (lambda s: retyped(s, torch.complex64), "torch.complex64, not real numbers"),
    "weights that are none": (lambda s: s.update(model=shared()), "holds no decoder"),
    "no ranges": (lambda s: told(s, lambda about: about.pop("normalization")), NONE),
    "nothing said": (lambda s: s.pop("about"), NONE),
    "ranges turned about": (lambda s: with_range(s, lo=1e9), "ranges are"),
    "another size": (lambda s: told(s, lambda about: about.update(size="huge")), NONE),
    "a tensor without end": (lambda s: s.update(about=torch.zeros(1).expand(10**9)), NONE),
    "a weight too few": (lambda s: s["model"].popitem(), NONE),
    "no numbers": (lambda s: s["model"]["regression.weight"].fill_(float("nan")), NONE),
}


def not_loaded(path: Path, said: str) -> None:
    with less_than(100e6), pytest.raises(InputError, match=said) as caught:
        load_checkpoint(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 700


@pytest.mark.parametrize(("change", "said"), CHANGES.values(), ids=CHANGES)
def test_a_checkpoint_is_refused_in_words(change, said, tmp_path):
    state = checkpoint_state(make_decoder("small"), "small", PIXIE_RANGES)
    change(state)
    torch.save(state, tmp_path / "best.pt")
    not_loaded(tmp_path / "best.pt", said)


def test_a_structure_of_millions_of_lists_is_not_unpickled(tmp_path):
    path = tmp_path / "best.pt"
    torch.save({"size": "small"}, path)
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    lists = b"\x80\x02(" + b"]" * 1_100_000 + b"l."  # a list of them, as pickle writes it
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, lists if name.endswith("data.pkl") else data)
    not_loaded(path, "its structure takes 1,100,005 bytes")


def test_memory_that_a_checkpoint_would_set_aside_is_not_unpickled(tmp_path):
    torch.save({"size": "small", "extra": bytearray(10)}, tmp_path / "best.pt")
    not_loaded(tmp_path / "best.pt", r"it names '.* bytearray'")
    not_loaded(tmp_path / "other.pt", "does not exist")


@pytest.mark.parametrize(("members", "said"), [
    ({f"data/x{number}": b"" for number in range(20_000)}, "20,0.. members, and at most 10,000"),
    ({"constants.pkl": b"\x80\x02N."}, "it holds a program of TorchScript"),
], ids=["many", "a program"])  # fmt: skip
def test_odd_members_are_refused_without_a_word_of_torch(members, said, tmp_path, recwarn):
    torch.save({"size": "small"}, tmp_path / "best.pt")
    with zipfile.ZipFile(tmp_path / "best.pt", "a") as archive:
        for name, data in members.items():
            archive.writestr(f"best/{name}", data)
    not_loaded(tmp_path / "best.pt", said)
    assert not recwarn.list


def test_members_that_overlap_are_not_read(tmp_path):
    """A directory may name one member again and again, each time with all its bytes."""
    path = tmp_path / "best.pt"
    torch.save({"size": "small", "other": torch.zeros(1000)}, path)
    with zipfile.ZipFile(path) as archive:
        largest = max(archive.infolist(), key=lambda info: info.file_size)
        largest.filename = largest.orig_filename = largest.filename[:-1] + "9"
    with zipfile.ZipFile(path, "a") as archive:
        archive.filelist.append(largest)
        archive.NameToInfo[largest.filename] = largest
        archive.writestr("best/last", b"")
    not_loaded(path, "its members overlap")


def test_the_largest_decoder_with_its_optimiser_is_no_stranger(tmp_path):
    model = make_decoder("large")
    optimizer = torch.optim.AdamW(model.parameters())
    sum(weight.sum() for weight in model.parameters()).backward()
    optimizer.step()
    state = checkpoint_state(model, "large", PIXIE_RANGES) | {"optimizer": optimizer.state_dict()}
    torch.save(state, tmp_path / "best.pt")
    assert load_checkpoint(tmp_path / "best.pt").size == "large"

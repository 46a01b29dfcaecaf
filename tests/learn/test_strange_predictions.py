"""Stores, predictions and checkpoints of strangers: nothing outside, nothing huge, no traceback."""

import dataclasses
import json
import os
import shutil
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import zarr
from support.commands import refused

from slatprep.errors import InputError, StoreError
from slatprep.learn.metrics import evaluate_store
from slatprep.learn.predictions import check_prediction, read_array, selection_of_run
from slatprep.learn.runs import LAST
from slatprep.learn.splits import assign_store
from slatprep.learn.train import TrainParameters, train
from slatprep.normalize import PIXIE_RANGES
from slatprep.readers.files import ArraySpec
from slatprep.readers.splits import Shares
from slatprep.store import open_store

SHARES = Shares(0.4, 0.3, 0.3)
SHORT = TrainParameters(size="tiny", epochs=1, shares=SHARES)


@pytest.fixture
def hostile(learn_store: Path, tmp_path: Path) -> Path:
    """Copy the store, with ids that lead out of any folder."""
    store = Path(shutil.copytree(learn_store, tmp_path / "s.zarr"))
    ids = zarr.open_group(store, mode="r+", use_consolidated=False)["asset/id"]
    out = [f"../../../../up{k}" for k in range(4)] + [f"{tmp_path}/abs{k}" for k in range(5)]
    ids[:] = np.array(out, object)
    return store


def test_training_writes_nothing_outside(hostile, tmp_path):
    out = tmp_path / "deep" / "runs" / "x"
    summary = train(hostile, out, SHORT)
    written = list(summary.predictions.iterdir())
    assert written and all(path.name.startswith(("%2E%2E%2F", "%2F", "%2E.")) for path in written)
    assert {path.name for path in tmp_path.iterdir()} == {"s.zarr", "deep"}
    splits = assign_store(open_store(hostile), shares=SHARES).splits
    found = evaluate_store(summary.predictions, hostile, "test", splits=splits)
    assert found.missing == []


def test_evaluation_reads_nothing_outside(hostile, tmp_path):
    store, folder = open_store(hostile), tmp_path / "predictions"
    folder.mkdir()
    count = store.rows(4)[1] - store.rows(4)[0]
    np.savez(f"{store.ids[4]}.npz", properties=np.zeros((count, 3)))
    with pytest.raises(InputError, match=r"no prediction of an asset.*ids of that split"):
        evaluate_store(folder, hostile, None)
    inside = open_store(hostile).ids[0].replace("/", "%2F").replace("..", "%2E.", 1)
    (folder / f"{inside}.npz").symlink_to(f"{store.ids[4]}.npz")
    with pytest.raises(InputError, match="out of its root"):
        evaluate_store(folder, hostile, None)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"properties": "x"}, "has dtype"),
        ({"properties": 1j}, "has dtype"),
        ({"material": "1"}, "has dtype"),
        ({"material": 0.5}, "has class 0.5"),
        ({"material": np.nan}, "has class nan"),
        ({"logits": np.nan}, "not all numbers"),
        ({"logits": 1j}, "has dtype"),
        ({"logits": "5"}, "has dtype"),
        ({"coords": np.nan}, "has coordinate nan"),
        ({"coords": 1.5}, "has coordinate 1.5"),
        ({"properties": "pairs"}, "has dtype"),
        ({"properties": np.zeros((5, 3))}, "properties has shape"),
        ({"properties": np.nan}, "not all finite"),
        ({"properties": 7850.0}, "properties reach 7850; expected normalised properties"),
        ({"material": 9}, "class 9"),
        ({"coords": 1}, "other voxels"),
        ({"E": np.zeros(3)}, "expected properties"),
    ],
)
@pytest.mark.parametrize("form", ["npz", "hdf5", "zarr"])
def test_values_that_are_no_prediction_are_named(learn_store, tmp_path, arrays, message, form):
    count = open_store(learn_store).rows(0)[1]
    shapes = {"properties": (count, 3), "material": (count,), "coords": (count, 3)}
    shapes |= {"logits": (count, 8)}
    whole = {} if "E" in arrays else {"properties": np.zeros((count, 3))}
    for name, value in arrays.items():
        whole[name] = value if isinstance(value, np.ndarray) else np.full(shapes[name], value)
        if isinstance(value, str) and value == "pairs":
            whole[name] = np.zeros(shapes[name], [("a", "i4"), ("b", "i4")])
    path = tmp_path / "p"
    if form == "npz":
        path.mkdir()
        np.savez(path / "a.npz", **whole)
    elif form == "hdf5":
        with h5py.File(path, "w") as file:
            for name, values in whole.items():
                text = values.astype("S") if values.dtype.kind == "U" else values
                file[f"a/{name}"] = text
    else:
        root = zarr.open_group(path, mode="w").create_group("a")
        for name, values in whole.items():
            text = values.astype("U4") if values.dtype.kind == "U" else values
            root.create_array(name, data=text, config={"write_empty_chunks": True})
        message = rf"{message}|data_type is"
    with pytest.raises(InputError, match=message) as caught:
        evaluate_store(path, learn_store, None)
    assert f"{path}/a" in str(caught.value).replace(f"{path} [a", f"{path}/a")


def test_what_lies_beside_a_prediction_is_not_unpacked(learn_store, tmp_path):
    store = open_store(learn_store)
    for row, asset_id in enumerate(store.ids):
        count = len(store.read(row, ("coords",))["coords"])
        np.savez_compressed(
            tmp_path / f"{asset_id}.npz",
            properties=np.zeros((count, 3)),
            beside=np.zeros(2**24, np.uint8),
        )
        with zipfile.ZipFile(tmp_path / f"{asset_id}.npz", "a") as archive:
            archive.writestr("worse.npy", b"no array")
    assert evaluate_store(tmp_path, learn_store, None).missing == []


def test_zarr_predictions_of_any_cut_are_read(learn_store, tmp_path):
    store = open_store(learn_store)
    root = zarr.open_group(tmp_path / "p.zarr", mode="w")
    cuts = [{}, {"chunks": (100, 2)}, {"chunks": (128, 3), "shards": (1024, 3)}]
    cuts += [{"compressors": None}, {"compressors": zarr.codecs.BloscCodec()}]
    for row, asset_id in enumerate(store.ids):
        rows = store.read(row, ("properties", "material"))
        group = root.create_group(asset_id)
        values = np.nan_to_num(rows["properties"])
        if cuts[row % 5]:
            array = group.create_array(
                "properties", shape=values.shape, dtype="float32", **cuts[row % 5]
            )
            array[:] = values
        else:
            group.create_array("properties", data=values)
        group.create_array("material", data=np.where(rows["material"] == 255, 0, rows["material"]))
    means = evaluate_store(tmp_path / "p.zarr", learn_store, None).overall.means
    assert list(means.values()) == [0.0, 0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fill_value": 300}, "OverflowError"),
        ({"shape": [8.9, 3]}, "sizes are"),
        ({"chunk_grid": {"configuration": {"chunk_shape": [4.0, 3]}}}, "sizes are"),
        ({"chunk_grid": {"configuration": {"chunk_shape": [8, 64]}}}, "chunks of|chunks that"),
        ({"storage_transformers": [{"name": "x"}]}, "storage_transformers are"),
        ({"codecs": [{"name": "bytes"}, {"name": "gzip"}]}, "codecs"),
        ({"codecs": [{"name": "numcodecs.pickle"}]}, "codecs"),
        ({"zarr_format": 2}, "no array of Zarr format 3"),
        ({"shape": [2**40, 3]}, "has shape"),
        (
            {"chunk_grid": {"configuration": {"chunk_shape": [2**40, 2**40]}}},
            "chunks of|chunks that",
        ),
        (
            {"chunk_grid": {"configuration": {"chunk_shape": [1, 1]}}},
            "it holds 12 bytes|chunks that",
        ),
        ({"chunk_grid": {"configuration": {"chunk_shape": [0, 3]}}}, "p.zarr/a"),
        ({"chunk_grid": 5}, "p.zarr/a"),
        ({"fill_value": "x"}, "p.zarr/a"),
    ],
)
@pytest.mark.parametrize("shards", [None, (8, 3)])
def test_metadata_of_arrays_are_taken_at_their_word(tmp_path, change, message, shards):
    root, spec = zarr.open_group(tmp_path / "p.zarr", mode="w"), ArraySpec(((None, 3),), "u")
    array = root.create_array("a", shape=(8, 3), dtype="uint8", chunks=(4, 3), shards=shards)
    array[:] = 1
    file = tmp_path / "p.zarr/a/zarr.json"
    assert read_array(file.parent, file.parents[1], spec).tolist() == [[1, 1, 1]] * 8
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises((StoreError, InputError), match=message):
        read_array(file.parent, file.parents[1], spec)


@pytest.mark.parametrize(
    ("cut", "said"),
    [
        ({"chunks": (4, 3)}, r"p\.zarr/a: its chunk c/1/0 is missing"),
        ({"chunks": (2, 3), "shards": (4, 3)}, "its shard a/c/1/0 is missing; expected all chunks"),
    ],
)
def test_a_lost_file_of_a_prediction_is_refused(tmp_path, cut, said):
    root, spec = zarr.open_group(tmp_path / "p.zarr", mode="w"), ArraySpec(((None, 3),), "u")
    root.create_array("a", shape=(8, 3), dtype="uint8", **cut)[:] = 1
    (tmp_path / "p.zarr/a/c/1/0").unlink()
    with pytest.raises(InputError, match=said):
        read_array(tmp_path / "p.zarr/a", tmp_path / "p.zarr", spec)


def test_log10_is_no_prediction_and_a_bad_one_is():
    coords = np.argwhere(np.ones((5, 5, 4))).astype(np.uint8)
    log10, bad = np.tile([6.3, 3.0, 0.4], (100, 1)), np.random.default_rng(0).normal(size=(100, 3))
    with pytest.raises(InputError, match=r"half of the values of a property are beyond 6\.3"):
        check_prediction("a", {"properties": log10}, coords, PIXIE_RANGES)
    check_prediction("a", {"properties": 2 * bad}, coords, PIXIE_RANGES)


@pytest.mark.parametrize("sharded", [True, False])
def test_a_chunk_of_few_rows_that_unpacks_to_much_is_refused(tmp_path, sharded):
    root, spec = zarr.open_group(tmp_path / "p.zarr", mode="w"), ArraySpec(((None, 3),), "u")
    cut = (2**25, 3)  # 96 MiB, of 3 kB packed
    array = root.create_array(
        "a", shape=(8, 3), dtype="uint8", chunks=cut, shards=cut if sharded else None
    )
    array[:] = 1
    assert sum(file.stat().st_size for file in tmp_path.rglob("*") if file.is_file()) < 20_000
    with pytest.raises(StoreError, match="chunks of"):
        read_array(tmp_path / "p.zarr/a", tmp_path / "p.zarr", spec)


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
    train(learn_store, out, dataclasses.replace(SHORT, epochs=2), stop_after=1)
    return out


def _without(key: str) -> Any:
    return lambda state: state.pop(key)


CHECKPOINTS: dict[str, Any] = {
    "no model": _without("model"),
    "no history": _without("history"),
    "empty history": lambda state: state.update(history=[]),
    "history of text": lambda state: state["history"][0].update(val_loss="x"),
    "history of others": lambda state: state.update(history=[{"a": 1}]),
    "model of others": lambda state: state.update(model={"x": torch.zeros(3)}),
    "model no table": lambda state: state.update(model=5),
    "optimizer of others": lambda state: state.update(optimizer={"state": {}, "param_groups": []}),
    "moments of others": lambda state: state["optimizer"]["state"][0].update(exp_avg=torch.ones(1)),
}


@pytest.mark.parametrize("case", CHECKPOINTS)
def test_checkpoints_of_others_are_named(learn_store, trained, tmp_path, case):
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    state = torch.load(run / LAST, weights_only=True)
    CHECKPOINTS[case](state)
    torch.save(state, run / LAST)
    with pytest.raises(InputError, match=r"last\.pt: cannot be read"):
        train(learn_store, run, dataclasses.replace(SHORT, epochs=2))


def test_compressed_foreign_and_best_checkpoints_are_named(learn_store, trained, tmp_path):
    longer = dataclasses.replace(SHORT, epochs=2)
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    with (
        zipfile.ZipFile(trained / LAST) as old,
        zipfile.ZipFile(run / LAST, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            new.writestr(name, old.read(name))
    with pytest.raises(InputError, match="it is compressed"):
        train(learn_store, run, longer)
    torch.save([1], run / LAST)
    with pytest.raises(InputError, match="it holds list"):
        train(learn_store, run, longer)
    (run / LAST).unlink()
    os.mkfifo(run / LAST)
    with pytest.raises(InputError, match="no regular file"):
        train(learn_store, run, longer)
    run = Path(shutil.copytree(trained, tmp_path / "other"))
    for content in (b"\xff", b"[" * 100_000, b"5"):
        (run / "run.json").write_bytes(content)
        with pytest.raises(InputError, match=r"run\.json: cannot be read"):
            train(learn_store, run, longer)
    for change in ({"shares": 5}, {"verdicts": [1]}, {"max_ambiguity": "x"}):
        parameters = json.loads((trained / "run.json").read_text()) | change
        (run / "run.json").write_text(json.dumps(parameters))
        with pytest.raises(InputError, match="does not say which assets"):
            selection_of_run(run / "predictions")


@pytest.mark.parametrize("linked", ["group", "array", "metadata", "chunks"])
def test_a_link_in_zarr_predictions_leads_nowhere_else(learn_store, tmp_path, linked):
    store = open_store(learn_store)
    root = zarr.open_group(tmp_path / "p", mode="w")
    for asset_id, (start, stop) in ((one, store.rows(k)) for k, one in enumerate(store.ids)):
        root.create_group(asset_id).create_array("properties", data=np.full((stop - start, 3), 0.5))
    own = tmp_path / "p" / store.ids[0]
    places = {"array": "properties", "metadata": "properties/zarr.json", "chunks": "properties/c"}
    place = own / places.get(linked, "")
    for target in (tmp_path / "elsewhere", tmp_path / "p" / "inside"):
        place.rename(target)
        place.symlink_to(target)
        if target.parent == tmp_path:
            with pytest.raises(InputError, match="out of its root"):
                evaluate_store(tmp_path / "p", learn_store, None)
            place.unlink()
            target.rename(place)
        else:
            assert evaluate_store(tmp_path / "p", learn_store, None).missing == []

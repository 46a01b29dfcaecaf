"""Predictions: what they say, by hand; from files and stores; measured by other ranges."""

import hashlib
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
import torch
import zarr
from PIL import Image
from plyfile import PlyData, PlyElement
from support import commands
from support.commands import document, refused
from support.made_store import edit_attributes, make_store, rewrite

from slatprep import InputError, open_store
from slatprep.extract import Session
from slatprep.learn import require_torch
from slatprep.learn.decoder import make_decoder
from slatprep.learn.evaluate import evaluate_store
from slatprep.learn.metrics import OURS
from slatprep.learn.predict import checkpoint_state, load_checkpoint, predict
from slatprep.learn.predictions import check_prediction
from slatprep.learn.published import SECONDS, SECONDS_OF_OTHERS
from slatprep.normalize import PIXIE_RANGES, normalization_of, normalize_properties
from slatprep.particles.fields import predicted_field
from slatprep.records import FEATS_MEAN, FEATS_STD, PIXIEVERSE, LatentSpace, StructuredLatents
from slatprep.records.encoders import LATENTS

RANGES = np.array([[3.0, 9.0], [1.0, 4.0], [0.1, 0.5]])


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A decoder with random heads, as a run's folder holds it."""
    torch.manual_seed(3)
    model = make_decoder("small")
    for head in (model.regression, model.classification):
        torch.nn.init.normal_(head.weight, std=0.3)
    folder = tmp_path / "run"
    folder.mkdir()
    state = checkpoint_state(model, "small", normalization_of(RANGES, "dataset"))
    torch.save(state, folder / "best.pt")
    return folder


def random_latents(seed: int, count: int = 300) -> StructuredLatents:
    rng = np.random.default_rng(seed)
    flat = rng.choice(64**3, count, replace=False)
    coords = np.stack(np.unravel_index(flat, (64, 64, 64)), axis=1).astype(np.uint8)
    feats = rng.normal(FEATS_MEAN, FEATS_STD, (count, 8)).astype(np.float32)
    return StructuredLatents(coords, feats)


def save(path: Path, latents: StructuredLatents) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, coords=latents.coords, feats=latents.feats)


def run(*arguments: object, code: int = 0) -> dict[str, Any]:
    return document("predict", *arguments, code=code)


def test_a_prediction_is_the_decoder_s_and_its_units_follow_by_hand(checkpoint):
    latents = random_latents(0)
    (field,) = predict(load_checkpoint(checkpoint), [latents])
    model = make_decoder("small")
    model.load_state_dict(torch.load(checkpoint / "best.pt", weights_only=True)["model"])
    feats = (latents.feats - np.array(FEATS_MEAN)) / np.array(FEATS_STD)
    rows = np.concatenate([np.zeros((300, 1)), latents.coords], axis=1).astype(np.int32)
    with torch.no_grad():
        said = model(torch.from_numpy(rows), torch.from_numpy(feats.astype(np.float32)))
    np.testing.assert_allclose(field.properties, said.properties.numpy(), atol=1e-5)
    scores = np.exp(said.logits.numpy().astype(np.float64))
    scores /= scores.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(field.probabilities, scores, atol=1e-5)
    assert np.array_equal(field.material, field.probabilities[:, :7].argmax(axis=1))
    mapped = RANGES[:, 0] + (field.properties + 1) / 2 * (RANGES[:, 1] - RANGES[:, 0])
    expected = np.concatenate([10 ** mapped[:, :2], mapped[:, 2:]], axis=1)
    np.testing.assert_allclose(field.properties_si, expected, rtol=1e-5)


def test_what_is_in_a_batch_changes_no_more_than_the_last_bits(checkpoint):
    assets = [random_latents(seed, 100 + 50 * seed) for seed in range(4)]
    decoder = load_checkpoint(checkpoint)
    alone = list(predict(decoder, assets, batch_voxels=1))
    together = list(predict(decoder, assets, batch_voxels=10_000))
    pairs = list(predict(decoder, assets, batch_voxels=300))
    for latents, *fields in zip(assets, alone, together, pairs, strict=True):
        for field in fields:
            assert np.array_equal(field.coords, latents.coords)
            np.testing.assert_allclose(field.properties, fields[0].properties, atol=1e-5)
            assert field.seconds > 0


def test_a_folder_of_slats_and_a_file_that_cannot_be_read(checkpoint, tmp_path):
    slats, out = tmp_path / "slat", tmp_path / "out"
    save(slats / "a.npz", random_latents(1))
    save(slats / "b" / "front.npz", random_latents(2))
    (slats / "c.npz").write_bytes(b"no zip")
    huge = random_latents(3)
    save(slats / "d.npz", replace(huge, feats=huge.feats * np.float32(1e30)))
    told = run(slats, "--checkpoint", checkpoint, "--out", out, code=1)
    assert told["predicted"] == 2
    assert told["voxels"] == 600
    assert told["checkpoint"] == hashlib.sha256((checkpoint / "best.pt").read_bytes()).hexdigest()
    one, other = told["problems"]
    assert "c.npz" in one
    assert other.startswith("d: what is predicted of its latents is not finite")
    assert sorted(path.name for path in out.iterdir()) == ["a.npz", "b.front.npz"]
    with np.load(out / "a.npz") as held:
        assert np.array_equal(held["coords"], random_latents(1).coords)
        np.testing.assert_array_equal(held["ranges"], RANGES)
        assert str(held["checkpoint"]) == told["checkpoint"]
        assert held["probabilities"].shape == (300, 8)
        assert held["seconds"] > 0
        first = held["properties"]
    run(slats, "--checkpoint", checkpoint, "--out", out, "--asset", "a")
    assert np.array_equal(np.load(out / "a.npz")["properties"], first)
    words = ("predict", slats, "--checkpoint", checkpoint, "--out", out, "--asset", "b.fron_t")
    assert f"{slats} has no asset 'b.fron_t'; did you mean b.front?" in refused(*words)
    assert np.array_equal(predicted_field(out / "a.npz", None).voxels, random_latents(1).coords)


@pytest.mark.parametrize("command", ["predict", "train"])
def test_a_device_that_is_not_there_is_named(checkpoint, tmp_path, command):
    weights = ["--checkpoint", checkpoint] if command == "predict" else []
    source = tmp_path / "data"
    source.mkdir()
    words = (source, *weights, "--out", tmp_path / "out", "--device", "cuda")
    assert "finds no CUDA device" in refused(command, *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("there", "device"), [(True, "cuda"), (False, "cpu")])
def test_the_gpu_is_the_default_where_there_is_one(monkeypatch, there, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    assert require_torch(None) == device
    assert require_torch("cpu") == "cpu"


def test_one_file_of_either_kind(checkpoint, tmp_path):
    latents = random_latents(4)
    save(tmp_path / "one.npz", latents)
    with h5py.File(tmp_path / "two.h5", "w") as two, h5py.File(tmp_path / "many.h5", "w") as many:
        for group in (two, many.create_group("x"), many.create_group("y")):
            group["coords"], group["feats"] = latents.coords, latents.feats
    told = refused("predict", __file__, "--checkpoint", checkpoint, "--out", tmp_path)
    assert "expected a SLAT as .npz, .h5 or .hdf5" in told
    for name, ids in (("one.npz", ["one"]), ("two.h5", ["two"]), ("many.h5", ["x", "y"])):
        out = tmp_path / f"out-{name}"
        run(tmp_path / name, "--checkpoint", checkpoint, "--out", out)
        assert sorted(path.stem for path in out.iterdir()) == ids
        ours, first = out / f"{ids[0]}.npz", tmp_path / "out-one.npz" / "one.npz"
        said = (np.load(file)["properties"] for file in (ours, first))
        np.testing.assert_allclose(*said, atol=1e-6)


def test_a_prediction_replaces_predictions_alone(checkpoint, tmp_path):
    given, out = tmp_path / "given", tmp_path / "out"
    for folder in (given, out):
        folder.mkdir()
    for name in ("cup", "my chair"):
        save(given / f"{name}.npz", random_latents(4))
    (out / "cup.npz").write_text("mine")
    before = (given / "cup.npz").read_bytes()
    words = ("--checkpoint", checkpoint, "--out")
    said = "exists and is not a prediction of slatprep"
    assert said in refused("predict", given / "cup.npz", *words, given, code=1)
    assert (given / "cup.npz").read_bytes() == before
    assert said in refused("predict", given, *words, out, code=1)
    assert (out / "cup.npz").read_text() == "mine"
    (out / "cup.npz").unlink()
    for _ in range(2):
        run(given, *words, out)
        assert sorted(path.name for path in out.iterdir()) == ["cup.npz", "my%20chair.npz"]


def test_a_store_of_other_ranges_measures_the_same(checkpoint, learn_store, undisturbed, tmp_path):
    """One store is by the ranges of its dataset, the other by Pixie's."""
    for store in (learn_store, undisturbed[1]):
        out = tmp_path / store.stem
        run(store, "--checkpoint", checkpoint, "--out", out)
        report = evaluate_store(out, store, None)
        # By hand: what the decoder says in SI units, normalised as the truth is, not clipped.
        errors: dict[str, list[float]] = {}
        opened = open_store(store)
        assert report.converted == len(opened)
        for row, asset_id in enumerate(opened.ids):
            rows = opened.read(row, ("properties", "valid"))
            with np.load(out / f"{asset_id}.npz") as held:
                mapped = np.log10(held["properties_si"].astype(np.float64))
                mapped[:, 2] = held["properties_si"][:, 2]
            low, high = np.array([[s.lo, s.hi] for s in opened.normalization.ranges]).T
            said = 2 * (mapped - low) / (high - low) - 1
            error = np.square(said - rows["properties"])[rows["valid"]].mean()
            errors.setdefault(asset_id.partition(".")[0], []).append(error)
        expected = np.mean([np.mean(views) for views in errors.values()])
        assert report.methods[OURS].means["mean"] == pytest.approx(expected, rel=1e-4)


def test_ranges_of_a_prediction_are_checked_and_equal_ones_change_nothing():
    coords = np.array([[1, 2, 3]], np.uint8)
    values = normalize_properties([[1e7, 1000.0, 0.3]])
    own = np.array([[span.lo, span.hi] for span in PIXIE_RANGES.ranges])
    same = check_prediction("p", {"properties": values, "ranges": own}, coords, PIXIE_RANGES)
    assert not same.converted
    assert np.array_equal(same.properties, values)
    other = check_prediction("p", {"properties": values, "ranges": RANGES}, coords, PIXIE_RANGES)
    assert other.converted
    si = [[1e3, 1e10], *own[1:]]
    for wrong in (own[:, ::-1], np.full((3, 2), np.nan), own[:2], si, own * 1e300):
        with pytest.raises(InputError, match="ranges"):
            check_prediction("p", {"properties": values, "ranges": wrong}, coords, PIXIE_RANGES)


@pytest.fixture
def trellis(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """TRELLIS's interface in place of TRELLIS; its Gaussians lie at the voxels' centres."""
    latents, stated = random_latents(9), ("sparse_structure_sampler", "slat_sampler")
    pipeline = Mock(device="cpu", shift=0.0, slat_normalization={})
    pipeline.configure_mock(**{f"{name}_params": {} for name in stated})
    pipeline.preprocess_image.side_effect = lambda image: image
    coords = torch.from_numpy(np.insert(latents.coords.astype(np.int32), 0, 0, axis=1))
    slat = SimpleNamespace(coords=coords, feats=torch.from_numpy(latents.feats))
    pipeline.sample_slat.return_value = slat

    def decode_slat(slat: Any, formats: list[str]) -> dict[str, list[Any]]:
        assert formats == ["gaussian"]
        x, y, z = ((slat.coords[:, 1:].numpy() + 0.5) / 64 - 0.5).T
        pipeline.feats = slat.feats.numpy()
        x[0] += pipeline.shift
        names = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "opacity", "scale_0", "rot_0")
        rows = np.zeros(len(x), [(name, "f4") for name in names])
        rows["x"], rows["y"], rows["z"] = x, -z, y  # as TRELLIS's save_ply turns them
        element = PlyElement.describe(rows, "vertex")
        return {"gaussian": [SimpleNamespace(save_ply=PlyData([element]).write)]}

    pipeline.decode_slat = decode_slat
    sparse = SimpleNamespace(SparseTensor=lambda feats, coords: SimpleNamespace(**locals()))
    for name in ("trellis", "trellis.modules"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, "trellis.modules.sparse", sparse)
    session = Session(pipeline, torch, {"name": "m", "revision": "r"})
    monkeypatch.setattr("slatprep.extract.load_session", lambda *_, **__: session)
    return pipeline


@pytest.fixture
def image(tmp_path: Path) -> Path:
    Image.new("RGB", (8, 8)).save(tmp_path / "cup.png")
    return tmp_path / "cup.png"


def test_an_image_becomes_gaussians_with_materials(checkpoint, tmp_path, trellis, image):
    out, ply = tmp_path / "out", tmp_path / "cup.ply"
    words = (image, "--checkpoint", checkpoint, "--out", out, "--gaussians", ply)
    stages = ["image", "sparse structure", "SLAT", "read", "decode", "write", "gaussians"]
    assert list(run(*words)["seconds"]) == stages
    # SLAT-Phys's times stand beside; its speed-ups follow from the sum of its stages.
    told = step("predict", image, "--checkpoint", checkpoint, "--out", tmp_path / "shown")
    assert "SLAT-Phys, s" in told and "4.69" in told and "NeRF2Physics 1,196 s" in told
    assert "device:  cpu" in told
    whole = sum(spent for stage, spent in SECONDS.items() if stage != "in all")
    assert [round(spent / whole) for spent in SECONDS_OF_OTHERS.values()] == [121, 128]
    # A second time the latents are there; what the decoder does is done again.
    assert list(run(*words)["seconds"]) == stages[3:]
    np.testing.assert_array_equal(trellis.feats, random_latents(9).feats)
    rows = PlyData.read(str(ply))["vertex"].data
    with np.load(out / "cup.npz") as held:
        assert np.array_equal(rows["material_id"], held["material"])
        np.testing.assert_allclose(rows["E"], held["properties_si"][:, 0], rtol=1e-6)
    # The attributes of the splats come along.
    plain = PlyData.read(str(out / "gaussians.ply"))["vertex"].data
    for name in plain.dtype.names:
        np.testing.assert_array_equal(rows[name], plain[name])
    trellis.shift = 9.0
    for far, kept in (("drop", 299), ("nearest", 300)):
        told = step("predict", *words, "--far", far)
        assert f"1 of 300 Gaussians have no voxel: {far}" in told
        rows = PlyData.read(str(ply))["vertex"].data
        assert len(rows) == kept and (rows["density"] > 0).all()


def step(*words: object, code: int = 0) -> str:
    return commands.run(*words, code=code).output


def test_each_step_alone_comes_to_what_the_one_line_does(checkpoint, tmp_path, trellis, image):
    at_once = tmp_path / "at-once.ply"
    run(image, "--checkpoint", checkpoint, "--out", tmp_path / "out", "--gaussians", at_once)
    slats, predictions, gaussians = (tmp_path / name for name in ("slat", "p", "gaussians"))
    step("extract-slat", image, "--out", slats)
    refused = step("predict", slats, "--checkpoint", checkpoint, "--out", predictions,
                   "--gaussians", at_once, code=2)  # fmt: skip
    assert "`slatprep decode-slat` makes Gaussians of latents" in refused
    step("predict", slats, "--checkpoint", checkpoint, "--out", predictions)
    step("decode-slat", slats / "cup.npz", "--out", gaussians)
    stepped = tmp_path / "stepped.ply"
    step("transfer", gaussians / "cup.ply", "--prediction", predictions / "cup.npz",
         "--out", stepped)  # fmt: skip
    assert stepped.read_bytes() == at_once.read_bytes()


def test_decoders_get_latents_as_trellis_draws_them(learn_store, tmp_path, trellis, monkeypatch):
    """Whatever was done to those that are stored or saved."""
    slats, out = tmp_path / "slat", tmp_path / "gaussians"
    step("decode-slat", learn_store, "--asset", "a", "--out", out)
    assert [path.name for path in out.iterdir()] == ["a.ply"]
    np.testing.assert_array_equal(trellis.feats, open_store(learn_store).asset("a").feats)
    latents, decode = random_latents(9), trellis.decode_slat
    feats = (latents.feats - np.array(FEATS_MEAN)) / np.array(FEATS_STD)
    save(slats / "b.npz", replace(latents, feats=feats.astype(np.float32)))
    save(slats / "c.npz", random_latents(1, 400))
    (slats / "d.npz").write_bytes(b"no zip")

    def decode_slat(slat: Any, formats: list[str]) -> dict[str, list[Any]]:
        if len(slat.feats) == 400:
            raise RuntimeError("CUDA out of memory.\nTried to allocate 20 GiB")
        return decode(slat, formats)

    monkeypatch.setattr(trellis, "decode_slat", decode_slat)
    result = commands.run("decode-slat", slats, "--out", out, "--json", code=1)
    told = json.loads(result.stdout)
    assert "look standardised already" in result.stderr
    assert (told["decoded"], told["failed"]) == (1, 2)
    problem, other = told["problems"]
    assert "c.ply: TRELLIS could not decode its 400 voxels" in problem and "d.npz" in other
    assert "out of memory. Tried to allocate 20 GiB" in problem and problem in result.stderr
    np.testing.assert_allclose(trellis.feats, latents.feats, atol=1e-5)
    assert sorted(path.name for path in out.iterdir()) == ["a.ply", "b.ply"]


def test_standardised_latents_are_input_too(checkpoint, learn_store, learn_copy, tmp_path, trellis):
    """Those of a store, and of an encoder of equal moments."""
    plain = open_store(learn_store).asset("a")
    feats = zarr.open_group(learn_copy, mode="r+")["voxel/feats"]
    feats[:] = (feats[:] - np.array(FEATS_MEAN)) / np.array(FEATS_STD)
    latents = open_store(learn_copy).attributes["latents"]
    edit_attributes(learn_copy, latents=latents | {"standardised": True, "encoder": "sam3d"})
    step("decode-slat", learn_copy, "--asset", "a", "--out", tmp_path / "gaussians")
    np.testing.assert_allclose(trellis.feats, plain.feats, atol=1e-5)
    for path, out in ((learn_store, "plain"), (learn_copy, "standardised")):
        run(path, "--checkpoint", checkpoint, "--asset", "a", "--out", tmp_path / out)
    said = (np.load(tmp_path / out / "a.npz")["properties"] for out in ("plain", "standardised"))
    np.testing.assert_allclose(*said, atol=1e-5)


def test_latents_of_an_encoder_without_moments_are_standardised_or_refused(checkpoint, tmp_path):
    """A build of standardised latents learns no moments, so raw ones cannot be converted."""
    contents = replace(PIXIEVERSE, latents=LatentSpace("mine", 8, 64, standardised=True))
    model, ranges = make_decoder("small", contents), normalization_of(RANGES, "dataset")
    torch.save(checkpoint_state(model, "small", ranges, contents), checkpoint / "best.pt")
    feats = np.random.default_rng(5).normal(0.7, 0.9, (300, 8)).astype(np.float32)
    latents = replace(random_latents(5), feats=feats)
    save(tmp_path / "slats" / "a.npz", latents)
    words = (tmp_path / "slats", "--checkpoint", checkpoint, "--out", tmp_path / "p")
    told = run(*words)
    assert told["predicted"] == 1
    (field,) = predict(load_checkpoint(checkpoint), [replace(latents, standardised=True)])
    np.testing.assert_allclose(np.load(tmp_path / "p" / "a.npz")["properties"], field.properties)
    raw = tmp_path / "raw"
    save(raw / "a.npz", replace(latents, feats=3 * feats))
    for given in ((*words, "--standardised", "no"), (raw, *words[1:])):
        told = run(*given, code=1)
        assert told["predicted"] == 0 and "no mean and std of the encoder's" in told["problems"][0]


def test_latents_of_another_encoder_are_no_input(checkpoint, tmp_path):
    make_store(tmp_path / "s.zarr", replace(PIXIEVERSE, latents=LATENTS["trellis2"]))
    words = ("predict", tmp_path / "s.zarr", "--checkpoint", checkpoint, "--out", tmp_path / "p")
    assert "latents of trellis2 (32 channels); expected those of trellis" in step(*words, code=2)


def test_latents_of_a_store_are_held_to_what_a_file_s_are(checkpoint, learn_copy, tmp_path):
    rewrite(learn_copy, "voxel/feats", 5, np.nan)
    for fault in ("finite", "has no sound index"):
        told = run(learn_copy, "--checkpoint", checkpoint, "--out", tmp_path / "p", code=1)
        assert told["predicted"] == 8  # the other assets' rows are in other shards
        (problem,) = told["problems"]
        assert fault in problem and (fault != "finite" or "[a]" in problem)
        (learn_copy / "voxel/feats/c/0/0").write_bytes(b"")

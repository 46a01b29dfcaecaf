"""Latents of any width and encoder, standardised already or not, all the way to a prediction."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.made_store import edit_attributes
from support.synthetic import Dataset, MakeDataset
from support.tiny import TINY
from support.trees import records_beside, records_of, tree

from slatprep import build_store, concat_stores, export_store, open_store
from slatprep.errors import ConfigError, InputError, StoreError
from slatprep.inspect.verify import verify_store
from slatprep.learn.dataset import SlatDataset
from slatprep.learn.predict import load_checkpoint, predict
from slatprep.learn.train import TrainParameters, train
from slatprep.parameters import BuildParameters
from slatprep.pipeline.seen import look
from slatprep.readers import discover, read_latents
from slatprep.records import FEATS_MEAN, FEATS_STD, TRELLIS, StructuredLatents
from slatprep.store.integrity import metadata_findings

MEAN, STD = np.array(FEATS_MEAN, np.float32), np.array(FEATS_STD, np.float32)


def rewrite(dataset: Dataset, change: Callable[[np.ndarray], np.ndarray]) -> None:
    for name, asset in dataset.assets.items():
        asset.feats = change(asset.feats)
        dataset.write_slat(f"{name}.npz", asset.coords, asset.feats)


@pytest.fixture
def pair(make_dataset: MakeDataset) -> Dataset:
    """Two assets, which together tell whether latents are standardised."""
    return make_dataset("a", "b")


def of_latents(warnings: tuple[str, ...]) -> list[str]:
    """Return what is said of latents; of the dataset's objects some have one grid."""
    return [text for text in warnings if "latents" in text]


def test_a_store_says_which_encoder_made_its_latents(mixed_build):
    assert of_latents(mixed_build.warnings) == []
    latents = {"encoder": "trellis", "channels": 8, "resolution": 64, "standardised": False}
    moments = {"mean": list(FEATS_MEAN), "std": list(FEATS_STD)}
    assert open_store(mixed_build.store).attributes["latents"] == latents | moments


def test_standardised_latents_are_named_and_never_standardised_twice(pair, tmp_path):
    raw = {name: asset.feats.copy() for name, asset in pair.assets.items()}
    rewrite(pair, lambda feats: (feats - MEAN) / STD)
    out = tmp_path / "s.zarr"
    (warning,) = of_latents(build_store(pair.parameters(), out).warnings)
    assert "look standardised already" in warning and 'standardised = "yes" in [slat]' in warning
    store = open_store(out)
    assert store.contents.latents.standardised
    np.testing.assert_array_equal(store.asset("a").feats, pair.assets["a"].feats)

    data = SlatDataset(store)
    item = data[data.asset_ids.index("a")]
    np.testing.assert_array_equal(item.feats.numpy(), pair.assets["a"].feats)
    export_store(out, tmp_path / "npz", "npz", assets=["a"])
    with np.load(next((tmp_path / "npz").glob("**/a.npz"))) as file:
        np.testing.assert_allclose(file["feats"], raw["a"], atol=1e-5)

    # Said outright, nobody warns; said wrongly, it is done as said.
    for said in ("yes", "no"):
        summary = build_store(pair.parameters(slat={"standardised": said}), out)
        assert of_latents(summary.warnings) == []
        assert open_store(out).contents.latents.standardised == (said == "yes")


def test_all_latents_unlike_what_is_said_are_told_so(pair, tmp_path):
    parameters = pair.parameters(slat={"standardised": "yes"})
    told = of_latents(build_store(parameters, tmp_path / "s.zarr").warnings)
    said = 'look as the encoder gives them, and slat.standardised is "yes": is that so?'
    assert any(text.endswith(said) for text in told)


def test_warnings_follow_what_is_said_of_latents_later(pair, tmp_path):
    rewrite(pair, lambda feats: (feats - MEAN) / STD)
    other = {name: getattr(TRELLIS, name) for name in ("channels", "resolution", "mean")}
    path = tmp_path / "other.json"
    path.write_text(json.dumps({**other, "encoder": "other", "std": [9.0] * 8}))
    updated = tmp_path / "s.zarr"
    for number, slat in enumerate(({}, {"standardised": "yes"}, {"encoder": str(path)}, {})):
        fresh = tmp_path / f"{number}.zarr"
        for out in (updated, fresh):
            build_store(pair.parameters(slat=slat), out)
        assert tree(updated) == tree(fresh), slat


def test_one_slat_that_cannot_tell_is_asked_about_and_an_update_takes_the_store_s(tmp_path):
    made, out, told = Dataset(tmp_path / "d").having("a", "b"), tmp_path / "s.zarr", list[str]()
    for number, (name, asset) in enumerate(made.assets.items()):
        feats = np.random.default_rng(number).normal(3.0, 1.0, asset.feats.shape)
        made.write_slat(f"{name}.npz", asset.coords, feats.astype(np.float32))
    build_store(made.parameters("pixie"), out)
    assert not open_store(out).contents.latents.standardised
    made.write_grid("b", np.zeros((2, 2, 2, 4), np.float32))
    build_store(made.parameters("pixie"), out)
    assert open_store(out).ids == ["a"] and not open_store(out).contents.latents.standardised
    with pytest.raises(ConfigError, match="one SLAT alone does not tell"):
        build_store(made.parameters("pixie"), tmp_path / "new.zarr", note=told.append)
    assert sum(line.startswith("b: ") for line in told) == 1


def test_assets_too_small_to_tell_alone_tell_together(dataset, tmp_path):
    for name, asset in dataset.assets.items():
        few = np.linspace(0, len(asset.coords) - 1, 40).astype(int)
        dataset.write_slat(f"{name}.npz", asset.coords[few], ((asset.feats - MEAN) / STD)[few])
    (warning,) = of_latents(build_store(dataset.parameters(), tmp_path / "s.zarr").warnings)
    assert "look standardised already" in warning
    assert open_store(tmp_path / "s.zarr").contents.latents.standardised


def test_one_asset_unlike_the_others_is_named(dataset, tmp_path):
    asset = dataset.assets["c"]
    dataset.write_slat("c.npz", asset.coords, (asset.feats - MEAN) / STD)
    summary = build_store(dataset.parameters(), tmp_path / "s.zarr")
    (warning,) = of_latents(summary.warnings)
    assert "1 of 6 assets (c) look standardised already, unlike the others" in warning
    records = records_of(summary.records)
    assert [name for name, record in records.items() if record["warnings"]] == ["c"]


def test_mixed_latents_are_counted_but_none_of_little_spread(make_dataset, tmp_path):
    def unlike(names: str, raw: str, spread: dict[str, float]) -> str:
        dataset = make_dataset(*names)
        for name, asset in dataset.assets.items():
            standard = (asset.feats - MEAN) / STD * np.float32(spread.get(name, 1.0))
            feats = asset.feats if name in raw else standard
            dataset.write_slat(f"{name}.npz", asset.coords, feats)
        told = build_store(dataset.parameters(), tmp_path / f"{names}.zarr").warnings
        return next(text for text in told if "unlike the others" in text)

    assert "4 of 9 assets (f, g, h and 1 more) look standard" in unlike("abcdefghi", "abcde", {})
    assert "1 of 9 assets (f) look as the encoder gives them" in unlike("abcdef", "f", {"b": 0.4})


def test_other_widths_are_stored_trained_on_and_predicted_from(dataset, tmp_path):
    rewrite(dataset, lambda feats: np.tile(3 * feats + 1, 4)[:, :20])
    description = tmp_path / "mine.json"
    description.write_text(json.dumps({"encoder": "mine", "channels": 20, "resolution": 64}))
    out = tmp_path / "s.zarr"
    parameters = dataset.parameters(slat={"encoder": str(description)})
    build_store(parameters, out)
    store = open_store(out)
    every = np.concatenate([asset.feats for asset in dataset.assets.values()])
    assert store.shape("voxel/feats")[1] == 20
    np.testing.assert_allclose(store.contents.latents.mean, every.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(store.contents.latents.std, every.std(axis=0), rtol=1e-5)

    run = tmp_path / "run"
    train(out, run, TrainParameters(size=TINY, epochs=1, precision="fp32"))
    checkpoint = load_checkpoint(run)
    assert checkpoint.contents == store.contents
    asset = store.asset("a")
    standard = store.contents.latents.standardise(asset.feats)
    raw = StructuredLatents(asset.coords, asset.feats)
    done = StructuredLatents(asset.coords, standard, standardised=True)
    said, same = (next(predict(checkpoint, [one])).properties for one in (raw, done))
    np.testing.assert_array_equal(said, same)

    # Nothing is done again, and what is joined has the moments of all.
    assert build_store(parameters, out).build_id == str(store.attributes["manifest"])
    other = Dataset(tmp_path / "others").having("x", seed=3)
    rewrite(other, lambda feats: np.tile(feats, 4)[:, :20])
    build_store(other.parameters(slat={"encoder": str(description)}), tmp_path / "o.zarr")
    concat_stores([out, tmp_path / "o.zarr"], tmp_path / "both.zarr")
    both = np.concatenate([every, other.assets["x"].feats])
    joined = open_store(tmp_path / "both.zarr").contents.latents
    np.testing.assert_allclose(joined.mean, both.mean(axis=0), rtol=1e-5)


def test_measured_moments_do_not_depend_on_the_order_of_rows(tmp_path):
    description, whole = tmp_path / "mine.json", "abcdefg"
    description.write_text(json.dumps({"encoder": "mine", "channels": 8, "resolution": 64}))
    for name in (whole, "eg", "abcdf"):
        dataset = Dataset(tmp_path / name)
        for one in name:
            dataset.add(one, whole.index(one))
        parameters = dataset.parameters("pixie", slat={"encoder": str(description)})
        build_store(parameters, tmp_path / f"{name}.zarr")
    for name, parts in (("one", ("eg", "abcdf")), ("other", ("abcdf", "eg"))):
        concat_stores([tmp_path / f"{part}.zarr" for part in parts], tmp_path / f"{name}.zarr")
        assert tree(tmp_path / f"{name}.zarr") == tree(tmp_path / f"{whole}.zarr")


def test_a_slat_that_several_assets_have_counts_once_in_the_moments(tmp_path):
    """One annotation more, or a copy under another id, tells nothing more of the encoder."""
    description = tmp_path / "mine.json"
    description.write_text(json.dumps({"encoder": "mine", "channels": 8, "resolution": 64}))
    found = []
    for name in ("abc", "abcd"):
        dataset = Dataset(tmp_path / name).having(*"abc")
        if name == "abcd":
            dataset.add("d", 2)
        out = tmp_path / f"{name}.zarr"
        build_store(dataset.parameters("pixie", slat={"encoder": str(description)}), out)
        found.append(open_store(out).contents.latents)
    assert found[0].mean == found[1].mean and found[0].std == found[1].std


def test_attributes_that_do_not_fit_the_arrays_are_refused(copy):
    edit_attributes(copy, latents={"encoder": "x", "channels": 9, "resolution": 64})
    with pytest.raises(StoreError, match="9 columns of voxel/feats"):
        open_store(copy)
    assert any("9 columns of voxel/feats" in str(one) for one in metadata_findings(copy))


def write_both(dataset: Dataset, seed: int = 0) -> dict[str, np.ndarray]:
    """Write latents as TRELLIS.2's toolkit does, the texture's in another order; return both."""
    rng, both = np.random.default_rng(seed), {}
    for name, asset in dataset.assets.items():
        feats = rng.normal(size=(len(asset.coords), 64)).astype(np.float32) * 4
        order = rng.permutation(len(feats))
        for folder, rows, part in (
            ("shape_latents/shape_enc_1024", slice(None), feats[:, :32]),
            ("pbr_latents/tex_enc_1024", order, feats[:, 32:]),
        ):
            path = dataset.root / "trellis2" / folder / f"{name}.npz"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, coords=asset.coords[rows].astype(np.uint8), feats=part[rows])
        both[name] = feats
    return both


def of_both(dataset: Dataset) -> BuildParameters:
    root = dataset.root / "trellis2"
    slat = {"root": root, "encoder": "trellis2-shape-pbr", "standardised": "no"}
    return dataset.parameters(slat=slat)


def test_texture_latents_stand_behind_those_of_the_shape(pair, tmp_path):
    both, out = write_both(pair), tmp_path / "s.zarr"
    assert build_store(of_both(pair), out).statuses["ok"] == 2
    store = open_store(out)
    for asset in store:
        np.testing.assert_array_equal(asset.coords, pair.assets[asset.asset_id].coords)
        np.testing.assert_array_equal(asset.feats, both[asset.asset_id])
    space = store.contents.latents
    assert (space.encoder, space.channels, len(space.std)) == ("trellis2-shape-pbr", 64, 64)
    assert (space.mean[0], space.mean[32]) == (0.781296, 3.501659)
    paths = {(file["role"], file["path"]) for file in records_beside(out)["a"]["sources"]}
    assert ("texture", "pbr_latents/tex_enc_1024/a.npz") in paths
    assert verify_store(out, sources=True).ok
    # Texture that changes alone is noticed.
    path = pair.root / "trellis2/pbr_latents/tex_enc_1024/a.npz"
    with np.load(path) as held:
        np.savez(path, coords=held["coords"], feats=held["feats"] + 1)
    assert not verify_store(out, sources=True).ok
    assert build_store(of_both(pair), out).statuses["ok"] == 2
    assert verify_store(out, sources=True).ok
    both["a"][:, 32:] += 1
    np.testing.assert_array_equal(open_store(out).asset("a").feats, both["a"])


def loop_at(folder: Path) -> None:
    """Put a link to itself in place of a folder: it is there, and nobody can list it."""
    folder.rename(folder.with_name("away"))
    folder.symlink_to(folder.name)


@pytest.mark.parametrize(("change", "words"), [
    (lambda path: path.unlink(), "does not exist"),
    (lambda path: path.parent.rename(path.parents[1] / "tex_512"), "0 folders of texture"),
    (lambda path: (path.parents[1] / "other_1024").mkdir(), "2 folders of texture"),
    (lambda path: loop_at(path.parents[1]), r"pbr_latents: cannot be listed \("),
    (
        lambda path: np.savez(path, coords=[[1, 2, 3]], feats=np.zeros((1, 32), np.float32)),
        "has other voxels than a.npz of the shape",
    ),
])  # fmt: skip
def test_texture_latents_that_do_not_belong_are_refused(pair, change, words):
    write_both(pair)
    change(pair.root / "trellis2/pbr_latents/tex_enc_1024/a.npz")
    pairs = discover(of_both(pair))
    with pytest.raises(InputError, match=words):
        read_latents(pairs[0])
    assert len(look(pairs)) == len(pairs)

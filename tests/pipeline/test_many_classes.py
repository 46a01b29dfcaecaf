"""More classes than PhysGaussian has: the background's id is the store's, not 7."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.commands import run
from support.synthetic import SMALL_SHARDS, make_asset

from slatprep import build_store, export_store, open_store, store_statistics
from slatprep.errors import ConfigError, InputError, StoreError
from slatprep.inspect.check import check_alignment
from slatprep.inspect.pictures.statistics import draw_statistics
from slatprep.inspect.report.drawn import SHADES, thumbnail
from slatprep.inspect.verify import verify_store
from slatprep.learn.metrics import evaluate_store
from slatprep.learn.predictions import open_predictions
from slatprep.learn.train import TrainParameters, train
from slatprep.parameters import (
    BuildParameters,
    ConsensusParameters,
    PixieverseSource,
    SampleParameters,
    SlatSource,
    WitnessParameters,
)
from slatprep.readers.voxel_sets import field_of_voxels
from slatprep.records import MATERIAL_COLOURS, PROPERTIES, Contents

TABLE = [
    {"name": "density", "unit": "kg/m^3", "scale": "log10"},
    {"name": "hardness", "unit": "1", "scale": "linear"},
]


def classes_at(voxels: np.ndarray, count: int) -> np.ndarray:
    """Slabs across the L, each of a class of its own, in no order of the ids."""
    return (voxels[:, 0] * 37 + 5) % count


def write(root: Path, names: str, count: int) -> BuildParameters:
    """Write plain voxels of so many classes, and SLATs that lie a quarter turn away."""
    (root / "voxels").mkdir(parents=True)
    (root / "slat").mkdir()
    about = {"properties": TABLE, "classes": [f"class {k}" for k in range(count)]}
    (root / "voxels" / "source.json").write_text(json.dumps(about))
    for seed, name in enumerate(names):
        asset = make_asset(seed)
        voxels = np.argwhere(asset.grid[..., 3] != 7)
        material = classes_at(voxels, count)
        columns = {"density": 1000.0 + material, "hardness": material / 10.0}
        np.savez(root / "voxels" / f"{name}.npz", voxels=voxels, material=material, **columns)
        np.savez(root / "slat" / f"{name}.npz", coords=asset.coords, feats=asset.feats)
    return BuildParameters(
        PixieverseSource(root / "voxels", adapter="voxels"),
        SlatSource(root / "slat"),
        sample=SampleParameters(method="nearest"),
        store=SMALL_SHARDS,
    )


def test_as_many_as_a_byte_holds_are_looked_up_and_counted(tmp_path):
    out = tmp_path / "s.zarr"
    build_store(write(tmp_path, "ab", 254), out)
    store = open_store(out)
    assert store.contents.n_classes == 254
    assert store.attributes["background"] == store.contents.background == 254
    assert not verify_store(out, sources=True).findings
    counts = np.zeros(254, int)
    for seed, asset in enumerate(store):
        voxels = np.argwhere(make_asset(seed).grid[..., 3] != 7)
        material = classes_at(voxels, 254)
        counts += np.bincount(material, minlength=254)
        expected = np.full((64, 64, 64), 254)
        expected[tuple(voxels.T)] = material
        np.testing.assert_array_equal(asset.grid_material, expected)
        np.testing.assert_array_equal(asset.field.voxels, voxels)
        np.testing.assert_array_equal(asset.field.material, material)
        _, used = cKDTree(voxels).query(np.asarray(asset.place, np.float64) * 64 + 31.5)
        np.testing.assert_array_equal(asset.material, material[used])
        assert asset.valid.all()
        assert check_alignment(store, asset.asset_id).ok
    found = store_statistics(store)
    assert [one.name for one in found.classes] == [f"class {k}" for k in range(254)]
    for k, one in enumerate(found.classes):
        assert one.field.voxels == counts[k]
    assert found.total.field.unannotated == found.total.slat.unannotated == 0
    picture = draw_statistics(store, found, "svg")
    named = picture.count(b"<!-- class ")
    assert named < 20 and b"<!-- and %d more -->" % (np.count_nonzero(counts) - named) in picture


def test_nine_classes_and_other_properties_go_all_the_way_to_scores(tmp_path):
    out, trained = tmp_path / "s.zarr", tmp_path / "run"
    parameters = write(tmp_path, "abcdefgh", 9)
    passes = replace(
        parameters,
        sample=SampleParameters(),
        consensus=ConsensusParameters(settle=True),
        witness=WitnessParameters(settle=True),
    )
    build_store(passes, out)
    store = open_store(out)
    assert store.contents.background == 254
    assert not verify_store(out).findings
    for form in ("npz", "hdf5", "webdataset"):
        assert export_store(out, tmp_path / form, form).assets == 8
    with pytest.raises(StoreError, match="has no youngs_modulus and no poissons_ratio, only dens"):
        export_store(out, tmp_path / "ply", "ply")
    # By the vote, most voxels away from the slabs' borders have the class of their place.
    for seed, asset in enumerate(store):
        voxels = np.argwhere(make_asset(seed).grid[..., 3] != 7)
        _, used = cKDTree(voxels).query(np.asarray(asset.place, np.float64) * 64 + 31.5)
        assert (asset.material == classes_at(voxels, 9)[used]).mean() > 0.5
        assert {7, 8} <= set(asset.material.tolist())
        # In the thumbnail no class has the colour of another.
        shown = {(index - 1) // SHADES for index in np.unique(thumbnail(asset)) if index}
        assert shown <= set(asset.material.tolist()) and shown & {7, 8}
    train(out, trained, TrainParameters(size="small", epochs=1, precision="fp32"))
    means = evaluate_store(trained / "predictions", out, split=None).overall.means
    assert tuple(means) == ("log10 density", "hardness", "mean", "accuracy")
    assert np.isfinite(means["accuracy"])
    with np.load(next((trained / "predictions").glob("*.npz"))) as file:
        assert file["properties_si"].shape[1] == 2
        assert file["columns"].tolist() == ["density", "hardness"]
        assert file["probabilities"].shape[1] == 9
        np.testing.assert_array_equal(file["material"], file["probabilities"].argmax(axis=1))
    run("check-alignment", "--store", out, "--asset", "a", "--picture", tmp_path / "a.png")
    for name in ("report", "info", "describe", "stats"):
        run(name, out)


def test_scores_of_many_classes_are_read(tmp_path):
    logits = np.zeros((5, 254), np.float32)
    np.savez(tmp_path / "a.npz", properties=np.zeros((5, 2), np.float32), logits=logits)
    np.savez(tmp_path / "b.npz", properties=np.zeros((5, 2)), logits=np.zeros((5, 255)))
    with open_predictions(tmp_path) as read:
        arrays = read("a")
        assert arrays is not None and arrays["logits"].shape == (5, 254)
        with pytest.raises(InputError, match=r"\(5, 255\).*1 to 254"):
            read("b")


def test_of_a_finer_grid_the_class_of_most_voxels_is_taken_and_the_lowest_of_equal_ones():
    rng = np.random.default_rng(0)
    voxels = np.unique(rng.integers(0, 24, (9000, 3)), axis=0)
    material = rng.integers(0, 254, 6)[rng.integers(0, 6, len(voxels))]
    values = rng.uniform(0.1, 0.4, (len(voxels), 3))
    field = field_of_voxels(
        "here", voxels, values, resolution=256, material=material, classes=254, table=PROPERTIES
    )
    for place, own, properties in zip(field.voxels, field.material, field.properties, strict=True):
        inside = (voxels // 4 == place).all(axis=1)
        winner = np.bincount(material[inside]).argmax()
        assert own == winner
        chosen = values[inside & (material == winner)]
        expected = [*(10 ** np.log10(chosen[:, :2]).mean(axis=0)), chosen[:, 2].mean()]
        np.testing.assert_allclose(properties, expected, rtol=1e-5)


def test_more_than_a_byte_holds_are_refused_in_words(tmp_path):
    parameters = write(tmp_path, "a", 255)
    with pytest.raises(ConfigError, match="there are 255 classes, not 1 to 254"):
        build_store(parameters, tmp_path / "s.zarr")


def test_each_class_has_a_colour_of_its_own():
    assert set(MATERIAL_COLOURS) == {*range(254), 255}
    assert len(set(MATERIAL_COLOURS.values())) == 255
    assert Contents(classes=tuple("abcdefg")).background == 7
    assert Contents(classes=tuple("abcdefgh")).background == 254

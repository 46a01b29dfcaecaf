"""Sources that are not PixieVerse: other properties, no classes or many, other grids and frames."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData
from scipy.spatial import cKDTree
from support.commands import document, refused, run
from support.predictions import write_predictions
from support.synthetic import QUARTER_TURN, SMALL_SHARDS, make_asset
from support.tiny import TINY

from slatprep import build_store, compare_stores, export_store, open_store, store_statistics
from slatprep.demo.sources import write_description, write_vomp, write_voxels
from slatprep.errors import ConfigError, InputError, StoreError
from slatprep.geometry.voxels import boundary
from slatprep.inspect.check import check_alignment
from slatprep.inspect.pictures.statistics import draw_statistics
from slatprep.inspect.report.drawn import SHADES, thumbnail
from slatprep.inspect.verify import verify_store
from slatprep.learn.evaluate import evaluate_store
from slatprep.learn.metrics import OURS
from slatprep.learn.predictions import open_predictions
from slatprep.learn.train import TrainParameters, train
from slatprep.parameters import (
    AlignParameters,
    BuildParameters,
    ConsensusParameters,
    NormalizeParameters,
    PixieverseSource,
    SampleParameters,
    SlatSource,
    WitnessParameters,
)
from slatprep.particles.fields import stored_field
from slatprep.readers.voxel_sets import field_of_voxels
from slatprep.records import MATERIAL_COLOURS, Contents, Engine, SourceRoots
from slatprep.store import Store

TABLE = [
    {"name": "density", "unit": "kg/m^3", "scale": "log10"},
    {"name": "yield_stress", "unit": "Pa", "scale": "log10"},
    {"name": "friction_angle", "unit": "degree", "scale": "linear", "least": -10, "most": 90},
]
SOLID = [
    {"name": "yield_stress", "unit": "Pa", "scale": "log10"},
    {"name": "youngs_modulus", "unit": "Pa", "scale": "log10"},
    {"name": "density", "unit": "kg/m^3", "scale": "log10"},
    {"name": "poissons_ratio", "unit": "1", "scale": "linear", "least": 0, "most": 0.5},
]
"""PixieVerse's three and another, which stands before them."""
HARD = [TABLE[0], {"name": "hardness", "unit": "1", "scale": "linear"}]
NAMES = [str(one["name"]) for one in TABLE]
KNOWN = AlignParameters(engine=Engine.KNOWN)
UNCHECKED = SourceRoots(Path(), Path(), plausibility="off")
STRICT = SampleParameters("nearest", max_unphysical=1)


def voxels_of(seed: int, slabs: int = 0) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Return voxels, columns and classes of the synthetic L, or of so many slabs across it."""
    grid = make_asset(seed).grid
    voxels = np.argwhere(grid[..., 3] != 7)
    rows = grid[tuple(voxels.T)]
    material = rows[:, 3].astype(np.uint8)
    if slabs:
        material = ((voxels[:, 0] * 37 + 5) % slabs).astype(np.uint8)
    columns = {
        "density": rows[:, 0],
        "youngs_modulus": rows[:, 1],
        "poissons_ratio": rows[:, 2],
        "yield_stress": 10.0 ** (4 + material + voxels[:, 0] / 64),
        "friction_angle": -5.0 + 40.0 * material + voxels[:, 2] / 10,
        "hardness": material / 10.0,
    }
    return voxels, columns, material


def write(root: Path, names: str, form: str = "npz", slabs: int = 0, **said: Any) -> None:
    """Write plain voxels, and SLATs that lie a quarter turn away; see `voxels_of`."""
    (root / "slat").mkdir()
    write_description(root / "voxels", **{"properties": TABLE, "classes": True} | said)
    for seed, name in enumerate(names):
        voxels, columns, material = voxels_of(seed, slabs)
        arrays = {"voxels": voxels, **columns, "material": material, "segment": np.zeros(3)}
        write_voxels(root / "voxels", name, form, arrays)
        asset = make_asset(seed)
        np.savez(root / "slat" / f"{name}.npz", coords=asset.coords, feats=asset.feats)


def parameters_of(
    root: Path, adapter: str = "voxels", transform: str = "", **groups: object
) -> BuildParameters:
    """Return the parameters of a build, with frames that are known where they are named."""
    if transform:
        groups["align"] = KNOWN
    source = PixieverseSource(root / "voxels", adapter=adapter, transform=transform)
    usual = {"sample": SampleParameters("nearest"), "store": SMALL_SHARDS}
    return BuildParameters(source, SlatSource(root / "slat"), **usual | groups)  # type: ignore[arg-type]


def built(root: Path, adapter: str = "voxels", **groups: Any) -> Store:
    """Build a store of such parameters, and open it."""
    return open_store(build_store(parameters_of(root, adapter, **groups), root / "s.zarr").store)


@pytest.mark.parametrize(("form", "classes"), [("npz", True), ("hdf5", False)])
def test_properties_of_any_table_are_those_of_the_nearest_voxels(tmp_path, form, classes):
    write(tmp_path, "abc", form=form, classes=classes)
    out = tmp_path / "s.zarr"
    summary = build_store(parameters_of(tmp_path), out)
    assert summary.verdicts == {"good": 3}
    store = open_store(out)
    assert store.attributes["property_columns"] == NAMES
    assert store.attributes["property_units"] == ["kg/m^3", "Pa", "degree"]
    assert [store.attributes["normalization"][n]["log10"] for n in NAMES] == [True, True, False]
    assert bool(store.contents.classes) is classes
    for seed, asset in enumerate(store):
        voxels, columns, material = voxels_of(seed)
        _, used = cKDTree(voxels).query(np.asarray(asset.place, np.float64) * 64 + 31.5)
        assert asset.valid.all()
        np.testing.assert_array_equal(asset.material, material[used] if classes else 0 * used)
        for name, values in zip(NAMES, asset.properties_si.T, strict=True):
            np.testing.assert_allclose(values, columns[name][used], rtol=1e-5, atol=1e-4)
    assert not verify_store(out).findings
    told = run("info", out).stdout
    assert '"FILE.json" under [pairing]' in told and "obj_ids_metadata" not in told

    found = store_statistics(store)
    columns = [voxels_of(seed)[1] for seed in range(3)]
    assert [one.name for one in found.classes][:1] == ["jelly" if classes else "annotated"]
    for name, own in found.total.field.properties.items():
        values = np.concatenate([each[name] for each in columns]).astype(float)
        assert own.si.mean == pytest.approx(values.mean(), rel=1e-5)
        assert (own.log10 is None) is (name == "friction_angle")
        assert own.si.most == pytest.approx(values.max(), rel=1e-5)
    assert found.joint is not None and found.joint.names == ("density", "yield_stress")
    assert draw_statistics(store, found, "svg").startswith(b"<?xml")
    assert compare_stores(store, open_store(out)).same
    assert build_store(parameters_of(tmp_path), out).build_id == summary.build_id


def test_without_classes_no_accuracy_is_claimed(tmp_path):
    write(tmp_path, "abcdefgh", classes=False)
    out, trained = built(tmp_path).path, tmp_path / "run"
    summary = train(out, trained, TrainParameters(size=TINY, epochs=1, precision="fp32"))
    assert np.isnan(summary.history[-1].val_accuracy)
    assert np.isfinite(summary.history[-1].val_loss)
    means = evaluate_store(trained / "predictions", out, split=None).methods[OURS].means
    assert np.isnan(means["accuracy"]) and np.isfinite(means["mean"])


def test_classes_of_a_source_s_own_are_told_by_their_names(tmp_path):
    own = ["soft wood", "steel"]
    write(tmp_path, "ab", classes=own, properties=SOLID)
    store = built(tmp_path)
    assert store.attributes["material_classes"] == own
    assert store.contents.n_classes == 2
    assert not verify_store(store.path).findings
    found = store_statistics(store)
    counts = np.sum([np.bincount(voxels_of(seed)[2]) for seed in range(2)], axis=0)
    assert [one.name for one in found.classes] == own
    assert [found.total.field.classes[name] for name in own] == pytest.approx(counts / counts.sum())
    with pytest.raises(StoreError, match=r"has classes of its own \(soft wood, steel\)"):
        stored_field(store, "a")
    # Another name is another table: nothing is taken over.
    write_description(tmp_path / "voxels", SOLID, ("a", "b"))
    assert built(tmp_path).attributes["material_classes"] == ["a", "b"]


def test_particles_and_points_take_their_properties_by_name(tmp_path):
    write(tmp_path, "a", properties=SOLID)
    store = built(tmp_path)
    export_store(store, tmp_path / "ply", "ply")
    asset = store.asset("a")
    rows = PlyData.read(str(tmp_path / "ply" / "a.ply"))["vertex"].data
    for column, name in enumerate(("yield_stress", "E", "density", "nu")):
        np.testing.assert_allclose(rows[name], asset.properties_si[:, column], rtol=1e-6)
    for points in ("slat", "grid"):
        field = stored_field(store, "a", points)
        assert field.properties[:, 2].max() < 0.5 < field.properties[:, 1].min()
        assert field.properties[:, 0].min() > field.properties[:, 1].max()


@pytest.mark.parametrize("side", [32, 128])
def test_other_grids_lie_where_they_should(tmp_path, side):
    write(tmp_path, "a", resolution=side)
    voxels, columns, material = voxels_of(0)
    if side == 32:
        voxels, rows = np.unique(voxels // 2, axis=0, return_index=True)
    else:
        corners = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        rows = np.repeat(np.arange(len(voxels)), 8)
        voxels = (2 * voxels[:, None] + corners).reshape(-1, 3)
    arrays = {name: column[rows] for name, column in columns.items()}
    np.savez(tmp_path / "voxels" / "a.npz", voxels=voxels, material=material[rows], **arrays)
    np.save(tmp_path / "voxels" / "frame.npy", QUARTER_TURN)
    (asset,) = built(tmp_path, transform="frame.npy")
    apart, used = cKDTree((voxels + 0.5) / side - 0.5).query(np.asarray(asset.place, np.float64))
    assert apart.max() < 2 / side
    right = np.isclose(asset.properties_si[:, 1], arrays["yield_stress"][used], rtol=0.1)
    assert right.mean() > 0.95


def test_vomp_s_voxels_are_read_and_share_the_frame_of_their_latents(tmp_path):
    (tmp_path / "slat").mkdir()
    for seed, name in enumerate("ab"):
        write_vomp(tmp_path / "voxels", name, *voxels_of(seed)[:2])
        asset = make_asset(seed)
        coords = np.argwhere(boundary(asset.grid[..., 3] != 7)).astype(np.uint8)
        np.savez(tmp_path / "slat" / f"{name}.npz", coords=coords, feats=asset.feats[: len(coords)])
    store = built(tmp_path, "vomp", align=KNOWN)
    assert store.column("verdict").tolist() == ["good", "good"]
    assert store.attributes["material_classes"] == []
    asset = store.asset("a")
    np.testing.assert_array_equal(asset.transform, np.eye(4))
    assert asset.columns["engine"] == "known"
    truth = make_asset(0).grid[tuple(asset.coords.T)]
    np.testing.assert_allclose(asset.properties_si, truth[:, [1, 0, 2]], rtol=1e-5)


@pytest.mark.parametrize("suffix", ["json", "npy"])
def test_a_frame_that_is_known_is_checked(tmp_path, suffix):
    write(tmp_path, "ab")
    for name, frame in {"a": QUARTER_TURN, "b": QUARTER_TURN.T}.items():
        path = tmp_path / "voxels" / f"{name}.frame.{suffix}"
        if suffix == "npy":
            np.save(path, frame)
        else:
            path.write_text(json.dumps(frame.tolist()))
    store = built(tmp_path, transform=f"{{id}}.frame.{suffix}")
    right, wrong = store.asset("a"), store.asset("b")
    assert right.columns["verdict"] == "good" and wrong.columns["verdict"] == "failed"
    assert wrong.columns["confidence"] < 0.5 < 0.9 < right.columns["confidence"]
    np.testing.assert_array_equal(right.transform, QUARTER_TURN)
    # Nothing was searched, so there is no margin to compare.
    assert np.isnan(right.columns["margin"])
    assert check_alignment(store, "a").ok


@pytest.mark.usefixtures("files_are_old")
def test_every_file_that_decides_an_asset_is_looked_at_again(tmp_path):
    write(tmp_path, "ab")
    frame = tmp_path / "voxels" / "frame.json"
    frame.write_text(json.dumps(QUARTER_TURN.tolist()))
    parameters, out = parameters_of(tmp_path, transform="frame.json"), tmp_path / "s.zarr"
    assert build_store(parameters, out).verdicts == {"good": 2}
    frame.write_text(json.dumps(QUARTER_TURN.T.tolist()))
    assert build_store(parameters, out).verdicts == {"failed": 2}
    frame.write_text(json.dumps(QUARTER_TURN.tolist()))
    about = tmp_path / "voxels" / "source.json"
    about.write_text(about.read_text().replace('"most": 90', '"most": 1'))
    strict = replace(parameters, sample=STRICT)
    assert build_store(strict, out).n_unphysical > 0
    about.write_text(about.read_text().replace('"most": 1', '"most": 90'))
    assert build_store(strict, out).n_unphysical == 0


def test_a_frame_that_is_no_similarity_fails_its_asset_alone(tmp_path):
    wrong = {
        "b": (np.eye(3), "4x4"),
        "c": (np.diag([1.0, 1, -1, 1]), "mirror"),
        "d": (np.diag([1.0, 2, 1, 1]), "shear"),
        "e": (np.full((4, 4), np.nan), "finite"),
        "f": (np.diag([1e6, 1e6, 1e6, 1.0]), "scale 1e"),
        "g": (np.eye(4) + 1e300 * np.eye(4, k=3), "out of a unit cube"),
    }
    write(tmp_path, "abcdefg")
    for name, (frame, _) in {"a": (QUARTER_TURN, ""), **wrong}.items():
        (tmp_path / "voxels" / f"{name}.json").write_text(json.dumps(frame.tolist()))
    summary = build_store(parameters_of(tmp_path, transform="{id}.json"), tmp_path / "s.zarr")
    assert summary.statuses == {"ok": 1, "failed": 6, "skipped": 0}
    problems = dict(summary.problems)
    assert [name for name, (_, said) in wrong.items() if said not in problems[name]] == []


def test_what_is_not_there_or_does_not_fit_is_said(tmp_path):
    write(tmp_path, "a")
    with pytest.raises(ConfigError, match="no adapter 'gvm'; expected pixieverse, voxels, vomp"):
        build_store(parameters_of(tmp_path, "gvm"), tmp_path / "s.zarr")
    pixie = parameters_of(tmp_path, normalize=NormalizeParameters("pixie"))
    with pytest.raises(ConfigError, match="Pixie publishes no range of yield_stress"):
        build_store(pixie, tmp_path / "s.zarr")
    about = tmp_path / "voxels" / "source.json"
    for text in ("", "{}", '{"properties": []}', '{"properties": [{"name": "A b"}]}'):
        about.write_text(text)
        with pytest.raises(ConfigError, match=r"source\.json: does not describe plain voxels"):
            build_store(parameters_of(tmp_path), tmp_path / "s.zarr")
    about.unlink()
    with pytest.raises(ConfigError, match=r"source\.json: cannot be read"):
        build_store(parameters_of(tmp_path), tmp_path / "s.zarr")


def test_pixie_s_grids_are_not_measured_against_other_properties(tmp_path):
    write(tmp_path, "a")
    out = built(tmp_path).path
    with pytest.raises(ConfigError, match="holds density, yield_stress, friction_angle"):
        evaluate_store(None, out, None, grids={"m": tmp_path / "slat"}, splits={})
    predictions = write_predictions(tmp_path / "p", out)
    words = ("evaluate", predictions, "--store", out, "--split", "all", "--beside")
    told = refused(*words, "pixie")
    assert "which the scores of --beside pixie do not" in told
    # Columns of another CSV are those of this store.
    own = tmp_path / "own.csv"
    own.write_text("method,log10 yield_stress,mean\nmine,0.25,0.5\n")
    (beside,) = document(*words, own)["beside"]
    assert beside["means"] == {"log10 yield_stress": 0.25, "mean": 0.5}


def test_properties_next_to_the_border_of_two_labels_are_verified(tmp_path):
    """Without classes labels are rounded properties, and a store rounds them once more."""
    write(tmp_path, "a", classes=False)
    voxels, columns, _ = voxels_of(0)
    half = voxels[:, 1] > np.median(voxels[:, 1])
    near = np.where(half, 4.5000005, 4.4999995).astype(np.float32)  # of 0 to 90 a border is at 4.5
    near[:2] = 0.0, 90.0
    arrays = {"voxels": voxels, **columns, "friction_angle": near}
    for name in ("density", "yield_stress"):
        arrays[name] = np.full(len(voxels), 1000.0)
    np.savez(tmp_path / "voxels" / "a.npz", **arrays)
    assert not verify_store(built(tmp_path).path).findings


def class_names(count: int) -> list[str]:
    return [f"class {k}" for k in range(count)]


def test_as_many_as_a_byte_holds_are_looked_up_and_counted(tmp_path):
    write(tmp_path, "ab", classes=class_names(254), properties=HARD, slabs=254)
    store = built(tmp_path)
    assert store.contents.n_classes == 254
    assert store.attributes["background"] == store.contents.background == 254
    assert not verify_store(store.path, sources=True).findings
    counts = np.zeros(254, int)
    for seed, asset in enumerate(store):
        voxels, _, material = voxels_of(seed, 254)
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
    assert [one.name for one in found.classes] == class_names(254)
    for k, one in enumerate(found.classes):
        assert one.field.voxels == counts[k]
    assert found.total.field.unannotated == found.total.slat.unannotated == 0
    picture = draw_statistics(store, found, "svg")
    named = picture.count(b"<!-- class ")
    assert named < 20 and b"<!-- and %d more -->" % (np.count_nonzero(counts) - named) in picture


def test_nine_classes_and_other_properties_go_all_the_way_to_scores(tmp_path):
    write(tmp_path, "abcdefgh", classes=class_names(9), properties=HARD, slabs=9)
    consensus, witness = ConsensusParameters(settle=True), WitnessParameters(settle=True)
    store = built(tmp_path, sample=SampleParameters(), consensus=consensus, witness=witness)
    out, trained = store.path, tmp_path / "run"
    assert store.contents.background == 254
    assert not verify_store(out).findings
    for form in ("npz", "hdf5", "webdataset"):
        assert export_store(out, tmp_path / form, form).assets == 8
    with pytest.raises(StoreError, match="has no youngs_modulus and no poissons_ratio, only dens"):
        export_store(out, tmp_path / "ply", "ply")
    # By the vote, most voxels away from the slabs' borders have the class of their place.
    for seed, asset in enumerate(store):
        voxels, _, material = voxels_of(seed, 9)
        _, used = cKDTree(voxels).query(np.asarray(asset.place, np.float64) * 64 + 31.5)
        assert (asset.material == material[used]).mean() > 0.5
        assert {7, 8} <= set(asset.material.tolist())
        # In the thumbnail no class has the colour of another.
        shown = {(index - 1) // SHADES for index in np.unique(thumbnail(asset)) if index}
        assert shown <= set(asset.material.tolist()) and shown & {7, 8}
    train(out, trained, TrainParameters(size=TINY, epochs=1, precision="fp32"))
    means = evaluate_store(trained / "predictions", out, split=None).methods[OURS].means
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


@pytest.mark.parametrize("side", [48, 96, 256])
def test_of_a_finer_grid_the_class_of_most_voxels_is_taken_and_the_lowest_of_equal_ones(side):
    rng = np.random.default_rng(0)
    voxels = np.unique(rng.integers(0, 16, (2700, 3)), axis=0)
    material = rng.integers(0, 254, 6)[rng.integers(0, 6, len(voxels))]
    values = rng.uniform(0.1, 0.4, (len(voxels), 3))
    roots = replace(UNCHECKED, contents=Contents(classes=tuple(class_names(254))))
    field = field_of_voxels("here", voxels, values, resolution=side, material=material, roots=roots)
    for place, own, properties in zip(field.voxels, field.material, field.properties, strict=True):
        inside = (np.floor((voxels + 0.5) * 64 / side) == place).all(axis=1)
        if side < 64:  # A cell takes the voxel at its centre.
            inside = (np.floor((place + 0.5) * side / 64) == voxels).all(axis=1)
        winner = np.bincount(material[inside]).argmax()
        assert own == winner
        chosen = values[inside & (material == winner)]
        expected = [*(10 ** np.log10(chosen[:, :2]).mean(axis=0)), chosen[:, 2].mean()]
        np.testing.assert_allclose(properties, expected, rtol=1e-5)


def test_a_point_without_usable_values_is_occupied_and_the_end_is_of_the_last_cell():
    values = np.array([[1e5, 1e3, 0.3], [np.nan, 1e3, 0.3]])
    points = np.array([[0.5] * 3, [0.0] * 3])
    field = field_of_voxels("here", points, values, max_unphysical=0.5, roots=UNCHECKED)
    assert field.voxels.tolist() == [[63] * 3]
    assert np.argwhere(field.occupancy).tolist() == [[32] * 3, [63] * 3]


def test_each_class_has_a_colour_of_its_own():
    assert set(MATERIAL_COLOURS) == {*range(254), 255}
    assert len(set(MATERIAL_COLOURS.values())) == 255
    assert Contents(classes=tuple("abcdefg")).background == 7
    assert Contents(classes=tuple("abcdefgh")).background == 254

"""Sources that are not PixieVerse: other properties, no classes, other grids, known frames."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from plyfile import PlyData
from scipy.spatial import cKDTree
from support.commands import run
from support.synthetic import QUARTER_TURN, SMALL_SHARDS, make_asset

from slatprep import build_store, compare_stores, export_store, open_store, store_statistics
from slatprep.errors import ConfigError, StoreError
from slatprep.inspect.check import check_alignment
from slatprep.inspect.pictures.statistics import draw_statistics
from slatprep.inspect.verify import verify_store
from slatprep.learn.compare import compare_methods
from slatprep.learn.metrics import evaluate_store
from slatprep.learn.train import TrainParameters, train
from slatprep.parameters import (
    AlignParameters,
    BuildParameters,
    NormalizeParameters,
    PixieverseSource,
    SampleParameters,
    SlatSource,
)
from slatprep.particles.fields import stored_field
from slatprep.records import Engine

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
NAMES = [str(one["name"]) for one in TABLE]
KNOWN = AlignParameters(engine=Engine.KNOWN)


def voxels_of(seed: int) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Return the voxels of the synthetic L, its columns and its classes."""
    grid = make_asset(seed).grid
    voxels = np.argwhere(grid[..., 3] != 7)
    rows = grid[tuple(voxels.T)]
    material = rows[:, 3].astype(np.uint8)
    columns = {
        "density": rows[:, 0],
        "youngs_modulus": rows[:, 1],
        "poissons_ratio": rows[:, 2],
        "yield_stress": 10.0 ** (4 + material + voxels[:, 0] / 64),
        "friction_angle": -5.0 + 40.0 * material + voxels[:, 2] / 10,
    }
    return voxels, columns, material


def write(
    root: Path, names: str, *, classes: bool | list[str] = True, form: str = "npz", **said: object
) -> None:
    """Write plain voxels, and SLATs that lie a quarter turn away."""
    (root / "slat").mkdir(parents=True)
    source = root / "voxels"
    source.mkdir()
    about = {"properties": TABLE, "classes": classes} | said
    (source / "source.json").write_text(json.dumps(about))
    for seed, name in enumerate(names):
        voxels, columns, material = voxels_of(seed)
        arrays = {"voxels": voxels, **columns, "material": material, "segment": np.zeros(3)}
        if form == "npz":
            np.savez(source / f"{name}.npz", **arrays)
        else:
            with h5py.File(source / f"{name}.h5", "w") as file:
                for key, array in arrays.items():
                    file[key] = array
        asset = make_asset(seed)
        np.savez(root / "slat" / f"{name}.npz", coords=asset.coords, feats=asset.feats)


def parameters_of(
    root: Path, adapter: str = "voxels", transform: str = "", **groups: object
) -> BuildParameters:
    """Return the parameters of a build, with frames that are known where they are named."""
    if transform:
        groups["align"] = KNOWN
    return BuildParameters(
        PixieverseSource(root / "voxels", adapter=adapter, transform=transform),
        SlatSource(root / "slat"),
        sample=SampleParameters(method="nearest"),
        store=SMALL_SHARDS,
        **groups,  # type: ignore[arg-type]
    )


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
        places = np.asarray(asset.place, np.float64) * 64 + 31.5
        _, used = cKDTree(voxels).query(places)
        assert asset.valid.all()
        np.testing.assert_array_equal(asset.material, material[used] if classes else 0 * used)
        for column, name in enumerate(NAMES):
            np.testing.assert_allclose(
                asset.properties_si[:, column], columns[name][used], rtol=1e-5, atol=1e-4
            )
    verification = verify_store(out)
    assert not verification.findings
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
    # Nothing is done twice, and another description is another source.
    assert build_store(parameters_of(tmp_path), out).build_id == summary.build_id
    about = json.loads((tmp_path / "voxels" / "source.json").read_text())
    about["properties"][2]["most"] = 1.0
    (tmp_path / "voxels" / "source.json").write_text(json.dumps(about))
    strict = replace(parameters_of(tmp_path), sample=SampleParameters("nearest", max_unphysical=1))
    assert build_store(strict, out).n_unphysical > 0


def test_without_classes_no_accuracy_is_claimed(tmp_path):
    write(tmp_path, "abcdefgh", classes=False)
    out, trained = tmp_path / "s.zarr", tmp_path / "run"
    build_store(parameters_of(tmp_path), out)
    summary = train(out, trained, TrainParameters(size="small", epochs=1, precision="fp32"))
    assert np.isnan(summary.history[-1].val_accuracy)
    assert np.isfinite(summary.history[-1].val_loss)
    means = evaluate_store(trained / "predictions", out, split=None).overall.means
    assert np.isnan(means["accuracy"])
    assert np.isfinite(means["mean"])


def test_classes_of_a_source_s_own_are_told_by_their_names(tmp_path):
    own = ["soft wood", "steel"]
    write(tmp_path, "ab", classes=own, properties=SOLID)
    out = tmp_path / "s.zarr"
    build_store(parameters_of(tmp_path), out)
    store = open_store(out)
    assert store.attributes["material_classes"] == own
    assert store.contents.n_classes == 2
    assert not verify_store(out).findings
    found = store_statistics(store)
    counts = np.sum([np.bincount(voxels_of(seed)[2]) for seed in range(2)], axis=0)
    assert [one.name for one in found.classes] == own
    shares = [found.total.field.classes[name] for name in own]
    assert shares == pytest.approx(counts / counts.sum())
    with pytest.raises(StoreError, match=r"has classes of its own \(soft wood, steel\)"):
        stored_field(store, "a")
    # Another name is another table: nothing is taken over.
    about = json.loads((tmp_path / "voxels" / "source.json").read_text()) | {"classes": ["a", "b"]}
    (tmp_path / "voxels" / "source.json").write_text(json.dumps(about))
    build_store(parameters_of(tmp_path), out)
    assert open_store(out).attributes["material_classes"] == ["a", "b"]


def test_particles_and_points_take_their_properties_by_name(tmp_path):
    write(tmp_path, "a", properties=SOLID)
    out = tmp_path / "s.zarr"
    build_store(parameters_of(tmp_path), out)
    export_store(out, tmp_path / "ply", "ply")
    asset = open_store(out).asset("a")
    rows = PlyData.read(str(tmp_path / "ply" / "a.ply"))["vertex"].data
    for column, name in enumerate(("yield_stress", "E", "density", "nu")):
        np.testing.assert_allclose(rows[name], asset.properties_si[:, column], rtol=1e-6)
    for points in ("slat", "grid"):
        field = stored_field(open_store(out), "a", points)
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
    build_store(parameters_of(tmp_path, transform="frame.npy"), tmp_path / "s.zarr")
    (asset,) = open_store(tmp_path / "s.zarr")
    centres = (voxels + 0.5) / side - 0.5
    apart, used = cKDTree(centres).query(np.asarray(asset.place, np.float64))
    assert apart.max() < 2 / side
    right = np.isclose(asset.properties_si[:, 1], arrays["yield_stress"][used], rtol=0.1)
    assert right.mean() > 0.95


def test_vomp_s_voxels_are_read_and_share_the_frame_of_their_latents(tmp_path):
    (tmp_path / "slat").mkdir()
    folder = tmp_path / "voxels" / "voxels"
    folder.mkdir(parents=True)
    names = ("x", "y", "z", "youngs_modulus", "poissons_ratio", "density")
    for seed, name in enumerate("ab"):
        grid = make_asset(seed).grid
        voxels = np.argwhere(grid[..., 3] != 7)
        density, modulus, ratio, _ = grid[tuple(voxels.T)].T
        dtype = [*((key, "<f4") for key in names), ("segment_id", "<U32")]
        rows = np.zeros(len(voxels), dtype=dtype)
        corners = voxels / 64 - 0.5
        for key, column in zip(names, (*corners.T, modulus, ratio, density), strict=True):
            rows[key] = column
        np.savez(folder / f"{name}_with_materials.npz", voxel_data=rows, other=np.zeros(2))
        edge = ~np.all(
            [np.roll(grid[..., 3] != 7, s, a) for s in (-1, 1) for a in range(3)], axis=0
        )
        slat = voxels[edge[tuple(voxels.T)]]
        feats = make_asset(seed).feats[: len(slat)]
        np.savez(tmp_path / "slat" / f"{name}.npz", coords=slat.astype(np.uint8), feats=feats)
    summary = build_store(parameters_of(tmp_path, "vomp", align=KNOWN), tmp_path / "s.zarr")
    assert summary.verdicts == {"good": 2}
    store = open_store(tmp_path / "s.zarr")
    assert store.attributes["material_classes"] == []
    asset = store.asset("a")
    np.testing.assert_array_equal(asset.transform, np.eye(4))
    assert asset.columns["engine"] == "known"
    truth = make_asset(0).grid[tuple(asset.coords.T)]
    np.testing.assert_allclose(asset.properties_si, truth[:, [1, 0, 2]], rtol=1e-5)


@pytest.mark.parametrize("suffix", ["json", "npy"])
def test_a_frame_that_is_known_is_checked(tmp_path, suffix):
    write(tmp_path, "ab")
    frames = {"a": QUARTER_TURN, "b": QUARTER_TURN.T}  # of b, turned the wrong way
    for name, frame in frames.items():
        path = tmp_path / "voxels" / f"{name}.frame.{suffix}"
        if suffix == "npy":
            np.save(path, frame)
        else:
            path.write_text(json.dumps(frame.tolist()))
    parameters = parameters_of(tmp_path, transform=f"{{id}}.frame.{suffix}")
    out = tmp_path / "s.zarr"
    build_store(parameters, out)
    store = open_store(out)
    right, wrong = store.asset("a"), store.asset("b")
    assert right.columns["verdict"] == "good"
    assert wrong.columns["verdict"] == "failed"
    assert wrong.columns["confidence"] < 0.5 < 0.9 < right.columns["confidence"]
    np.testing.assert_array_equal(right.transform, QUARTER_TURN)
    # Nothing was searched, so there is no margin to compare.
    assert np.isnan(right.columns["margin"])
    assert check_alignment(store, "a").ok
    # The file is a source as others are: another frame is other work.
    np.save(tmp_path / "voxels" / "b.frame.npy", QUARTER_TURN)
    (tmp_path / "voxels" / "b.frame.json").write_text(json.dumps(QUARTER_TURN.tolist()))
    assert build_store(parameters, out).verdicts == {"good": 2}


@pytest.mark.usefixtures("files_are_old")
def test_every_file_that_decides_an_asset_is_looked_at_again(tmp_path):
    write(tmp_path, "ab")
    frame = tmp_path / "voxels" / "frame.json"
    frame.write_text(json.dumps(QUARTER_TURN.tolist()))
    parameters = parameters_of(tmp_path, transform="frame.json")
    out = tmp_path / "s.zarr"
    assert build_store(parameters, out).verdicts == {"good": 2}
    frame.write_text(json.dumps(QUARTER_TURN.T.tolist()))
    assert build_store(parameters, out).verdicts == {"failed": 2}
    frame.write_text(json.dumps(QUARTER_TURN.tolist()))
    about = tmp_path / "voxels" / "source.json"
    about.write_text(about.read_text().replace('"most": 90', '"most": 1'))
    strict = replace(parameters, sample=SampleParameters("nearest", max_unphysical=1))
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
    with pytest.raises(ConfigError, match="Pixie publishes no range of yield_stress"):
        build_store(
            parameters_of(tmp_path, normalize=NormalizeParameters("pixie")), tmp_path / "s.zarr"
        )
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
    build_store(parameters_of(tmp_path), tmp_path / "s.zarr")
    with pytest.raises(ConfigError, match="holds density, yield_stress, friction_angle"):
        compare_methods(None, {"m": tmp_path / "slat"}, tmp_path / "s.zarr", None, splits={})


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
    out = build_store(parameters_of(tmp_path), tmp_path / "s.zarr").store
    assert not verify_store(str(out)).findings

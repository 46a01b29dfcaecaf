"""USD is read back by OpenUSD, and where Newton is, by its importer; then it falls."""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.commands import refused, run
from support.exports import hold_colours, index_of
from support.made_store import make_store
from support.synthetic import JELLY, QUARTER_TURN, Dataset

from slatprep.errors import ConfigError
from slatprep.export import ExportOptions, export_store
from slatprep.export.usd import bin_materials
from slatprep.geometry.frames import voxel_centres
from slatprep.pipeline.dataset import build_store
from slatprep.records import Contents
from slatprep.records.encoders import LATENTS
from slatprep.records.yielding import MAX_POISSON, YIELDING
from slatprep.store import open_store
from slatprep.store.records import StoredRecords

Usd, UsdGeom, UsdPhysics, UsdShade, UsdValidation = (
    pytest.importorskip(f"pxr.{name}", reason="usd-core has no wheel for this machine")
    for name in ("Usd", "UsdGeom", "UsdPhysics", "UsdShade", "UsdValidation")
)
SIZE = 0.4
NEWTON = pytest.mark.skipif(
    importlib.util.find_spec("newton") is None, reason="Newton is not installed: make simulate"
)


@pytest.fixture(scope="module")
def exported(mixed_build: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export all assets of the store of `mixed`; nobody may change the files."""
    out = tmp_path_factory.mktemp("usd") / "usd"
    words = ("--format", "usd", "--size", SIZE, "--out", out)
    told = run("export", mixed_build.store, *words).output
    assert "up to 2 materials an asset: E and nu are those of the store" in told
    return out


@pytest.mark.parametrize("size", ["1e308", "1e-300"])
def test_a_size_whose_masses_no_file_holds_is_refused(size, mixed_build, tmp_path):
    words = ("--format", "usd", "--size", size, "--out", tmp_path / "usd")
    told = refused("export", mixed_build.store, *words)
    assert f"size is {float(size):g}; expected a length" in told


def solid_of(mixed: Dataset, asset_id: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres (N, 3) of the solid in the SLAT frame, and density, E, nu, class."""
    grid = mixed.assets[asset_id].grid
    voxels = np.argwhere(grid[..., 3] != 7)
    centres = ((voxels + 0.5) / 64 - 0.5) @ QUARTER_TURN[:3, :3].T
    return centres, grid[tuple(voxels.T)]


def test_masses_of_a_bent_object_are_those_of_its_bent_voxels(deformed_build, tmp_path):
    store, out, uneven = open_store(deformed_build.store), tmp_path / "usd", list[float]()
    finest = SIZE
    export_store(store.path, out, format="usd", verdicts="all", options=ExportOptions(size=SIZE))
    for entry in index_of(out):
        asset = store.asset(entry["asset_id"])
        stage = Usd.Stage.Open(str(out / entry["file"]))
        points = UsdGeom.Points(stage.GetPrimAtPath("/Asset/Points"))
        mass = np.array(points.GetPrim().GetAttribute("physics:masses").Get())
        # How large each voxel is in the SLAT frame: by where its neighbourhood goes, both ways.
        carried, centres = StoredRecords(store).place_map(asset), voxel_centres(asset.field.voxels)
        slopes = [
            (carried.to_slat(centres + step) - carried.to_slat(centres - step)) / 2e-4
            for step in 1e-4 * np.eye(3)
        ]
        volumes = abs(np.linalg.det(np.stack(slopes, axis=-1))) * (SIZE / 64) ** 3
        true = asset.field.properties[:, 1] * volumes
        np.testing.assert_allclose(mass, true, rtol=1e-4)
        assert entry["kilograms"] == pytest.approx(true.sum(), rel=1e-5)
        uneven.append(np.ptp(volumes) / volumes.mean())
        finest = min(finest, np.cbrt(volumes.mean()))
    assert max(uneven) > 0.01 > min(uneven)  # Bent ones, and stretched ones alone.
    stage = Usd.Stage.Open(str(out / "scene.usda"))
    scene = stage.GetPrimAtPath("/World/PhysicsScene")
    assert scene.GetAttribute("newton:mpm:voxelSize").Get() == pytest.approx(2 * finest, rel=1e-4)


def test_voxels_of_a_coarser_grid_are_larger(tmp_path):
    made = tmp_path / "s.zarr"
    make_store(made, Contents(latents=LATENTS["trellis2-512"]))
    export_store(made, tmp_path / "usd", "usd", assets=["cup"], options=ExportOptions("slat"))
    stage, asset = Usd.Stage.Open(str(tmp_path / "usd" / "cup.usdc")), open_store(made)["cup"]
    mass = stage.GetPrimAtPath("/Asset/Points").GetAttribute("physics:masses").Get()
    true = asset.properties_si[asset.valid, 1] / 32**3
    np.testing.assert_allclose(mass, true, rtol=1e-6)


def materials_of(stage: Any, path: str) -> dict[str, np.ndarray]:
    """Return the attributes of each point's material, by name, as a reader of subsets does."""
    prim = stage.GetPrimAtPath(path)
    count = len(prim.GetAttribute("points").Get())
    read: dict[str, np.ndarray] = {}
    seen = np.zeros(count, int)
    for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
        assert subset.GetElementTypeAttr().Get() == "point"
        rows = np.array(subset.GetIndicesAttr().Get())
        seen[rows] += 1
        bound = UsdShade.MaterialBindingAPI(subset.GetPrim()).GetDirectBinding("physics")
        material = bound.GetMaterial().GetPrim()
        assert "NewtonMPMMaterialAPI" in material.GetMetadata("apiSchemas").GetAppliedItems()
        for attribute in material.GetAuthoredAttributes():
            read.setdefault(attribute.GetName(), np.zeros(count))[rows] = attribute.Get()
    assert (seen == 1).all()
    return read


def test_openusd_reads_back_places_masses_and_materials(exported, mixed):
    for entry in index_of(exported):
        stage = Usd.Stage.Open(str(exported / entry["file"]))
        assert UsdGeom.GetStageMetersPerUnit(stage) == UsdPhysics.GetStageKilogramsPerUnit(stage)
        assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Z"
        centres, truth = solid_of(mixed, entry["asset_id"])
        points = UsdGeom.Points(stage.GetPrimAtPath("/Asset/Points"))
        positions = np.array(points.GetPointsAttr().Get())
        np.testing.assert_allclose(positions, centres * SIZE, atol=1e-3)
        width = SIZE / 64
        np.testing.assert_allclose(points.GetWidthsAttr().Get(), [width], rtol=1e-3)
        mass = np.array(points.GetPrim().GetAttribute("physics:masses").Get())
        np.testing.assert_allclose(mass, truth[:, 0] * width**3, rtol=2e-3)
        hold_colours(truth[:, 3], np.rint(255 * np.array(points.GetDisplayColorAttr().Get())))
        read = materials_of(stage, "/Asset/Points")
        np.testing.assert_allclose(read["newton:mpm:youngsModulus"], truth[:, 1], rtol=1e-4)
        np.testing.assert_allclose(read["newton:mpm:poissonsRatio"], truth[:, 2], atol=1e-5)
        np.testing.assert_allclose(read["physics:density"], truth[:, 0], rtol=1e-4)
        expected = np.array([YIELDING[int(number)].stress for number in truth[:, 3]])
        np.testing.assert_allclose(read["newton:mpm:yieldStress"], expected, rtol=1e-6)
        # It stands on the ground, also where another file refers to it.
        cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"])
        box = cache.ComputeWorldBound(stage.GetPrimAtPath("/Asset"))
        assert abs(box.ComputeAlignedRange().GetMin()[2]) < 1e-6


def test_openusd_s_validators_find_nothing(exported):
    every = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(every) > 20
    context = UsdValidation.ValidationContext(every)
    for name in ("scene.usda", index_of(exported)[0]["file"]):
        stage = Usd.Stage.Open(str(exported / name))
        assert [found.GetMessage() for found in context.Validate(stage)] == []


def test_the_scene_has_every_asset_apart_from_the_others(exported):
    stage = Usd.Stage.Open(str(exported / "scene.usda"))
    found = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Points)]
    assert len(found) == len(index_of(exported))
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"])
    boxes = [cache.ComputeWorldBound(prim).ComputeAlignedRange() for prim in found]
    for number, box in enumerate(boxes):
        assert abs(box.GetMin()[2]) < 1e-6
        for other in boxes[:number]:
            gaps = (np.subtract(a.GetMin(), b.GetMax()) for a, b in ((box, other), (other, box)))
            assert np.max(list(gaps)) > 0
    side = np.ceil(np.sqrt(len(found))) * 1.25 * SIZE
    ends = [end for box in boxes for end in (box.GetMin(), box.GetMax())]
    assert (np.ptp(ends, axis=0)[:2] < side).all()
    # The physics scenes of the assets' files stay there: a scene has one.
    assert sum(prim.GetTypeName() == "PhysicsScene" for prim in stage.Traverse()) == 1
    assert json.loads((exported / "index.json").read_text())["files"] == ["scene.usda"]


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(7, 60))
def test_bins_are_at_most_as_many_as_asked_and_say_their_error(seed, most):
    rng = np.random.default_rng(seed)
    material = rng.integers(0, 7, 400).astype(np.uint8)
    solid = rng.uniform([3, 100, 0.0], [11, 8000, 0.499], (400, 3))
    solid[:, 0] = 10 ** solid[:, 0]
    binned = bin_materials(material, solid, most)
    assert len(binned.material) <= most
    np.testing.assert_array_equal(binned.material[binned.rows], material)
    errors = np.abs(binned.modulus[binned.rows] / solid[:, 0] - 1)
    np.testing.assert_allclose(binned.modulus_error, errors.max())
    errors = np.abs(binned.ratio[binned.rows] - solid[:, 2])
    np.testing.assert_allclose(binned.ratio_error, errors.max())


def test_more_materials_are_closer_and_few_values_are_exact():
    rng = np.random.default_rng(0)
    material = np.zeros(3000, np.uint8)
    solid = np.column_stack([10 ** rng.uniform(4, 6, 3000), np.ones(3000), np.full(3000, 0.3)])
    errors = [bin_materials(material, solid, most).modulus_error for most in (8, 32, 128)]
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    # 2 decades in 128 bins: half a bin is 1.8 %.
    assert errors[2] < 0.03
    solid[:, 0] = rng.choice([1e4, 1.01e4, 5e9], 3000)
    binned = bin_materials(material, solid, 7)
    assert len(binned.material) == 3 and binned.modulus_error < 1e-6


def test_no_rows_have_no_materials():
    binned = bin_materials(np.zeros(0, np.uint8), np.zeros((0, 3)), 8)
    assert [len(part) for part in binned[:4]] == [0, 0, 0, 0] and binned[4:] == (0.0, 0.0)


def test_a_ratio_of_one_half_is_clipped_and_said_also_of_snow(make_dataset, tmp_path):
    dataset = make_dataset("a")
    grid = dataset.assets["a"].grid
    soft = grid[..., 3] == JELLY[0]
    grid[soft, 2:] = 0.5, 5
    dataset.write_grid("a", grid)
    built = build_store(dataset.parameters(), tmp_path / "s.zarr")
    done = export_store(str(built.store), tmp_path / "usd", "usd")
    assert f"nu of {soft.sum():,} points was above {MAX_POISSON} and is written so" in done.notes
    stage = Usd.Stage.Open(str(tmp_path / "usd" / "a.usdc"))
    read = materials_of(stage, "/Asset/Points")
    there = read["newton:mpm:poissonsRatio"] > 0.4
    # Packed by 3 kPa, torn by a fifth of that.
    for name, value in {
        "poissonsRatio": MAX_POISSON, "internalFriction": 0.5, "yieldPressure": 3e3,
        "tensileYieldRatio": 0.2, "yieldStress": 0, "hardening": 10, "dilatancy": 1, "viscosity": 0,
    }.items():  # fmt: skip
        np.testing.assert_allclose(read[f"newton:mpm:{name}"][there], value, rtol=1e-6)


def test_too_few_materials_are_refused(store, tmp_path):
    with pytest.raises(ConfigError, match="materials is 3; expected 7 or more"):
        export_store(store, tmp_path / "usd", "usd", options=ExportOptions(materials=3))


@NEWTON
def test_newton_s_importer_gives_back_stiffness_ratio_and_mass(exported, mixed):
    import newton

    builder = newton.ModelBuilder()
    read = builder.add_usd(str(exported / "scene.usda"))
    model = builder.finalize(device="cpu")
    entries = index_of(exported)
    parts = read["path_particle_map"]
    assert len(parts) == len(entries)
    np.testing.assert_allclose(model.gravity.numpy()[0], [0, 0, -9.81], rtol=1e-6)
    for (path, (start, stop)), entry in zip(sorted(parts.items()), entries, strict=True):
        assert entry["asset_id"].replace(".", "_") in path
        _, truth = solid_of(mixed, entry["asset_id"])
        here = slice(start, stop)
        modulus, ratio = (
            getattr(model.mpm, name).numpy()[here] for name in ("young_modulus", "poisson_ratio")
        )
        np.testing.assert_allclose(modulus, truth[:, 1], rtol=1e-4)
        np.testing.assert_allclose(ratio, truth[:, 2], atol=1e-5)
        mass = truth[:, 0] * (SIZE / 64) ** 3
        np.testing.assert_allclose(model.particle_mass.numpy()[here], mass, rtol=2e-3)


@NEWTON
def test_a_drop_runs_from_the_file(exported):
    import newton

    raised, step = 0.1, 1 / 240
    stage = Usd.Stage.Open(str(exported / "cup.usdc"))
    stage.SetEditTarget(stage.GetSessionLayer())
    up = UsdGeom.Xformable(stage.GetPrimAtPath("/Asset")).AddTranslateOp(opSuffix="raise")
    up.Set((0.0, 0.0, raised))
    builder = newton.ModelBuilder()
    read = builder.add_usd(stage)
    model = builder.finalize(device="cpu")
    scene = stage.GetPrimAtPath(read["particle_scene_path"])
    config = newton.solvers.SolverImplicitMPM.Config.create_from_usd(scene)
    np.testing.assert_allclose(config.voxel_size, 2 * SIZE / 64, rtol=1e-3)
    assert config.strain_basis == "P1d"
    solver = newton.solvers.SolverImplicitMPM(model, config=config)
    now, after = model.state(), model.state()
    heights = []
    for _ in range(48):
        solver.step(now, after, None, None, step)
        solver.project_outside(after, after, step)
        now, after = after, now
        heights.append(now.particle_q.numpy()[:, 2].copy())
    fallen = heights[0].mean() - heights[29].mean()
    # Free fall between two steps: half g (t^2 - t0^2), and a step's error of g t dt / 2.
    assert fallen == pytest.approx(9.81 / 2 * (0.125**2 - step**2), rel=0.05)
    # It hits the ground after 0.143 s and stays above it.
    assert heights[-1].min() > -SIZE / 64
    assert heights[-1].mean() > heights[0].mean() - raised - 0.01

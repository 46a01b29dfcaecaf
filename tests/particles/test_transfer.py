"""Materials reach particles: against brute force, and read back by other programs."""

import shutil
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
from support import commands
from support.exports import hold_truth
from support.synthetic import Dataset

from slatprep.errors import ConfigError, InputError
from slatprep.export import ExportOptions, export_store
from slatprep.particles.fields import VoxelField, predicted_field, stored_field
from slatprep.particles.read import read_particles
from slatprep.particles.transfer import transfer
from slatprep.records import Normalization
from slatprep.store import open_store

# As TRELLIS names and orders the fields of a Gaussian (`construct_list_of_attributes`).
GAUSSIAN = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
    "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
]  # fmt: skip


def write_gaussians(path: Path, slat_positions: np.ndarray) -> np.ndarray:
    """Write Gaussians as TRELLIS does; return the positions that the file has."""
    x, y, z = slat_positions.T
    saved = np.column_stack([x, -z, y])  # [[1, 0, 0], [0, 0, -1], [0, 1, 0]] @ (x, y, z)
    write_points(path, saved, GAUSSIAN)
    return saved.astype(np.float32)


def run(*words: object) -> dict[str, Any]:
    return commands.document("transfer", *words, "-q")


def run_wrong(*words: object, code: int = 2) -> str:
    told = commands.refused("transfer", *words, code=code)
    assert len(told.splitlines()) == 1
    return told


def write_points(path: Path, positions: np.ndarray, names: Iterable[str] = "xyz") -> None:
    """Write a PLY of points with these fields, of which all others have the row's number."""
    rows = np.empty(len(positions), dtype=[(name, "f4") for name in names])
    for name in names:
        rows[name] = np.arange(len(positions))
    rows["x"], rows["y"], rows["z"] = positions.T
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(path)


def columns(path: Path, names: Iterable[str]) -> np.ndarray:
    """Return fields of the points in a PLY, a column for each."""
    vertex = plyfile.PlyData.read(path)["vertex"]
    return np.column_stack([vertex[name] for name in names])


@pytest.fixture(scope="module")
def true_parts(mixed: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return the SLAT voxels of `cup` with their true class, from its grid."""
    asset = mixed.assets["cup"]
    x, y, z = asset.coords.T.astype(int)
    return asset.coords, asset.grid[y, 63 - x, z, 3].astype(int)  # the quarter turn undone


def particles_near(coords: np.ndarray, count: int, reach: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    chosen = coords[rng.integers(len(coords), size=count)]
    return (chosen + 0.5 + rng.uniform(-reach, reach, (count, 3))) / 64 - 0.5


@pytest.mark.parametrize("tool", ["trellis", "sam3d"])
def test_gaussians_get_the_material_of_their_voxel(tool, store, true_parts, tmp_path):
    coords, material = true_parts
    positions = particles_near(coords, 3000, 0.45)
    saved = (write_gaussians if tool == "trellis" else as_sam3d)(tmp_path / "g.ply", positions)
    words = ("--store", store, "--asset", "cup", "--out")
    summary = run(tmp_path / "g.ply", *words, tmp_path / "m.ply")
    assert summary["axes"] == ("trellis" if tool == "trellis" else "slat") and summary["far"] == 0
    told = commands.run("transfer", tmp_path / "g.ply", *words, tmp_path / "s.ply", "--frame=slat")
    assert ("read as SAM 3D Objects saves them" in told.stderr) == (tool == "sam3d")

    # Row for row the Gaussians of the file, so that the two lie on each other.
    np.testing.assert_array_equal(columns(tmp_path / "m.ply", "xyz"), saved)
    np.testing.assert_allclose(columns(tmp_path / "s.ply", "xyz"), positions, atol=1e-7)
    voxel = {tuple(c): m for c, m in zip(coords.tolist(), material.tolist(), strict=True)}
    truth = [voxel[tuple(v)] for v in np.floor((positions + 0.5) * 64).astype(int).tolist()]
    given = columns(tmp_path / "m.ply", ("material_id", "E", "density", "nu")).T
    np.testing.assert_array_equal(given[0], truth)
    hold_truth(*given)
    apart = np.linalg.norm((positions + 0.5) * 64 % 1 - 0.5, axis=1)
    np.testing.assert_allclose(
        columns(tmp_path / "m.ply", ["conf"])[:, 0], 1 - apart / 2, atol=1e-5
    )
    assert read_particles(tmp_path / "s.ply").axes == "slat"


@pytest.mark.parametrize(("axes", "turn"), [
    ("trellis", lambda x, y, z: (x, -z, y)),
    ("glb", lambda x, y, z: (x, z, -y)),
    ("slat", lambda x, y, z: (x, y, z)),
])  # fmt: skip
def test_wrong_axes_are_an_error_that_names_the_right_ones(axes, turn, store, true_parts, tmp_path):
    positions = particles_near(true_parts[0], 3000, 0.45)
    np.save(tmp_path / "p.npy", np.column_stack(turn(*positions.T)))
    words = (tmp_path / "p.npy", "--store", store, "--asset", "cup", "--out", tmp_path / "m.ply")
    assert run(*words, "--axes", axes)["far"] == 0
    (tmp_path / "m.ply").unlink()
    for other in {"trellis", "glb", "slat"} - {axes}:
        assert f"with --axes {axes} 0% would be far" in run_wrong(*words, "--axes", other)
        assert not (tmp_path / "m.ply").exists()


def write_prediction(path: Path, coords: np.ndarray, material: np.ndarray) -> None:
    values = np.tile([1e5, 1e3, 0.3], (len(coords), 1)) * (1 + material[:, None] * [1, 1, 0])
    np.savez(path, coords=coords, material=material, properties_si=values)


def as_sam3d(path: Path, slat_positions: np.ndarray) -> np.ndarray:
    """Write Gaussians as SAM 3D Objects does: TRELLIS's fields, positions as they are."""
    x, y, z = slat_positions.T
    return write_gaussians(path, np.column_stack([x, z, -y]))


@pytest.mark.parametrize("shape", ["ball", "crate"])
def test_axes_that_fit_alike_are_asked_for(shape, tmp_path):
    there = np.indices((64, 64, 64)).reshape(3, -1).T
    centred = there - 31.5
    reach = np.linalg.norm(centred, axis=1) if shape == "ball" else np.abs(centred).max(axis=1)
    coords = there[(reach < 20) & (reach > 18)]
    positions = particles_near(coords, 3000, 0.45)
    upper = (coords[:, 2] > 31).astype(int)
    write_prediction(tmp_path / "two.npz", coords, upper)
    write_prediction(tmp_path / "one.npz", coords, np.zeros(len(coords), int))
    for write in (write_gaussians, as_sam3d):
        write(tmp_path / "g.ply", positions)
        out = tmp_path / "m.ply"
        said = run_wrong(tmp_path / "g.ply", "--prediction", tmp_path / "two.npz", "--out", out)
        assert "This object fits either" in said and "--axes slat for those of SAM 3D" in said
        assert not out.exists()
        # Of one material alone it does not matter.
        run(tmp_path / "g.ply", "--prediction", tmp_path / "one.npz", "--out", out)
        out.unlink()
        axes = "trellis" if write is write_gaussians else "slat"
        words = ("--prediction", tmp_path / "two.npz", "--out", out, "--axes", axes)
        run(tmp_path / "g.ply", *words)
        np.testing.assert_array_equal(columns(out, ["material_id"])[:, 0], positions[:, 2] > 0)
        out.unlink()


def test_particles_that_are_far_are_told_or_an_error(store, true_parts, tmp_path):
    positions = particles_near(true_parts[0], 900, 0.45)
    np.save(tmp_path / "p.npy", positions + 3.0)
    words = (tmp_path / "p.npy", "--store", store, "--asset", "cup", "--out", tmp_path / "m.ply")
    said = run_wrong(*words)
    assert "900 of 900 particles have no voxel within 2 voxels" in said
    assert "no other --axes brings them nearer; they lie between 2" in said
    positions[::3] += 3.0
    np.save(tmp_path / "p.npy", positions)
    told = commands.run("transfer", *words, "-q").stderr
    assert "300 of 900 particles have no voxel" in told and "read with --axes slat" in told
    write_points(tmp_path / "g.ply", positions, GAUSSIAN)
    run(tmp_path / "g.ply", *words[1:], "--axes", "slat", "--far", "drop")
    kept = columns(tmp_path / "m.ply", ["rot_3"])[:, 0]
    np.testing.assert_array_equal(kept, np.flatnonzero(np.arange(900) % 3))


@pytest.mark.parametrize(("names", "reach", "sign"), [
    ([*GAUSSIAN, "f_rest_0"], 0.4, "it has f_rest_*"),
    ([name for name in GAUSSIAN if name[0] != "n"], 0.4, "it has no normals"),
    (GAUSSIAN, 3.0, "it reaches 3 from the centre, out of the unit cube"),
])  # fmt: skip
def test_gaussians_of_another_tool_are_told_apart(names, reach, sign, store, true_parts, tmp_path):
    positions = particles_near(true_parts[0], 400, 0.45)
    write_points(tmp_path / "g.ply", positions * reach / abs(positions).max(), names)
    read = read_particles(tmp_path / "g.ply")
    assert (read.foreign, read.axes) == (sign, "slat")
    assert read_particles(tmp_path / "g.ply", "glb").axes == "glb"

    words = (tmp_path / "g.ply", "--store", store, "--asset", "cup", "--far", "drop",
             "--max-distance", "64", "--out", tmp_path / "m.ply")  # fmt: skip
    if reach < 1:
        told = commands.run("transfer", *words).stderr
        assert f"another tool's than TRELLIS ({sign}): read as they are" in told
    else:
        told = commands.refused("transfer", *words)
        assert sign in told and "half of them" in told


def test_a_reader_that_is_not_installed_is_wrong_use(store, tmp_path, monkeypatch):
    write_points(tmp_path / "g.ply", np.zeros((1, 3)))
    monkeypatch.setitem(sys.modules, "plyfile", None)  # as an import finds what is missing
    words = "--store", store, "--asset", "cup", "--out", tmp_path / "m.ply"
    assert "pip install 'slatprep[simulate]'" in run_wrong(tmp_path / "g.ply", *words)


def test_what_slatprep_wrote_says_its_frame(store, true_parts, tmp_path):
    write_gaussians(tmp_path / "g.ply", particles_near(true_parts[0], 200, 0.4))
    words = ("--store", store, "--asset", "cup", "--out")
    run(tmp_path / "g.ply", *words, tmp_path / "once.ply")
    assert run(tmp_path / "once.ply", *words, tmp_path / "twice.ply")["axes"] == "trellis"
    assert (tmp_path / "once.ply").read_bytes() == (tmp_path / "twice.ply").read_bytes()

    for points, frame in (("slat", "slat"), ("grid", "slat"), ("grid", "pixieverse")):
        options = ExportOptions(points=points, frame=frame)
        export_store(store, tmp_path / frame, "ply", assets=["cup"], options=options)
        if frame == "slat":
            cloud = tmp_path / frame / "cup.ply"
            assert run(cloud, *words, tmp_path / "m.ply", "--points", points)["far"] == 0
    said = run_wrong(tmp_path / "pixieverse" / "cup.ply", *words, tmp_path / "m.ply", code=1)
    assert "in the PixieVerse frame; expected the SLAT frame: slatprep export --frame slat" in said
    run_wrong(tmp_path / "pixieverse" / "cup.ply", *words, tmp_path / "m.ply", "--axes", "slat")


def test_a_solid_on_a_surface_is_told_of_points_grid(tmp_path):
    cube = np.argwhere(np.ones((20, 20, 20))) + 20
    shell = cube[((cube == 20) | (cube == 39)).any(axis=1)]
    write_prediction(tmp_path / "p.npz", shell, np.zeros(len(shell), int))
    np.save(tmp_path / "solid.npy", (cube + 0.5) / 64 - 0.5)
    words = ("--out", tmp_path / "m.ply", "--max-distance", 1)
    said = run_wrong(tmp_path / "solid.npy", "--prediction", tmp_path / "p.npz", *words)
    # 16^3 of 20^3 are more than a voxel from the shell.
    assert "4,096 of 8,000 particles" in said and "(51%, half of them none within 3)" in said
    assert "100% of them lie inside the object" in said and "--points grid" in said


@pytest.mark.parametrize("side", [64, 128, 256])
def test_nearest_is_nearest_by_brute_force(side):
    rng = np.random.default_rng(1)
    voxels = np.unique(rng.integers(0, side, (500, 3)), axis=0)
    voxels = rng.permutation(voxels)[:400].astype(np.uint8)
    values = np.tile(np.arange(400, dtype=np.float32)[:, None], 3)
    field = VoxelField.of_slat(voxels, side, (np.arange(400) % 7).astype(np.uint8), values)
    points = rng.uniform(-0.6, 0.6, (700, 3))
    apart = np.linalg.norm(points[:, None] - ((voxels + 0.5) / side - 0.5)[None], axis=2) * 64
    result = transfer(points, field, max_distance=6.0, far="nearest")
    np.testing.assert_array_equal(result.properties[:, 0], apart.argmin(axis=1))
    np.testing.assert_allclose(result.distance, apart.min(axis=1), atol=1e-9)
    far = apart.min(axis=1) > 6.0
    assert result.far == far.sum() and 0 < result.far < len(points)

    kept = transfer(points, field, max_distance=6.0)
    assert (kept.material[far] == 7).all() and not kept.properties[far].any()
    np.testing.assert_array_equal(kept.material[~far], result.material[~far])
    dropped = transfer(points, field, max_distance=6.0, far="drop")
    np.testing.assert_array_equal(dropped.rows, np.flatnonzero(~far))
    np.testing.assert_array_equal(dropped.properties, result.properties[~far])
    np.testing.assert_array_equal(dropped.distance, result.distance[~far])


def test_grid_reaches_inside_the_object(store, mixed, tmp_path):
    with pytest.raises(ConfigError, match="points is 'grids'; expected one of slat, grid"):
        stored_field(open_store(store), "cup", points="grids")  # type: ignore[arg-type]
    grid = mixed.assets["cup"].grid
    solid = np.argwhere(grid[..., 3] != 7)
    turned = np.stack([63 - solid[:, 1], solid[:, 0], solid[:, 2]], axis=1)  # the quarter turn
    np.save(tmp_path / "solid.npy", (turned + 0.5) / 64 - 0.5)
    words = ("--store", store, "--asset", "cup", "--points", "grid", "--out", tmp_path / "m.ply")
    run(tmp_path / "solid.npy", *words)
    given = columns(tmp_path / "m.ply", ("E", "material_id"))
    np.testing.assert_allclose(given, grid[tuple(solid.T)][:, [1, 3]], rtol=1e-4)


def test_prediction_is_transferred_as_the_store_is(store, tmp_path):
    """What `export --format npz` writes has the form of a prediction."""
    export_store(store, tmp_path / "npz", "npz", assets=["cup"])
    (prediction,) = (tmp_path / "npz").glob("latents/*/cup.npz")
    with np.load(prediction) as held:
        positions = particles_near(held["coords"], 100, 0.5)
    np.savez(tmp_path / "points.npz", positions=positions, weight=np.ones(4))
    for name, words in (
        ("stored", ("--store", store, "--asset", "cup")),
        ("predicted", ("--store", store, "--prediction", prediction)),
    ):
        run(tmp_path / "points.npz", *words, "--out", tmp_path / f"{name}.ply")
    assert (tmp_path / "stored.ply").read_bytes() == (tmp_path / "predicted.ply").read_bytes()


def predicted(
    folder: Path, normalization: Normalization | None = None, **arrays: Any
) -> VoxelField:
    """Write a prediction and read it."""
    np.savez(folder / "p.npz", **arrays)
    return predicted_field(folder / "p.npz", normalization)


@pytest.mark.parametrize("side", [32, 64, 128])
def test_a_particle_at_a_voxel_s_centre_gets_its_material(tmp_path, side):
    block = np.argwhere(np.ones((6, 6, 6))) + side // 3
    kinds = block.sum(axis=1) % 2
    stuff = np.array([[1e5, 1e3, 0.3], [1e9, 2e3, 0.4]], np.float32)[kinds]
    arrays = {"coords": block, "material": kinds, "properties_si": stuff, "resolution": side}
    found = transfer((block + 0.5) / side - 0.5, predicted(tmp_path, **arrays))
    np.testing.assert_array_equal(found.material, kinds)
    np.testing.assert_array_equal(found.properties, stuff)
    assert found.far == 0 and (found.distance.max() < 1e-9 or side < 64)


def test_prediction_in_si_needs_no_ranges(tmp_path):
    coords = np.array([[0, 1, 2, 3], [0, 4, 5, 6]], np.int32)
    values = np.array([[1e5, 1e3, 0.3], [np.nan] * 3], np.float32)
    arrays, valid = {"coords": coords, "material": np.array([2, 255])}, np.array([True, False])
    field = predicted(tmp_path, **arrays, properties_si=values, valid=valid)
    np.testing.assert_array_equal(field.voxels, [[1, 2, 3]])
    np.testing.assert_array_equal(field.properties, values[:1])
    with pytest.raises(ConfigError, match="--ranges"):
        predicted(tmp_path, **arrays, properties=values, valid=valid)
    with pytest.raises(InputError, match="has class 255"):
        predicted(tmp_path, **arrays, properties_si=values)


def test_prediction_by_its_own_ranges(store, tmp_path):
    asset = open_store(store)["cup"]
    spans = np.array([[2.0, 12.0], [1.0, 5.0], [0.0, 0.5]])
    mapped = asset.properties_si[asset.valid].astype(np.float64)
    mapped[:, :2] = np.log10(mapped[:, :2])
    values = 2 * (mapped - spans[:, 0]) / (spans[:, 1] - spans[:, 0]) - 1
    scores = np.eye(8)[asset.material[asset.valid]]
    arrays = {"coords": asset.coords[asset.valid], "properties": values, "ranges": spans}
    for normalization in (open_store(store).normalization, None):
        field = predicted(tmp_path, normalization, **arrays, logits=scores)
        np.testing.assert_allclose(field.properties, asset.properties_si[asset.valid], rtol=1e-5)
        np.testing.assert_array_equal(field.material, asset.material[asset.valid])
    scores[0], scores[1, :2] = 1.0, 2.0
    field = predicted(tmp_path, **arrays, logits=scores)
    assert len(field.material) == len(scores) - 1
    np.testing.assert_array_equal(field.material[0], 0)
    with pytest.raises(InputError, match="all classes have the same score"):
        predicted(tmp_path, **arrays, logits=np.zeros_like(scores))


@pytest.mark.parametrize("wrong", [(-5.0, 1e3, 0.3), (1e5, 0.0, 0.3), (1e5, 1e3, 0.9)])
def test_prediction_of_values_that_no_material_has(tmp_path, wrong):
    values = np.array([(1e5, 1e3, 0.3), wrong])
    coords = np.array([[1, 2, 3], [4, 5, 6]])
    with pytest.raises(InputError, match="row 1 has class 0 and properties"):
        predicted(tmp_path, coords=coords, material=np.zeros(2, int), properties_si=values)


def test_a_file_that_transfer_did_not_write_is_not_replaced(store, tmp_path):
    own = tmp_path / "own.ply"
    write_gaussians(own, np.zeros((1, 3)))
    before = shutil.copy(own, tmp_path / "g.ply").read_bytes()
    said = run_wrong(tmp_path / "g.ply", "--store", store, "--asset", "cup", "--out", own)
    assert "not an export" in said and own.read_bytes() == before

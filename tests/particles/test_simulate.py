"""Strain, wind and motion of simulated objects, Gaussians that follow them, and the examples."""

import argparse
import importlib.util
import sys
import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import plyfile
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation
from support.commands import document, run
from support.synthetic import JELLY, METAL, make_asset

from slatprep.errors import ConfigError, SlatprepError
from slatprep.particles import gaussians, motion
from slatprep.particles.fields import VoxelField
from slatprep.particles.read import SAVED_AXES
from slatprep.particles.simulate import AIR, Motion, simulate_motion, windward
from slatprep.store import open_store

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import drop
import drop_picture
import scenes
from drop import rigid_deviation, strain

SPACING = 0.1
CUBE = np.argwhere(np.ones((4, 4, 4))) * SPACING
ONE_PART = np.zeros(len(CUBE), dtype=int)
STUFF = np.tile([1e5, 1e3, 0.3], (len(CUBE), 1))

# `make simulate` runs these with the real engine, as a job of continuous integration does.
needs_newton = pytest.mark.skipif(
    importlib.util.find_spec("newton") is None,
    reason="needs the extra `simulate`: 0.5 GB, and minutes to compile; see make simulate",
)


@given(st.integers(0, 2**32 - 1))
def test_moving_and_turning_is_no_strain(seed):
    rng = np.random.default_rng(seed)
    moved = Rotation.random(rng=rng).apply(CUBE) + rng.normal(size=3)
    assert strain(CUBE, moved, ONE_PART, SPACING).max() < 1e-9
    assert rigid_deviation(CUBE, moved) < 1e-9


@pytest.mark.parametrize("stretch", [0.7, 1.2])
@pytest.mark.parametrize("shear", [0.0, 0.3])
def test_stretch_and_shear_have_their_green_strain(stretch, shear):
    gradient = np.array([[1.0, shear, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, stretch]])
    moved = Rotation.from_euler("xyz", [1, 2, 3]).apply(CUBE @ gradient.T)
    green = np.linalg.eigvalsh(gradient.T @ gradient - np.eye(3)) / 2
    expected = np.abs(green).max()
    np.testing.assert_allclose(strain(CUBE, moved, ONE_PART, SPACING), expected, rtol=1e-9)
    if not shear:
        assert expected == pytest.approx(abs(stretch**2 - 1) / 2)
        # Only z deviates, by (stretch - 1) z; the best turn of a stretched cube is none.
        deviation = abs(stretch - 1) * CUBE[:, 2].std()
        np.testing.assert_allclose(rigid_deviation(CUBE, moved), deviation, rtol=1e-9)


def test_parts_are_measured_apart():
    part = (CUBE[:, 2] > 0.15).astype(int)
    moved = np.where(part[:, None] == 0, CUBE * [1.1, 1.1, 1.1], CUBE + np.array([0.0, 0.0, 0.5]))
    measured = strain(CUBE, moved, part, SPACING)
    np.testing.assert_allclose(measured[part == 0], 0.105, rtol=1e-9)
    np.testing.assert_allclose(measured[part == 1], 0.0, atol=1e-9)


def test_lone_particles_have_no_strain():
    line = np.arange(3)[:, None] * [0.1, 0.0, 0.0]
    assert np.isnan(strain(line, line, np.zeros(3, dtype=int), SPACING)).all()


def test_a_ratio_of_one_half_is_taken_and_told(monkeypatch):
    stuff = STUFF.copy()
    stuff[:7, 2] = 0.5
    monkeypatch.setitem(sys.modules, "newton", None)  # It is told before the engine is loaded.
    told = pytest.warns(UserWarning, match="nu of 7 particles is taken as 0.499")
    with told, pytest.raises(SlatprepError, match=r"pip install 'slatprep\[simulate\]'"):
        simulate_motion(CUBE, ONE_PART, stuff, SPACING)


@pytest.mark.parametrize(("material", "change", "said"), [
    (7, None, r"material 7 \(background\) is not simulated"),
    (0, (3, 1, 0.0), r"particle 3 has density = 0 kg/m\^3; expected 0.001 to 1e\+06"),
    (0, (3, 1, 1e-30), "particle 3 has density = 1e-30"),
    (0, (4, 0, 1e300), r"particle 4 has E = 1e\+300 Pa; expected 0.001 to 1e\+15"),
    (0, (5, 2, 0.51), "nu = 0.51; expected"),
    (0, (2, 0, np.nan), "particle 2 has E = nan"),
])  # fmt: skip
def test_particles_that_cannot_be_simulated_are_named(material, change, said):
    stuff = STUFF.copy()
    if change:
        stuff[change[0], change[1]] = change[2]
    with pytest.raises(SlatprepError, match=said):
        simulate_motion(CUBE, ONE_PART + material, stuff, SPACING)


@pytest.mark.parametrize(("given", "said"), [
    ({"spacing": 1e-20}, r"spacing: 1e-20 m; expected 1e-06 to 10000 m"),
    ({"spacing": np.nan}, "spacing: nan m"),
    ({"spacing": np.inf}, "spacing: inf m"),
    ({"height": 1e30}, r"height: 1e\+30 m; expected 0 to 10000 m"),
    ({"height": -5}, "height: -5 m"),
    ({"positions": CUBE * np.nan}, "object: nan m"),
    ({"wind": (0, 0, 1e300)}, "expected at most 1000 m/s"),
    ({"wind": (np.nan, 0, 0)}, "expected at most 1000 m/s"),
    ({"seconds": 0.001}, "seconds times rate is 0.06; expected 1 to 10,000 frames"),
    ({"seconds": 1e6}, "expected 1 to 10,000 frames"),
    ({"seconds": np.nan}, "seconds times rate is nan"),
    ({"seconds": np.inf}, "seconds times rate is inf"),
])  # fmt: skip
def test_what_the_engine_s_numbers_cannot_hold_is_refused(given, said):
    wanted = {"positions": CUBE, "spacing": SPACING} | given
    with pytest.raises(SlatprepError, match=said):
        simulate_motion(material=ONE_PART, properties=STUFF, **wanted)


@needs_newton
def test_a_device_that_is_not_there_is_named():
    with pytest.raises(SlatprepError, match="'foo' is no device here; expected cpu"):
        simulate_motion(CUBE, ONE_PART, STUFF, SPACING, device="foo")


@given(st.integers(0, 2**32 - 1))
def test_the_wind_meets_the_shadow_of_what_is_convex(seed):
    """Of a box in any wind, the free faces are together as large as its shadow."""
    rng = np.random.default_rng(seed)
    size, way = rng.integers(1, 5, 3), rng.normal(size=3)
    box = (np.argwhere(np.ones(size)) + rng.normal(size=3)) * SPACING
    across = np.abs(way) / np.linalg.norm(way)
    shadow = across @ [size[1] * size[2], size[0] * size[2], size[0] * size[1]] * SPACING**2
    np.testing.assert_allclose(windward(box, way, SPACING).sum(), shadow)
    assert not windward(box, np.zeros(3), SPACING).any()
    assert (windward([[0, 0, 0], [SPACING, 0, 0]], [9, 0, 0], SPACING) == [SPACING**2, 0]).all()


@needs_newton
def test_water_runs_sand_slumps_snow_packs_and_jelly_stands():
    column = np.argwhere(np.ones((4, 4, 8))) * SPACING
    kinds = {4: (2e5, 1e3, 0.45), 2: (1e7, 1.6e3, 0.3), 5: (2e5, 3e2, 0.25), 0: (2e5, 1e3, 0.4)}
    positions = np.concatenate([column + np.array([3.0 * k, 0, 0]) for k in range(len(kinds))])
    material = np.repeat(list(kinds), len(column))
    stuff = np.repeat(list(kinds.values()), len(column), axis=0)
    frames = simulate_motion(
        positions, material, stuff, SPACING, height=0.1, seconds=0.8, substeps=1
    ).positions
    assert (frames[..., 2] > -SPACING / 2).all()  # none in the ground
    water, sand, snow, jelly = (frames[-1][material == number] for number in kinds)
    heights = [np.percentile(part[:, 2], 90) for part in (water, sand, snow, jelly)]
    assert heights == sorted(heights)
    assert heights[0] < 2.5 * SPACING and heights[3] > 6 * SPACING
    assert np.ptp(water[:, 0]) > np.ptp(sand[:, 0]) > 1.5 * np.ptp(jelly[:, 0])


@needs_newton
def test_steps_too_long_for_the_speed_are_said():
    """A fall of 1 m ends at 4.4 m/s: 0.29 m in a step of 1/15 s, and cells are 0.2 m wide."""
    stuff = np.tile([1e5, 1e3, 0.3], (len(CUBE), 1))
    how = {"height": 1.0, "seconds": 0.6, "rate": 15}
    with pytest.warns(UserWarning, match=r"cross 1\.[0-9] cells in a time step.*--substeps 2"):
        simulate_motion(CUBE, ONE_PART, stuff, SPACING, substeps=1, **how)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        simulate_motion(CUBE, ONE_PART, stuff, SPACING, substeps=2, **how)


@needs_newton
def test_wind_pushes_by_the_drag_equation():
    """m dv/dt = 1/2 rho A (U - v)^2, of which the way has a closed form."""
    wind, density, seconds, side = 10.0, 20.0, 0.25, 4 * SPACING
    stuff = np.tile([1e5, density, 0.3], (len(CUBE), 1))
    frames = simulate_motion(
        CUBE, ONE_PART, stuff, SPACING, height=0.5, wind=(wind, 0, 0), seconds=seconds, substeps=1
    ).positions
    rate = AIR / 2 * side**2 * wind / (density * side**3)  # 1/s
    expected = wind * seconds - wind / rate * np.log(1 + rate * seconds)
    np.testing.assert_allclose((frames[-1] - frames[0])[:, 0].mean(), expected, rtol=0.1)


@needs_newton
def test_a_held_pole_sways_about_where_a_beam_would_rest():
    """Euler and Bernoulli: a cantilever under an even load bends by q L^4 / (8 E I)."""
    pole, wind, modulus = np.argwhere(np.ones((3, 3, 12))) * SPACING, 20.0, 1e6
    foot = pole[:, 2] < SPACING / 2
    frames = simulate_motion(
        pole, np.zeros(len(pole), dtype=int), np.tile([modulus, 1e3, 0.3], (len(pole), 1)), SPACING,
        height=0.0, gravity=0.0, wind=(wind, 0, 0), fixed=foot, seconds=0.8, rate=30,
    ).positions  # fmt: skip
    moved = frames - frames[0]
    assert abs(moved[:, foot]).max() < 1e-6  # the engine computes in single precision
    width, length = 3 * SPACING, 11 * SPACING
    load, inertia = AIR / 2 * wind**2 * width, width**4 / 12
    expected = load * length**4 / (8 * modulus * inertia)
    tip = moved[:, pole[:, 2] > 10.5 * SPACING, 0].mean(axis=1)
    assert tip.max() > 1.5 * expected > 3 * abs(tip[-1])  # there and back once in 0.8 s
    np.testing.assert_allclose(tip.mean(), expected, rtol=0.2)


@needs_newton
def test_steel_on_jelly_falls_as_galileo_says_and_the_jelly_gives_way():
    tower = np.argwhere(np.ones((6, 6, 9))) * SPACING
    top = tower[:, 2] > 5.5 * SPACING
    stuff = np.where(top[:, None], [6e10, 7e3, 0.3], [6e4, 1e3, 0.4])
    frames = simulate_motion(
        tower, top.astype(int), stuff, SPACING, height=0.2, seconds=0.35
    ).positions
    for frame in (6, 10):  # still falling: g t^2 / 2
        fallen = (frames[0] - frames[frame])[:, 2]
        np.testing.assert_allclose(fallen, 9.81 / 2 * (frame / 60) ** 2, rtol=0.15)
    last = [strain(frames[0], frame, top, SPACING) for frame in frames[12:]]
    soft, stiff = (max(np.nanmean(e[side]) for e in last) for side in (~top, top))
    assert soft > 0.1 and stiff < soft / 20
    assert rigid_deviation(frames[0][top], frames[-1][top]) < 0.05 * SPACING


H = 1 / 16
REST = (np.indices((5, 6, 7)).reshape(3, -1).T - 3) * H
ROTATION, SCALE = [f"rot_{i}" for i in (1, 2, 3, 0)], [f"scale_{i}" for i in range(3)]


def random_gaussians(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    places = rng.uniform(REST.min(axis=0), REST.max(axis=0), (count, 3))
    made = gaussians.gaussians_of(places, rng.integers(0, 7, count).astype(np.uint8), H)
    drawn = [*Rotation.random(count, rng=rng).as_quat().T, *rng.normal(-4, 0.5, (3, count))]
    for name, values in zip([*ROTATION, *SCALE], drawn, strict=True):
        made[name] = values
    made["nx"] = rng.normal(size=count)
    return made


def columns(rows: np.ndarray, names: Iterable[str] = "xyz") -> np.ndarray:
    return np.stack([rows[name] for name in names], axis=1).astype(float)


def covariances(rows: np.ndarray) -> np.ndarray:
    """Return the covariance of each Gaussian, as a renderer makes it of scales and rotation."""
    turn = Rotation.from_quat(columns(rows, ROTATION)).as_matrix()
    half = turn * np.exp(columns(rows, SCALE))[:, None, :]
    return half @ half.transpose(0, 2, 1)


@pytest.mark.parametrize("axes", ["trellis", "glb", "slat"])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_rigid_motion_moves_and_turns_each_gaussian_exactly(axes, seed):
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    saved = random_gaussians(50, seed)
    places = columns(saved) @ SAVED_AXES[axes]  # of the file, to the SLAT frame
    motion = np.tile(turn, (len(REST), 1, 1))
    carrier = gaussians.bind(places, REST, H)
    moved, gradients = gaussians.carry(carrier, REST @ turn.T + shift, motion)
    np.testing.assert_allclose(moved, places @ turn.T + shift, atol=1e-9)
    rows = gaussians.deform(saved, moved, gradients, axes)
    np.testing.assert_allclose(columns(rows) @ SAVED_AXES[axes], moved, atol=1e-6)
    # A renderer sees the same covariance, turned in the axes of the file.
    in_file = SAVED_AXES[axes] @ turn @ SAVED_AXES[axes].T
    expected = in_file @ covariances(saved) @ in_file.T
    np.testing.assert_allclose(covariances(rows), expected, rtol=1e-4, atol=1e-8)
    changed = {"x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3"}
    for name in set(saved.dtype.names or ()) - changed:
        np.testing.assert_array_equal(rows[name], saved[name])


@given(seed=st.integers(0, 2**32 - 1))
def test_an_affine_motion_deforms_covariances_where_asked(seed):
    affine = np.eye(3) + np.random.default_rng(seed).uniform(-0.25, 0.25, (3, 3))
    saved = random_gaussians(40, seed)
    motion = np.tile(affine, (len(REST), 1, 1))
    carrier = gaussians.bind(columns(saved), REST, H)
    moved, gradients = gaussians.carry(carrier, REST @ affine.T, motion)
    np.testing.assert_allclose(moved, columns(saved) @ affine.T, atol=1e-9)
    rows = gaussians.deform(saved, moved, gradients, "slat", stretch=True)
    expected = affine @ covariances(saved) @ affine.T
    np.testing.assert_allclose(covariances(rows), expected, rtol=2e-3, atol=1e-8)
    turned = gaussians.rotations(gradients)
    eyes = np.broadcast_to(np.eye(3), turned.shape)
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), eyes, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(turned), 1.0)
    # Where a side has turned inside out a little, the others tell how it is turned.
    np.testing.assert_allclose(gaussians.rotations(turned * [1, 0.9, -0.1]), turned, atol=1e-9)


def test_files_of_gaussians_keep_every_field(tmp_path):
    saved = random_gaussians(30)
    gaussians.write_gaussians(tmp_path / "g.ply", saved, "frame SLAT, unit cube -0.5..0.5, z up")
    np.testing.assert_array_equal(plyfile.PlyData.read(tmp_path / "g.ply")["vertex"].data, saved)


def test_the_nearest_gaussian_is_drawn_in_its_colour(tmp_path):
    # Seen from the front, y grows away from the eye.
    places = np.array([[0.0, -0.3, 0.0], [0.0, 0.3, 0.16], [0.3, 0.0, 0.3]])
    rows = gaussians.gaussians_of(places, np.array([0, 1, 2], np.uint8), 0.4)
    rows["opacity"][2] = -6.0  # As good as transparent.
    for name in SCALE:
        rows[name] = np.log(0.08)
    picture = gaussians.draw(rows, places, np.full(3, -0.5), np.full(3, 0.5), pixels=100)
    seen = {tuple(colour) for colour in picture.reshape(-1, 3)}
    front = tuple((gaussians.colours_of(rows)[0] * 255).astype(np.uint8))
    assert front in seen and len(seen) == 3  # paper, the front one, the shaded one behind
    gaussians.write_picture(tmp_path / "new/a.png", [picture, picture[::-1].copy()], 20)
    with Image.open(tmp_path / "new/a.png") as strip:
        assert strip.size == (2 * picture.shape[1], picture.shape[0])


@pytest.mark.parametrize(("suffix", "rate", "shown"), [
    ("gif", 20, 61), ("gif", 30, 61), ("gif", 50, 61), ("gif", 60, 30), ("gif", 100, 30),
    ("gif", 200, 15), ("webp", 30, 61), ("webp", 200, 61),
])  # fmt: skip
def test_an_animation_takes_as_long_as_the_motion(suffix, rate, shown, tmp_path):
    """A GIF shows no frame for less than two hundredths of a second, as programs slow those."""
    frames = list(np.random.default_rng(0).integers(0, 256, (61, 24, 24, 3), dtype=np.uint8))
    gaussians.write_picture(tmp_path / f"a.{suffix}", frames, rate)
    with Image.open(tmp_path / f"a.{suffix}") as animation:
        assert animation.n_frames == shown
        lasts = []
        for number in range(animation.n_frames):
            animation.seek(number)
            animation.load()
            lasts.append(animation.info["duration"])
    assert sum(lasts) == pytest.approx(1000 * len(frames) / rate, abs=5)
    assert max(lasts[:-1]) - min(lasts) <= 10


def test_a_picture_that_fails_leaves_the_older_one(tmp_path):
    (tmp_path / "a.gif").write_text("older")
    with pytest.raises(OverflowError):  # GIF has 16 bits for a height.
        gaussians.write_picture(tmp_path / "a.gif", [np.zeros((70_000, 1, 3), np.uint8)], 20)
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]
    assert (tmp_path / "a.gif").read_text() == "older"


def write_prediction(path: Path) -> np.ndarray:
    coords = make_asset(0).coords
    stuff = np.tile([3e5, JELLY[2], JELLY[3]], (len(coords), 1))
    np.savez(path, coords=coords, material=np.zeros(len(coords), int), properties_si=stuff)
    return coords


@pytest.mark.parametrize(("words", "said"), [
    (("--picture", "a.mp4"), "expected a name that ends in .gif, .png, .webp"),
    (("--asset", "cup"), "expected either --asset, with --store, or --prediction"),
    (("--gaussians", "points.ply"), "expected a PLY of Gaussians"),
])  # fmt: skip
def test_what_cannot_be_simulated_is_said(words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    coords = write_prediction(tmp_path / "p.npz")
    rows = np.zeros(len(coords), [(axis, "f4") for axis in "xyz"])
    for axis, values in zip("xyz", ((coords + 0.5) / 64 - 0.5).T, strict=True):
        rows[axis] = values
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write("points.ply")
    done = run("simulate", "--prediction", "p.npz", "--out", "frames", *words, code=None)
    assert done.exit_code in (1, 2) and said in done.stderr, done.stderr
    assert not (tmp_path / "frames").exists()


def test_a_shorter_run_leaves_no_frames_of_a_longer_one(tmp_path):
    coords = write_prediction(tmp_path / "p.npz")
    stuff = np.tile(np.float32(JELLY[1:]), (len(coords), 1))
    field = VoxelField(coords.astype(np.uint8), np.zeros(len(coords), np.uint8), stuff)
    scene = motion.prepare(field, None, None, 8)
    for count in (3, 2):
        moved = np.repeat(scene.positions[None], count, axis=0)
        gradients = np.tile(np.eye(3, dtype=np.float32), (*moved.shape[:2], 1, 1))
        out = tmp_path / "frames"
        motion.write_frames(out, scene, (moved, gradients), 30, None, False, lambda *_: None)
        (out / "frame-0001-mine.ply").touch()
    names = sorted(path.name for path in out.iterdir())
    assert names == ["frame-0000.ply", "frame-0001-mine.ply", "frame-0001.ply"]
    (out / "frame-2024.ply").write_text("mine")
    with pytest.raises(ConfigError, match=r"frame-2024\.ply is no frame of slatprep"):
        motion.write_frames(out, scene, (moved, gradients), 30, None, False, lambda *_: None)
    assert sorted(path.name for path in out.iterdir()) == [*names, "frame-2024.ply"]


def test_a_run_that_is_stopped_keeps_the_frames_it_has_not_replaced(tmp_path):
    coords = write_prediction(tmp_path / "p.npz")
    stuff = np.tile(np.float32(JELLY[1:]), (len(coords), 1))
    field = VoxelField(coords.astype(np.uint8), np.zeros(len(coords), np.uint8), stuff)
    scene, out = motion.prepare(field, None, None, 8), tmp_path / "frames"

    def stop(done: int, total: int) -> None:
        if (done, total) == (1, 2):
            raise KeyboardInterrupt

    def write(count: int) -> None:
        moved = np.repeat(scene.positions[None], count, axis=0)
        gradients = np.tile(np.eye(3, dtype=np.float32), (*moved.shape[:2], 1, 1))
        motion.write_frames(out, scene, (moved, gradients), 30, None, False, stop)

    write(4)
    with pytest.raises(KeyboardInterrupt):
        write(2)
    assert len(list(out.iterdir())) == 4


LONE = np.zeros((64, 64, 64), dtype=bool)
LONE[32, 32, 32] = True


@pytest.mark.parametrize("start", [20, 21])
@pytest.mark.parametrize(("thick", "layers"), [(1, 1), (2, None), (3, 2), (4, None)])
def test_thin_parts_have_the_same_particles_wherever_they_lie(start, thick, layers):
    """A layer of particles stands for two of voxels, or for the one that it has."""
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[10:30, 10:30, start : start + thick] = True
    if layers is None:  # Between two layers of particles, half of each is filled.
        layers = thick // 2 + start % 2
    places = motion.particles_of(solid, 32)
    assert len(places) == 100 * layers
    np.testing.assert_allclose(places[:, :2].mean(axis=0), 20 / 64 - 0.5)
    assert not len(motion.particles_of(LONE, 32))


@pytest.mark.parametrize("count", [28, 48, 52, 96])
def test_a_symmetric_slab_has_symmetric_particles(count):
    """Its faces lie in the middle of lattice cubes or between them: half counts."""
    for half in range(4, 32):
        solid = np.zeros((64, 64, 64), dtype=bool)
        solid[16:48, 16:48, 32 - half : 32 + half] = True
        heights = np.unique(motion.particles_of(solid, count)[:, 2])
        np.testing.assert_allclose(heights, -heights[::-1], atol=1e-12)
        # Each side has the lattice cubes whose centre it holds, one more where it ends in it.
        assert len(heights) == 2 * int(half * count / 64 + 0.5)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.sampled_from([28, 32, 48, 64, 100, 128]))
def test_particles_lie_as_the_solid_does(seed, count):
    rng = np.random.default_rng(seed)
    axes, middle = rng.uniform(8, 20, 3), rng.uniform(24, 40, 3)
    cells = np.stack(np.indices((64, 64, 64)), axis=-1)
    solid = (((cells - middle) / axes) ** 2).sum(axis=-1) < 1
    places = motion.particles_of(solid, count)
    edge = 64 / count
    inside = (np.argwhere(solid) + 0.5) / 64 - 0.5
    assert 64 * np.abs(places.mean(axis=0) - inside.mean(axis=0)).max() < 0.15 * max(edge, 1)
    if count % 64 == 0:  # Each voxel has its own.
        assert len(places) == solid.sum() * (count // 64) ** 3
    else:
        assert len(places) * edge**3 == pytest.approx(solid.sum(), rel=0.05 * edge)


def test_what_is_given_for_the_whole_object_is_taken(tmp_path, monkeypatch):
    coords = write_prediction(tmp_path / "p.npz").astype(np.uint8)
    stuff = np.tile(np.float32(JELLY[1:]), (len(coords), 1))
    field = VoxelField(coords, np.zeros(len(coords), np.uint8), stuff)
    scene = motion.prepare(field, None, None, 32, material="metal", young=7e6, density=9e2)
    assert set(scene.material.tolist()) == {METAL[0]}
    expected = [7e6, 9e2, JELLY[3]]
    np.testing.assert_allclose(scene.properties, np.tile(expected, (len(scene.positions), 1)))
    (told,) = motion.prepare(field, None, None, 10).notes
    volume = len(motion.prepare(field, None, None, 64).positions) / 64**3
    share = len(motion.prepare(field, None, None, 10).positions) / 10**3 / volume
    assert told.startswith(f"the particles fill {share:.3g} times the object's volume")

    def still(
        places: np.ndarray, *stuff: np.ndarray, fixed: np.ndarray, **options: object
    ) -> Motion:
        held.append((fixed, {"places": places, "apart": stuff[2], **options}))
        return Motion(places[None], np.eye(3, dtype=np.float32))

    held: list[tuple[np.ndarray, dict[str, object]]] = []
    monkeypatch.setattr("slatprep.particles.simulate.simulate_motion", still)
    heights = scene.positions[:, 2]
    potted = heights > heights.max() - 0.1 / 32
    scene.material[potted] = np.resize([2, 6], potted.sum())  # Soil and its pot do not move.
    motion.run(scene, size=0.5, height=0.3, wind=4.0, device="cpu", seconds=1)
    ((fixed, options),) = held
    np.testing.assert_array_equal(options["places"], scene.positions / 2)
    assert options["apart"] == 0.5 / 32
    lowest = heights < heights.min() + 1.1 / 32
    np.testing.assert_array_equal(fixed, lowest | potted)
    assert (options["height"], options["gravity"], options["wind"]) == (0.0, 0.0, (4.0, 0.0, 0.0))


def test_an_object_without_a_particle_is_told_in_words():
    nothing = motion.Scene(np.zeros((0, 3)), 1.0, *[np.zeros(0)] * 4, "slat", ())  # type: ignore[arg-type]
    with pytest.raises(SlatprepError, match="no particles to simulate; raise --particles"):
        motion.run(nothing, size=1.0, height=0.1, wind=0.0, device="cpu", seconds=0.1)


@needs_newton
def test_gaussians_of_trellis_fall_as_the_object_does(tmp_path):
    coords = write_prediction(tmp_path / "p.npz")
    places = (coords[::3] + 0.5) / 64 - 0.5
    classes = np.zeros(len(places), np.uint8)
    saved = gaussians.gaussians_of(places @ SAVED_AXES["trellis"].T, classes, 1 / 64)
    saved["nx"] = np.arange(len(saved))
    gaussians.write_gaussians(tmp_path / "g.ply", saved, "by nobody")
    size, rate = 0.4, 40
    told = document(
        "simulate", "--gaussians", tmp_path / "g.ply", "--prediction", tmp_path / "p.npz",
        "--out", tmp_path / "frames", "--size", size, "--height", 0.2, "--seconds", 0.15,
        "--rate", rate, "--substeps", 4, "--particles", 16, "--device", "cpu",
        "--picture", tmp_path / "fall.gif",
    )  # fmt: skip
    assert told["frames"] == 7  # What the engine prints is not between.
    frames = [
        plyfile.PlyData.read(tmp_path / "frames" / f"frame-{number:04d}.ply")["vertex"].data
        for number in range(7)
    ]
    np.testing.assert_array_equal(frames[0]["nx"], saved["nx"])
    np.testing.assert_allclose(columns(frames[0]), columns(saved), atol=1e-6)
    # The file's y points down. Free fall; implicit steps of dt fall g t dt / 2 further.
    for number, frame in enumerate(frames):
        t, dt = number / rate, 1 / (4 * rate)
        fallen = (frame["y"] - saved["y"]).mean() * size
        assert fallen == pytest.approx(9.81 / 2 * (t**2 + t * dt), rel=0.02, abs=1e-4)
        np.testing.assert_allclose(frame["rot_0"], 1.0, atol=2e-3)
    with Image.open(tmp_path / "fall.gif") as animation:
        assert animation.n_frames >= 6


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[np.ndarray, ...]]:
    folder = tmp_path_factory.mktemp("drop")
    return folder, drop.particles(open_store(drop.make_store(folder)), "drop", 32, folder)


def test_particles_have_the_materials_that_were_made(made):
    positions, material, properties = made[1]
    # The SLAT is a quarter turn from the grid: (x, y) there is (-y, x) here.
    x, y, z = positions[:, 1], -positions[:, 0], positions[:, 2]
    reach = np.sqrt((x - 0.09) ** 2 + (y - 0.03) ** 2 + (z - 0.07) ** 2)
    clear = abs(reach - 0.17) > 1 / 64  # within a voxel of the sphere the lattice decides
    np.testing.assert_array_equal(material[clear], (reach < 0.17)[clear])
    for number, density, modulus, ratio in (drop.JELLY, drop.STEEL):
        here = material == number
        assert here.sum() > 500
        expected = np.broadcast_to([modulus, density, ratio], (here.sum(), 3))
        np.testing.assert_allclose(properties[here], expected, rtol=1e-4)


def test_picture_shows_the_jelly_strained_and_the_steel_not(made, tmp_path, monkeypatch):
    monkeypatch.setattr(drop_picture, "SIZE", (200, 200))
    positions, material, _ = made[1]
    rest = positions + np.array([0.0, 0.0, 0.5])
    squeezed = rest * np.where(material[:, None] == 0, [1.2, 1.2, 1.0], 1.0)
    frames = np.stack([rest, squeezed])
    strains = np.stack([strain(rest, frame, material, 1 / 32) for frame in frames])
    asset = open_store(made[0] / "drop.zarr").asset("drop")
    parts = [drop_picture.Part(number, "", shiny=number == 1) for number in (0, 1)]
    drawn = (positions, frames, strains, material, asset, parts, (0, 1))
    drop_picture.draw(tmp_path / "drop.png", *drawn)
    with Image.open(tmp_path / "drop.png") as image:
        pixels = np.asarray(image.convert("RGB"), dtype=int)
    # Strain is drawn reddish; light and shadow on what is at rest are grey.
    reddish, middle = pixels[:430, :, 0] - pixels[:430, :, 1] > 40, pixels.shape[1] // 2
    assert not reddish[:, 100:middle].any() and reddish[:, middle:-250].sum() > 1000


def test_a_short_run_is_drawn_within_its_frames():
    assert drop.chosen_frames(31, 0.25, 19) == (0, 13, 19, 30)
    assert drop.chosen_frames(7, 0.25, 6) == (0, 6)  # 0.1 s: over before the ground is reached
    assert drop.chosen_frames(2, 0.25, 0) == (0, 1)


@pytest.mark.parametrize(("example", "arguments", "said"), [
    (drop, ["--seconds", "0.001"], "--seconds is 0.001; expected at least 0.017"),
    (drop, ["--asset", "x"], "--store and --asset go together"),
    (drop, ["--store", "{store}", "--asset", "drop"], "drop has sand; expected an object of jelly"),
    (drop, ["--store", "nowhere.zarr", "--asset", "x"], "nowhere.zarr"),
    (scenes, [], "expected --store with --asset, or --prediction, or both"),
    (scenes, ["--asset", "cup"], "expected --store with --asset"),
    (scenes, ["--prediction", "p.npz", "--out", "x.avi"], "a name that ends in .png or .gif"),
    (scenes, ["--prediction", "p.npz", "--seconds", "0"], "--seconds of a frame at least"),
    (scenes, ["--prediction", "nowhere.npz"], "nowhere.npz"),
])  # fmt: skip
def test_what_fails_is_said_in_a_line(example, arguments, said, tmp_path, monkeypatch, capsys):
    if "{store}" in arguments:
        monkeypatch.setattr(drop, "JELLY", (2, *drop.JELLY[1:]))  # sand
        arguments = [str(drop.make_store(tmp_path)) if a == "{store}" else a for a in arguments]
    out = [] if "--out" in arguments else ["--out", str(tmp_path / "drop.png")]
    monkeypatch.setattr(sys, "argv", ["it.py", *arguments, *out])
    with pytest.raises(SystemExit) as caught:
        example.main()
    assert caught.value.code in (1, 2)
    assert said in capsys.readouterr().err
    assert not (tmp_path / "drop.png").exists()


COUNT = 8
BLOCK = np.argwhere(np.ones((4, 4, 4))) / COUNT - 0.25


@pytest.fixture
def prediction(store: Path, tmp_path: Path) -> Path:
    """A prediction that calls the asset `cup` water."""
    coords = open_store(store).asset("cup").coords
    np.savez(tmp_path / "water.npz", coords=coords, material=np.full(len(coords), 4),
             properties_si=np.tile([2e5, 1e3, 0.45], (len(coords), 1)))  # fmt: skip
    return tmp_path / "water.npz"


def test_objects_have_the_materials_of_their_source(store, prediction):
    named = {"store": store, "asset": ["cup"], "prediction": [prediction]}
    found = scenes.objects(argparse.Namespace(**named, ranges=None))
    assert list(found) == ["cup", "water"]
    for name, (coords, field) in found.items():
        given = scenes.transfer(scenes.fill(coords, 32), field, far="nearest")
        expected = {4} if name == "water" else {JELLY[0], METAL[0]}
        assert set(given.material.tolist()) == expected


def test_a_strip_shows_the_object_fall_and_a_gif_every_frame(tmp_path, monkeypatch):
    monkeypatch.setattr(drop_picture, "SIZE", (160, 160))
    falls = np.linspace(0.9, 0.3, 5)[:, None, None] * np.array([0.0, 0.0, 1.0]) + BLOCK
    water = scenes.Scene("water", falls, np.full(len(BLOCK), 4))
    snow = scenes.Scene("snow", falls[::-1], np.full(len(BLOCK), 5))

    scenes.write(tmp_path / "strip.png", [water, snow], 3, COUNT)
    with Image.open(tmp_path / "strip.png") as image:
        pixels = np.asarray(image.convert("RGB"), dtype=int)
    half, third = pixels.shape[0] // 2, pixels.shape[1] // 3
    for row, (scene, order) in enumerate(((water, 1), (snow, -1))):
        heights = []
        for column in range(3):
            panel = pixels[row * half : (row + 1) * half, column * third : (column + 1) * third]
            coloured = np.ptp(panel, axis=2) > 40
            assert coloured.sum() > 100, scene.name
            heights.append(np.nonzero(coloured)[0].mean())
        assert heights == sorted(heights)[::order]

    scenes.write(tmp_path / "both.gif", [water, snow], 3, COUNT)
    with Image.open(tmp_path / "both.gif") as animation:
        assert animation.n_frames == 5
        assert animation.size == (160, 80)


@needs_newton
def test_a_prediction_is_moved_and_drawn(prediction, tmp_path, monkeypatch):
    monkeypatch.setattr(drop_picture, "SIZE", (160, 160))
    words = ("--prediction", prediction, "--particles", COUNT, "--seconds", 0.2, "--substeps", 1)
    words += ("--out", tmp_path / "water.gif")
    monkeypatch.setattr(sys, "argv", ["scenes.py", *map(str, words)])
    scenes.main()
    with Image.open(tmp_path / "water.gif") as animation:
        assert animation.n_frames == 7

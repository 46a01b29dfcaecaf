"""Gaussians follow the particles around them: rigid motions exactly, everything else kept."""

import importlib.util
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import plyfile
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation
from support.commands import document, run
from support.synthetic import JELLY, make_asset

from slatprep.particles.gaussians import (
    bind,
    carry,
    colours_of,
    deform,
    draw,
    gaussians_of,
    rotations,
    write_gaussians,
    write_picture,
)
from slatprep.particles.read import SAVED_AXES

H = 1 / 16
REST = (np.indices((5, 6, 7)).reshape(3, -1).T - 3) * H
NEWTON = pytest.mark.skipif(
    importlib.util.find_spec("newton") is None, reason="Newton is not installed: make simulate"
)


ROTATION, SCALE = [f"rot_{i}" for i in (1, 2, 3, 0)], [f"scale_{i}" for i in range(3)]


def random_gaussians(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    places = rng.uniform(REST.min(axis=0), REST.max(axis=0), (count, 3))
    made = gaussians_of(places, rng.integers(0, 7, count).astype(np.uint8), H)
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
    moved, gradients = carry(bind(places, REST, H), REST @ turn.T + shift, motion)
    np.testing.assert_allclose(moved, places @ turn.T + shift, atol=1e-9)
    rows = deform(saved, moved, gradients, axes)
    np.testing.assert_allclose(columns(rows) @ SAVED_AXES[axes], moved, atol=1e-6)
    # A renderer sees the same covariance, turned in the axes of the file.
    in_file = SAVED_AXES[axes] @ turn @ SAVED_AXES[axes].T
    np.testing.assert_allclose(
        covariances(rows), in_file @ covariances(saved) @ in_file.T, rtol=1e-4, atol=1e-8
    )
    changed = {"x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3"}
    for name in set(saved.dtype.names or ()) - changed:
        np.testing.assert_array_equal(rows[name], saved[name])


@given(seed=st.integers(0, 2**32 - 1))
def test_an_affine_motion_deforms_covariances_where_asked(seed):
    rng = np.random.default_rng(seed)
    affine = np.eye(3) + rng.uniform(-0.25, 0.25, (3, 3))
    saved = random_gaussians(40, seed)
    motion = np.tile(affine, (len(REST), 1, 1))
    carrier = bind(columns(saved), REST, H)
    moved, gradients = carry(carrier, REST @ affine.T, motion)
    np.testing.assert_allclose(moved, columns(saved) @ affine.T, atol=1e-9)
    rows = deform(saved, moved, gradients, "slat", stretch=True)
    expected = affine @ covariances(saved) @ affine.T
    np.testing.assert_allclose(covariances(rows), expected, rtol=2e-3, atol=1e-8)
    turned = rotations(gradients)
    eyes = np.broadcast_to(np.eye(3), turned.shape)
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), eyes, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(turned), 1.0)


def test_files_of_gaussians_keep_every_field(tmp_path):
    saved = random_gaussians(30)
    write_gaussians(tmp_path / "g.ply", saved, "frame SLAT, unit cube -0.5..0.5, z up")
    vertex = plyfile.PlyData.read(tmp_path / "g.ply")["vertex"].data
    np.testing.assert_array_equal(vertex, saved)


def test_the_nearest_gaussian_is_drawn_in_its_colour(tmp_path):
    # Seen from the front, y grows away from the eye.
    places = np.array([[0.0, -0.3, 0.0], [0.0, 0.3, 0.16], [0.3, 0.0, 0.3]])
    rows = gaussians_of(places, np.array([0, 1, 2], np.uint8), 0.4)
    rows["opacity"][2] = -6.0  # As good as transparent.
    for name in SCALE:
        rows[name] = np.log(0.08)
    picture = draw(rows, places, np.full(3, -0.5), np.full(3, 0.5), pixels=100)
    seen = {tuple(colour) for colour in picture.reshape(-1, 3)}
    front = tuple((colours_of(rows)[0] * 255).astype(np.uint8))
    assert front in seen and len(seen) == 3  # paper, the front one, the shaded one behind
    for suffix in ("png", "gif"):
        write_picture(tmp_path / f"a.{suffix}", [picture, picture[::-1].copy()], 20)
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.n_frames == 2


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


@NEWTON
def test_gaussians_of_trellis_fall_as_the_object_does(tmp_path):
    coords = write_prediction(tmp_path / "p.npz")
    places = (coords[::3] + 0.5) / 64 - 0.5
    saved = gaussians_of(places @ SAVED_AXES["trellis"].T, np.zeros(len(places), np.uint8), 1 / 64)
    saved["nx"] = np.arange(len(saved))
    write_gaussians(tmp_path / "g.ply", saved, "by nobody")
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

"""The examples that move objects: from a store or a prediction to particles, and what they draw."""

import argparse
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.synthetic import JELLY, METAL

from slatprep.particles.simulate import strain
from slatprep.pipeline.dataset import BuildSummary
from slatprep.store import open_store

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import drop
import drop_picture
import scenes


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[np.ndarray, ...]]:
    folder = tmp_path_factory.mktemp("drop")
    store = open_store(drop.make_store(folder))
    return folder, drop.particles(store, "drop", 32, folder)


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
    drop_picture.draw(
        tmp_path / "drop.png", positions, frames, strains, material, asset, parts, (0, 1)
    )
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
def test_what_cannot_be_done_is_said_in_a_line(
    example, arguments, said, tmp_path, monkeypatch, capsys
):
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
def prediction(mixed_build: BuildSummary, tmp_path: Path) -> Path:
    """A prediction that calls the asset `cup` water."""
    coords = open_store(mixed_build.store).asset("cup").coords
    np.savez(tmp_path / "water.npz", coords=coords, material=np.full(len(coords), 4),
             properties_si=np.tile([2e5, 1e3, 0.45], (len(coords), 1)))  # fmt: skip
    return tmp_path / "water.npz"


def test_objects_have_the_materials_of_their_source(mixed_build, prediction):
    named = {"store": mixed_build.store, "asset": ["cup"], "prediction": [prediction]}
    found = scenes.objects(argparse.Namespace(**named, ranges=None))
    assert list(found) == ["cup", "water"]
    for name, (coords, field) in found.items():
        positions = scenes.fill(coords, 32)
        given = scenes.transfer(positions, field, far="nearest")
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


@pytest.mark.skipif(
    importlib.util.find_spec("newton") is None, reason="needs the extra `simulate`; make simulate"
)
def test_a_prediction_is_moved_and_drawn(prediction, tmp_path, monkeypatch):
    monkeypatch.setattr(drop_picture, "SIZE", (160, 160))
    words = ("--prediction", prediction, "--particles", COUNT, "--seconds", 0.2, "--substeps", 1)
    words += ("--out", tmp_path / "water.gif")
    monkeypatch.setattr(sys, "argv", ["scenes.py", *map(str, words)])
    scenes.main()
    with Image.open(tmp_path / "water.gif") as animation:
        assert animation.n_frames == 7

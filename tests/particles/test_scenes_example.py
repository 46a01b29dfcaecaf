"""The example that moves stored and predicted objects: what it moves, and what it draws."""

import argparse
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.synthetic import JELLY, METAL

from slatprep.pipeline.dataset import BuildSummary
from slatprep.store import open_store

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import drop_picture
import scenes

COUNT = 8
BLOCK = np.argwhere(np.ones((4, 4, 4))) / COUNT - 0.25


@pytest.fixture
def prediction(mixed_build: BuildSummary, tmp_path: Path) -> Path:
    """A prediction that calls the asset `cup` water."""
    coords = open_store(mixed_build.store).asset("cup").coords
    np.savez(tmp_path / "water.npz", coords=coords, material=np.full(len(coords), 4),
             properties_si=np.tile([2e5, 1e3, 0.45], (len(coords), 1)))  # fmt: skip
    return tmp_path / "water.npz"


def command(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["scenes.py", *map(str, words)])
    scenes.main()


def test_objects_have_the_materials_of_their_source(mixed_build, prediction):
    found = scenes.objects(
        argparse.Namespace(
            store=mixed_build.store, asset=["cup"], prediction=[prediction], ranges=None
        )
    )
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


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "expected --store with --asset, or --prediction, or both"),
        (["--asset", "cup"], "expected --store with --asset"),
        (["--prediction", "p.npz", "--out", "x.avi"], "a name that ends in .png or .gif"),
        (["--prediction", "p.npz", "--seconds", "0"], "--seconds of a frame at least"),
        (["--prediction", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_what_cannot_be_moved_is_said_in_a_line(words, said, monkeypatch, capsys):
    with pytest.raises(SystemExit) as caught:
        command(monkeypatch, *words)
    assert caught.value.code in (1, 2)
    assert said in capsys.readouterr().err


@pytest.mark.skipif(
    importlib.util.find_spec("newton") is None, reason="needs the extra `simulate`; make simulate"
)
def test_a_prediction_is_moved_and_drawn(prediction, tmp_path, monkeypatch):
    monkeypatch.setattr(drop_picture, "SIZE", (160, 160))
    command(
        monkeypatch, "--prediction", prediction, "--particles", COUNT, "--seconds", 0.2,
        "--substeps", 1, "--out", tmp_path / "water.gif",
    )  # fmt: skip
    with Image.open(tmp_path / "water.gif") as animation:
        assert animation.n_frames == 7

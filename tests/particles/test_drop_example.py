"""The example's way from a store to particles, and its picture of a motion that is known."""

import sys
from pathlib import Path

import numpy as np
import pytest

from slatprep.particles.simulate import strain
from slatprep.store import open_store

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import drop
import drop_picture


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
    from PIL import Image

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
    left, right = (
        pixels[:430, 100 : pixels.shape[1] // 2],
        pixels[:430, pixels.shape[1] // 2 : -250],
    )
    # Strain is drawn reddish; light and shadow on what is at rest are grey.
    reddish = [((side[..., 0] - side[..., 1]) > 40).sum() for side in (left, right)]
    assert reddish[0] == 0 and reddish[1] > 1000


def test_a_short_run_is_drawn_within_its_frames():
    assert drop.chosen_frames(31, 0.25, 19) == (0, 13, 19, 30)
    assert drop.chosen_frames(7, 0.25, 6) == (0, 6)  # 0.1 s: over before the ground is reached
    assert drop.chosen_frames(2, 0.25, 0) == (0, 1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--seconds", "0.001"], "--seconds is 0.001; expected at least 0.017"),
        (["--asset", "x"], "--store and --asset go together"),
        (["--store", "{store}", "--asset", "drop"], "drop has sand; expected an object of jelly"),
        (["--store", "nowhere.zarr", "--asset", "x"], "nowhere.zarr"),
    ],
)
def test_what_cannot_be_dropped_is_said_in_a_line(arguments, said, tmp_path, monkeypatch, capsys):
    if "{store}" in arguments:
        monkeypatch.setattr(drop, "JELLY", (2, *drop.JELLY[1:]))  # sand
        arguments = [str(drop.make_store(tmp_path)) if a == "{store}" else a for a in arguments]
    monkeypatch.setattr(sys, "argv", ["drop.py", *arguments, "--out", str(tmp_path / "drop.png")])
    with pytest.raises(SystemExit) as caught:
        drop.main()
    assert caught.value.code in (1, 2)
    assert said in capsys.readouterr().err
    assert not (tmp_path / "drop.png").exists()

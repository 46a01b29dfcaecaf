"""Voxels are drawn as geometry says they must be seen, in colours that are apart for everyone."""

import itertools

import numpy as np
import pytest
from support.synthetic import QUARTER_TURN

from slatprep.geometry.frames import VOXEL_SIZE, make_transform, voxel_centres
from slatprep.inspect.pictures import canvas
from slatprep.inspect.pictures.scene import rgb
from slatprep.inspect.pictures.voxels import View, draw_voxels, view_rotation
from slatprep.records import CLASS_COLOURS

RED, BLUE = [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]
FRONT = View(view_rotation(270, 0), np.zeros(3), 0.5, 64)


def pixel_of(view: View, point: np.ndarray) -> tuple[int, int]:
    right, up, _ = view.to_view(point[None])[0] / view.half_width * view.size / 2
    return int(np.floor(view.size / 2 - up)), int(np.floor(right + view.size / 2))


def test_straight_on_a_voxel_is_one_pixel_where_it_should_be():
    voxel = np.array([[5, 30, 50]])
    cover = draw_voxels(voxel, np.array([RED]), np.eye(4), FRONT).cover
    # Seen from -y: x to the right, z upwards, and one voxel as wide as a pixel.
    assert cover[63 - 50, 5] == 1
    cover[63 - 52 : 63 - 47, 3:8] = 0
    assert cover.sum() == 0


def test_the_nearer_voxel_is_seen():
    voxels = np.array([[32, 10, 32], [32, 50, 32]])
    colours = np.array([RED, BLUE])
    row, column = pixel_of(FRONT, voxel_centres(voxels[0]))
    for order in ([0, 1], [1, 0]):
        seen = draw_voxels(voxels[order], colours[order], np.eye(4), FRONT).rgb[row, column]
        assert seen[0] > 0.5 > seen[2]
    back = View(view_rotation(90, 0), np.zeros(3), 0.5, 64)
    row, column = pixel_of(back, voxel_centres(voxels[0]))
    seen = draw_voxels(voxels, colours, np.eye(4), back).rgb[row, column]
    assert seen[2] > 0.5 > seen[0]


@pytest.mark.parametrize("azimuth", [0, 37, 300])
@pytest.mark.parametrize("elevation", [0, 22, 90])
def test_the_area_covered_is_that_of_the_projected_box(azimuth, elevation):
    size = np.array([10, 20, 30])
    voxels = np.argwhere(np.ones(size)) + 20
    view = View(view_rotation(azimuth, elevation), np.zeros(3), 0.5, 400)
    drawing = draw_voxels(voxels, np.tile(RED, (len(voxels), 1)), np.eye(4), view)
    area = drawing.cover.sum() * (2 * view.half_width / view.size / VOXEL_SIZE) ** 2
    towards = np.abs(view.rotation[2])
    expected = towards @ [size[1] * size[2], size[0] * size[2], size[0] * size[1]]
    assert area == pytest.approx(expected, rel=0.03)
    assert np.isclose(drawing.cover, 0).any()
    assert (drawing.rgb[drawing.cover == 0] == 1).all()


def test_a_moved_set_looks_like_the_set_that_was_moved():
    rng = np.random.default_rng(0)
    voxels = np.unique(rng.integers(16, 48, (400, 3)), axis=0)
    turned = np.stack([63 - voxels[:, 1], voxels[:, 0], voxels[:, 2]], axis=1)
    colours = rng.uniform(size=(len(voxels), 3))
    view = View(view_rotation(300, 22), np.zeros(3), 0.6, 120)
    here = draw_voxels(voxels, colours, QUARTER_TURN, view)
    there = draw_voxels(turned, colours, np.eye(4), view)
    np.testing.assert_allclose(here.cover, there.cover, atol=0.34)
    assert np.abs(here.rgb - there.rgb).mean() < 0.003


def test_what_lies_outside_the_picture_is_left_out():
    far = make_transform(np.eye(3), (3.0, 0.0, 0.0))
    assert draw_voxels(np.array([[0, 0, 0]]), np.array([RED]), far, FRONT).cover.sum() == 0
    nothing = draw_voxels(np.empty((0, 3), np.uint8), np.empty((0, 3)), np.eye(4), FRONT)
    assert (nothing.rgb == 1).all()


# Machado, Oliveira, Fernandes 2009, severity 1.0, on linear RGB.
SEEN_BY = {
    "all cones": np.eye(3),
    "protanope": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                  [-0.003882, -0.048116, 1.051998]],
    "deuteranope": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                    [-0.011820, 0.042940, 0.968881]],
    "tritanope": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                  [0.004733, 0.691367, 0.303900]],
}  # fmt: skip
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
     [0.0193339, 0.1191920, 0.9503041]]
)  # fmt: skip


def linear(colour: str) -> np.ndarray:
    value = rgb(colour)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def lab(colour: str, seen_by: str) -> np.ndarray:
    seen = np.clip(np.array(SEEN_BY[seen_by]) @ linear(colour), 0, 1)
    xyz = TO_XYZ @ seen / [0.95047, 1, 1.08883]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("seen_by", SEEN_BY)
def test_classes_differ_for_everyone(seen_by):
    seen = {name: lab(colour, seen_by) for name, colour in CLASS_COLOURS.items()}
    for one, other in itertools.combinations(seen, 2):
        assert np.linalg.norm(seen[one] - seen[other]) > 20, (one, other)


@pytest.mark.parametrize("seen_by", SEEN_BY)
def test_distances_only_darken(seen_by):
    lightness = [lab(colour, seen_by)[0] for colour in canvas.DISTANCE_COLOURS]
    assert (np.diff(lightness) < -10).all()


@pytest.mark.parametrize("colour", [canvas.INK, canvas.MUTED, *canvas.VERDICT_COLOURS.values()])
def test_text_stands_out_from_the_paper(colour):
    # 4.5 is what WCAG 2 asks for text.
    paper, text = (float(TO_XYZ[1] @ linear(name)) + 0.05 for name in (canvas.PAPER, colour))
    assert paper / text >= 4

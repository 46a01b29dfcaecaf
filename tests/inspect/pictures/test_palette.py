"""The colours are what their module says: apart for everyone."""

import itertools

import numpy as np
import pytest

from slatprep.inspect.pictures import canvas
from slatprep.inspect.pictures.scene import rgb
from slatprep.records import CLASS_COLOURS, MATERIAL_CLASSES

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


def lab(colour: str, seen_by: str) -> np.ndarray:
    value = rgb(colour)
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    xyz = TO_XYZ @ np.clip(np.array(SEEN_BY[seen_by]) @ linear, 0, 1) / [0.95047, 1, 1.08883]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_every_class_has_a_colour():
    assert set(CLASS_COLOURS) == set(MATERIAL_CLASSES)


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
    def luminance(name: str) -> float:
        value = rgb(name)
        linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
        return float(TO_XYZ[1] @ linear)

    # 4.5 is what WCAG 2 asks for text.
    assert (luminance(canvas.PAPER) + 0.05) / (luminance(colour) + 0.05) >= 4

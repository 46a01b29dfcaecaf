"""What is measured of a simulated object is what was done to it; and a drop, where Newton is."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from slatprep.errors import SlatprepError
from slatprep.particles.simulate import drop, rigid_deviation, strain

SPACING = 0.1
CUBE = np.argwhere(np.ones((4, 4, 4))) * SPACING
ONE_PART = np.zeros(len(CUBE), dtype=int)
STUFF = np.tile([1e5, 1e3, 0.3], (len(CUBE), 1))


@given(st.integers(0, 2**32 - 1))
def test_moving_and_turning_is_no_strain(seed: int) -> None:
    rng = np.random.default_rng(seed)
    moved = Rotation.random(rng=rng).apply(CUBE) + rng.normal(size=3)
    assert strain(CUBE, moved, ONE_PART, SPACING).max() < 1e-9
    assert rigid_deviation(CUBE, moved) < 1e-9


@pytest.mark.parametrize("stretch", [0.7, 1.2])
def test_stretch_has_its_green_strain(stretch: float) -> None:
    moved = Rotation.from_euler("xyz", [1, 2, 3]).apply(CUBE * [1.0, 1.0, stretch])
    np.testing.assert_allclose(
        strain(CUBE, moved, ONE_PART, SPACING), abs(stretch**2 - 1) / 2, rtol=1e-9
    )
    # Only z deviates, by (stretch - 1) z; the best turn of a stretched cube is none.
    height = CUBE[:, 2] - CUBE[:, 2].mean()
    expected = abs(stretch - 1) * np.sqrt((height**2).mean())
    np.testing.assert_allclose(rigid_deviation(CUBE, moved), expected, rtol=1e-9)


def test_shear_has_its_green_strain() -> None:
    gradient = np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    green = (gradient.T @ gradient - np.eye(3)) / 2
    expected = np.abs(np.linalg.eigvalsh(green)).max()
    np.testing.assert_allclose(strain(CUBE, CUBE @ gradient.T, ONE_PART, SPACING), expected)


def test_parts_are_measured_apart() -> None:
    part = (CUBE[:, 2] > 0.15).astype(int)
    moved = np.where(part[:, None] == 0, CUBE * [1.1, 1.1, 1.1], CUBE + np.array([0.0, 0.0, 0.5]))
    measured = strain(CUBE, moved, part, SPACING)
    np.testing.assert_allclose(measured[part == 0], 0.105, rtol=1e-9)
    np.testing.assert_allclose(measured[part == 1], 0.0, atol=1e-9)


def test_lone_particles_have_no_strain() -> None:
    line = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    assert np.isnan(strain(line, line, np.zeros(3, dtype=int), SPACING)).all()


@pytest.mark.parametrize(
    ("material", "change", "said"),
    [
        (4, None, r"material 4 \(fluid\) is not simulated"),
        (7, None, r"material 7 \(background\) is not simulated"),
        (0, (3, 1, 0.0), "particle 3 has E = 100000 Pa, density = 0"),
        (0, (5, 2, 0.5), "nu = 0.5; expected"),
        (0, (2, 0, np.nan), "particle 2 has E = nan"),
    ],
)
def test_particles_that_cannot_be_simulated_are_named(
    material: int, change: tuple[int, int, float] | None, said: str
) -> None:
    stuff = STUFF.copy()
    if change:
        stuff[change[0], change[1]] = change[2]
    with pytest.raises(SlatprepError, match=said):
        drop(CUBE, ONE_PART + material, stuff, SPACING)


def test_without_newton_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "newton", None)
    with pytest.raises(SlatprepError, match=r"pip install 'slatprep\[simulate\]'"):
        drop(CUBE, ONE_PART, STUFF, SPACING)


# Newton with warp-lang is 0.5 GB, and compiling its kernels for a CPU takes a minute of it.
@pytest.mark.skipif(
    importlib.util.find_spec("newton") is None, reason="needs the extra `simulate`, 0.5 GB"
)
def test_steel_on_jelly_falls_as_galileo_says_and_the_jelly_gives_way() -> None:
    tower = np.argwhere(np.ones((6, 6, 9))) * SPACING
    top = tower[:, 2] > 5.5 * SPACING
    stuff = np.where(top[:, None], [6e10, 7e3, 0.3], [6e4, 1e3, 0.4])
    frames = drop(tower, top.astype(int), stuff, SPACING, height=0.2, seconds=0.35)
    for frame in (6, 10):  # still falling: g t^2 / 2
        fallen = (frames[0] - frames[frame])[:, 2]
        np.testing.assert_allclose(fallen, 9.81 / 2 * (frame / 60) ** 2, rtol=0.15)
    last = [strain(frames[0], frame, top, SPACING) for frame in frames[12:]]
    soft, stiff = (max(np.nanmean(e[side]) for e in last) for side in (~top, top))
    assert soft > 0.1 and stiff < soft / 20
    assert rigid_deviation(frames[0][top], frames[-1][top]) < 0.05 * SPACING

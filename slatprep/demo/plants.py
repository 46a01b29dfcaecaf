"""Trees, flowers, shrubs, grass and fruit."""

from __future__ import annotations

import numpy as np

from slatprep.demo.materials import draw
from slatprep.demo.model import Model, Parts, Rng, around, curve, orient, pot, rock, vec, vessel
from slatprep.demo.shapes import box, capsule, carve, cone, dome, ellipsoid, sphere


def tree(rng: Rng, variant: int) -> Model:
    """Return a tree in a pot."""
    radius, height = rng.uniform(0.3, 0.4), rng.uniform(0.3, 0.42)
    parts = pot(rng, radius, height, draw(rng, "ceramic"), draw(rng, "soil"))
    bend = rng.normal(0.0, 0.06, (4, 2))
    spine = np.column_stack([np.cumsum(bend, axis=0), np.linspace(0.7 * height, 1.25, 4)])
    wood, leaf = draw(rng, "wood"), draw(rng, "leaf")
    parts.add(wood, *curve(spine, (0.085, 0.07, 0.055)))
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(rng.integers(4, 7)):
        angle = start + 2.4 * k + rng.normal(0.0, 0.2)
        root = spine[2] + (spine[3] - spine[2]) * rng.uniform(0.0, 0.9)
        tip = root + around(angle, rng.uniform(0.25, 0.5), rng.uniform(0.1, 0.35))
        size = rng.uniform(0.17, 0.27) * vec(1.15, 1.0, 0.75)
        parts.add(wood, capsule(root, tip, 0.035))
        parts.add(leaf, ellipsoid(tip, size, orient(angle)))
    parts.add(leaf, ellipsoid(spine[3] + vec(0, 0, 0.2), (0.3, 0.26, 0.24)))
    return Model("tree", parts)


def flowers(rng: Rng, variant: int) -> Model:
    """Return flowers in a vase with water."""
    belly, neck, height = rng.uniform(0.26, 0.33), rng.uniform(0.13, 0.17), rng.uniform(0.6, 0.75)
    wall = 0.045
    ceramic, stem, petal, core = (draw(rng, k) for k in ("ceramic", "stem", "petal", "flesh"))
    parts = Parts()
    parts.add(
        ceramic,
        vessel(0.0, 0.4 * height, 0.7 * belly, belly, wall, floor=1.5 * wall),
        vessel(0.4 * height, 0.8 * height, belly, neck, wall),
        vessel(0.8 * height, height, neck, 1.25 * neck, wall),
    )
    inner = 0.7 * belly - wall / 2, belly - wall / 2
    parts.add(draw(rng, "water"), cone((0, 0, wall), (0, 0, 0.4 * height), *inner))
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(rng.integers(3, 5)):
        angle = start + 2.1 * k + rng.normal(0.0, 0.2)
        lean = rng.uniform(0.15, 0.5)
        head = around(angle, lean, height + rng.uniform(0.35, 0.75))
        foot = around(angle + np.pi, 0.3 * neck, 0.3 * height)
        middle = around(angle, 0.35 * neck, height)
        axes = orient(angle, lean)
        leaf = axes @ orient(rng.uniform(0.0, 2.0 * np.pi), 0.9)
        leaf_at = 0.55 * middle + 0.45 * head + 0.1 * leaf[:, 2]
        parts.add(stem, *curve([foot, middle, head], (0.03, 0.03)))
        parts.add(core, sphere(head, 0.075))
        parts.add(stem, ellipsoid(leaf_at, (0.07, 0.03, 0.16), leaf))
        petals = int(rng.integers(5, 7))
        for j in range(petals):
            frame = axes @ orient(2.0 * np.pi * j / petals)
            centre = head + 0.14 * frame[:, 0] + 0.015 * frame[:, 2]
            parts.add(petal, ellipsoid(centre, (0.11, 0.07, 0.035), frame))
    return Model("flowers in a vase", parts)


def shrub(rng: Rng, variant: int) -> Model:
    """Return a shrub of several leaf clusters on a patch of soil."""
    wood, leaf, young, soil = (draw(rng, k) for k in ("wood", "leaf", "leaf", "soil"))
    parts = Parts()
    parts.add(soil, dome((0, 0, 0), (0.5, 0.42, 0.13)))
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(rng.integers(9, 13)):
        angle = start + 2.4 * k
        away = 0.14 + 0.045 * k * rng.uniform(0.8, 1.2)
        tip = around(angle, away, 0.85 - 0.045 * k + rng.normal(0.0, 0.05))
        size = rng.uniform(0.15, 0.24) * vec(1.1, 0.95, 0.8)
        parts.add(wood, capsule((0, 0, 0.05), tip, 0.035))
        parts.add(young if k % 3 == 0 else leaf, ellipsoid(tip, size, orient(angle, 0.4)))
    return Model("shrub", parts)


def grass(rng: Rng, variant: int) -> Model:
    """Return blades of grass on a sod, with a stone."""
    blade = draw(rng, "grass")
    half = vec(0.62, rng.uniform(0.4, 0.5), 0.1)
    parts = Parts()
    parts.add(draw(rng, "soil"), box((0, 0, 0), half, rounding=0.05))
    for _ in range(34):
        foot = vec(*rng.uniform(-0.85, 0.85, 2) * half[:2], 0.05)
        bow = around(rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.05, 0.22), 0.0)
        tall = rng.uniform(0.3, 0.75)
        middle, tip = foot + 0.3 * bow + vec(0, 0, 0.6 * tall), foot + bow + vec(0, 0, tall)
        parts.add(blade, *curve([foot, middle, tip], (0.026, 0.02)))
    spot = vec(*rng.uniform(-0.5, 0.5, 2) * half[:2], 0.15)
    stone = rock(rng, spot, (0.2, 0.15, 0.13))
    parts.add(draw(rng, "stone"), stone)
    return Model("grass", parts)


def fruit(rng: Rng, variant: int) -> Model:
    """Return, in turn, an apple, a bunch of bananas or a pear."""
    flesh, wood = draw(rng, "flesh"), draw(rng, "wood")
    parts = Parts()
    if variant % 3 == 1:
        parts.add(wood, sphere((0, 0, 0.04), 0.1))
        for k, angle in enumerate(vec(-0.35, 0.0, 0.4) + rng.normal(0.0, 0.06, 3)):
            bend = rng.uniform(0.95, 1.15)
            turn = np.linspace(0.0, 1.9, 7)
            along = np.column_stack([bend * np.sin(turn), 0 * turn, 0.55 * (1 - np.cos(turn))])
            along = along @ orient(angle).T
            fat = vec(0.07, 0.11, 0.13, 0.135, 0.12, 0.08) * (1.0 + 0.05 * k)
            parts.add(flesh, *curve(along, fat))
            parts.add(wood, sphere(along[-1], 0.06))
        return Model("bananas", parts)
    leaf = draw(rng, "leaf")
    if variant % 3 == 2:
        lean = rng.normal(0.0, 0.06, 2)
        parts.add(flesh, ellipsoid((0, 0, 0), (0.5, 0.48, 0.47)))
        balls = [sphere((*lean * k, 0.16 * k), 0.5 - 0.055 * k) for k in range(1, 5)]
        parts.add(flesh, *balls)
        top, name = vec(*lean * 4, 0.9), "pear"
    else:
        dip = sphere((0, 0, 0.62), 0.24)
        body = [carve(ellipsoid((0, 0, 0), (0.5, 0.5, 0.45)), dip)]
        for k, wide in enumerate(rng.uniform(0.9, 1.1, 4)):
            place = around(0.4 + 1.57 * k, 0.13, 0.06)
            body.append(ellipsoid(place, 0.4 * vec(wide, wide, 0.98)))
        parts.add(flesh, *(carve(shape, dip) for shape in body))
        top, name = vec(0, 0, 0.36), "apple"
    bent = top + around(rng.uniform(0.0, 2.0 * np.pi), 0.12, 0.3)
    stalk = [top - vec(0, 0, 0.1), 0.5 * (top + bent) + vec(0, 0, 0.05), bent]
    parts.add(wood, *curve(stalk, (0.04, 0.035)))
    frame = orient(rng.uniform(0.0, 2.0 * np.pi), -0.35)
    parts.add(leaf, ellipsoid(bent + 0.2 * frame[:, 0], (0.22, 0.11, 0.03), frame))
    return Model(name, parts)

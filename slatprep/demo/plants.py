"""Trees, flowers, shrubs, grass and fruit."""

from __future__ import annotations

import numpy as np

from slatprep.demo.materials import draw
from slatprep.demo.model import Model, Rng, around, curve, orient, pot, rock, vec, vessel
from slatprep.demo.shapes import (
    Part,
    box,
    capsule,
    carve,
    cone,
    dome,
    ellipsoid,
    sphere,
)


def tree(rng: Rng, variant: int) -> Model:
    """Return a tree in a pot."""
    radius, height = rng.uniform(0.3, 0.4), rng.uniform(0.3, 0.42)
    parts = pot(rng, radius, height, draw(rng, "ceramic"), draw(rng, "soil"))
    bend = rng.normal(0.0, 0.06, (4, 2))
    spine = np.column_stack([np.cumsum(bend, axis=0), np.linspace(0.7 * height, 1.25, 4)])
    wood, leaf = draw(rng, "wood"), draw(rng, "leaf")
    parts += curve(spine, [0.085, 0.07, 0.055], wood)
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(rng.integers(4, 7)):
        angle = start + 2.4 * k + rng.normal(0.0, 0.2)
        root = spine[2] + (spine[3] - spine[2]) * rng.uniform(0.0, 0.9)
        reach, rise = rng.uniform(0.25, 0.5), rng.uniform(0.1, 0.35)
        tip = root + around(angle, reach, rise)
        size = rng.uniform(0.17, 0.27) * vec(1.15, 1.0, 0.75)
        parts.append(Part(capsule(root, tip, 0.035), wood))
        parts.append(Part(ellipsoid(tip, size, orient(angle)), leaf))
    parts.append(Part(ellipsoid(spine[3] + vec(0, 0, 0.2), vec(0.3, 0.26, 0.24)), leaf))
    return Model("tree", tuple(parts))


def flowers(rng: Rng, variant: int) -> Model:
    """Return flowers in a vase with water."""
    belly, neck, height = rng.uniform(0.26, 0.33), rng.uniform(0.13, 0.17), rng.uniform(0.6, 0.75)
    wall = 0.045
    vase = [
        vessel(0.0, 0.4 * height, 0.7 * belly, belly, wall, floor=1.5 * wall),
        vessel(0.4 * height, 0.8 * height, belly, neck, wall),
        vessel(0.8 * height, height, neck, 1.25 * neck, wall),
    ]
    ceramic, stem, petal, core = (draw(rng, k) for k in ("ceramic", "stem", "petal", "flesh"))
    parts = [Part(shape, ceramic) for shape in vase]
    water = cone(vec(0, 0, wall), vec(0, 0, 0.4 * height), 0.7 * belly - wall / 2, belly - wall / 2)
    parts.append(Part(water, draw(rng, "water")))
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(rng.integers(3, 5)):
        angle = start + 2.1 * k + rng.normal(0.0, 0.2)
        lean = rng.uniform(0.15, 0.5)
        head = around(angle, lean, height + rng.uniform(0.35, 0.75))
        foot = around(angle + np.pi, 0.3 * neck, 0.3 * height)
        middle = around(angle, 0.35 * neck, height)
        parts += curve([foot, middle, head], [0.03, 0.03], stem)
        axes = orient(angle, lean)
        parts.append(Part(sphere(head, 0.075), core))
        leaf_at = 0.55 * middle + 0.45 * head
        leaf = axes @ orient(rng.uniform(0.0, 2.0 * np.pi), 0.9)
        parts.append(Part(ellipsoid(leaf_at + 0.1 * leaf[:, 2], vec(0.07, 0.03, 0.16), leaf), stem))
        petals = int(rng.integers(5, 7))
        for j in range(petals):
            frame = axes @ orient(2.0 * np.pi * j / petals)
            centre = head + 0.14 * frame[:, 0] + 0.015 * frame[:, 2]
            parts.append(Part(ellipsoid(centre, vec(0.11, 0.07, 0.035), frame), petal))
    return Model("flowers in a vase", tuple(parts))


def shrub(rng: Rng, variant: int) -> Model:
    """Return a shrub of several leaf clusters on a patch of soil."""
    wood, leaf, young = draw(rng, "wood"), draw(rng, "leaf"), draw(rng, "leaf")
    parts = [Part(dome(vec(0, 0, 0), vec(0.5, 0.42, 0.13)), draw(rng, "soil"))]
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(rng.integers(9, 13)):
        angle = start + 2.4 * k
        away = 0.14 + 0.045 * k * rng.uniform(0.8, 1.2)
        tip = around(angle, away, 0.85 - 0.045 * k + rng.normal(0.0, 0.05))
        parts.append(Part(capsule(vec(0, 0, 0.05), tip, 0.035), wood))
        size = rng.uniform(0.15, 0.24) * vec(1.1, 0.95, 0.8)
        parts.append(Part(ellipsoid(tip, size, orient(angle, 0.4)), young if k % 3 == 0 else leaf))
    return Model("shrub", tuple(parts))


def grass(rng: Rng, variant: int) -> Model:
    """Return blades of grass on a sod, with a stone."""
    blade = draw(rng, "grass")
    half = vec(0.62, rng.uniform(0.4, 0.5), 0.1)
    parts = [Part(box(vec(0, 0, 0), half, rounding=0.05), draw(rng, "soil"))]
    for _ in range(34):
        foot = vec(*rng.uniform(-0.85, 0.85, 2) * half[:2], 0.05)
        bow = around(rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.05, 0.22), 0.0)
        tall = rng.uniform(0.3, 0.75)
        middle = foot + 0.3 * bow + vec(0, 0, 0.6 * tall)
        parts += curve([foot, middle, foot + bow + vec(0, 0, tall)], [0.026, 0.02], blade)
    spot = vec(*rng.uniform(-0.5, 0.5, 2) * half[:2], 0.15)
    parts.append(Part(rock(rng, spot, vec(0.2, 0.15, 0.13)), draw(rng, "stone")))
    return Model("grass", tuple(parts))


def fruit(rng: Rng, variant: int) -> Model:
    """Return, in turn, an apple, a bunch of bananas or a pear."""
    flesh, wood = draw(rng, "flesh"), draw(rng, "wood")
    if variant % 3 == 1:
        parts = [Part(sphere(vec(0, 0, 0.04), 0.1), wood)]
        for k, angle in enumerate(vec(-0.35, 0.0, 0.4) + rng.normal(0.0, 0.06, 3)):
            bend = rng.uniform(0.95, 1.15)
            turn = np.linspace(0.0, 1.9, 7)
            along = np.column_stack([bend * np.sin(turn), 0 * turn, 0.55 * (1 - np.cos(turn))])
            fat = [0.07, 0.11, 0.13, 0.135, 0.12, 0.08]
            fat = [f * (1.0 + 0.05 * k) for f in fat]
            parts += curve(along @ orient(angle).T, fat, flesh)
            tip = (along @ orient(angle).T)[-1]
            parts.append(Part(sphere(tip, 0.06), wood))
        return Model("bananas", tuple(parts))
    leaf = draw(rng, "leaf")
    if variant % 3 == 2:
        lean = rng.normal(0.0, 0.06, 2)
        body = [ellipsoid(vec(0, 0, 0), vec(0.5, 0.48, 0.47))]
        body += [sphere(vec(*lean * k, 0.16 * k), 0.5 - 0.055 * k) for k in range(1, 5)]
        top, name = vec(*lean * 4, 0.9), "pear"
    else:
        dip = sphere(vec(0, 0, 0.62), 0.24)
        lobes = rng.uniform(0.9, 1.1, 4)
        body = [carve(ellipsoid(vec(0, 0, 0), vec(0.5, 0.5, 0.45)), dip)]
        body += [
            ellipsoid(around(0.4 + 1.57 * k, 0.13, 0.06), 0.4 * vec(lobes[k], lobes[k], 0.98))
            for k in range(4)
        ]
        body = [carve(shape, dip) for shape in body]
        top, name = vec(0, 0, 0.36), "apple"
    bent = top + around(rng.uniform(0.0, 2.0 * np.pi), 0.12, 0.3)
    parts = [Part(shape, flesh) for shape in body]
    parts += curve(
        [top - vec(0, 0, 0.1), 0.5 * (top + bent) + vec(0, 0, 0.05), bent], [0.04, 0.035], wood
    )
    frame = orient(rng.uniform(0.0, 2.0 * np.pi), -0.35)
    parts.append(Part(ellipsoid(bent + 0.2 * frame[:, 0], vec(0.22, 0.11, 0.03), frame), leaf))
    return Model(name, tuple(parts))

"""Build the demo's objects, with one function for each PixieVerse category.

Its `variant` counts the objects of the category, so that a dataset has each kind in turn.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise, product

import numpy as np

from slatprep.demo.model import (
    DemoObject,
    Rng,
    around,
    curve,
    direction,
    draw,
    made_of,
    orient,
    pot,
    rock,
    vec,
    vessel,
)
from slatprep.demo.shapes import (
    Part,
    box,
    capsule,
    carve,
    cone,
    cylinder,
    dome,
    ellipsoid,
    half_space,
    sphere,
    torus,
)

SIDES = (-1, 1)


def tree(rng: Rng, variant: int) -> DemoObject:
    """Return a tree in a pot."""
    radius, height = rng.uniform(0.3, 0.4), rng.uniform(0.3, 0.42)
    parts = pot(rng, radius, height, draw(rng, "ceramic"), draw(rng, "soil"))
    bend = rng.normal(0.0, 0.06, (4, 2))
    spine = np.column_stack([np.cumsum(bend, axis=0), np.linspace(0.7 * height, 1.25, 4)])
    wood, leaf = draw(rng, "wood"), draw(rng, "leaf")
    parts += made_of(wood, *curve(spine, (0.085, 0.07, 0.055)))
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(rng.integers(4, 7)):
        angle = start + 2.4 * k + rng.normal(0.0, 0.2)
        root = spine[2] + (spine[3] - spine[2]) * rng.uniform(0.0, 0.9)
        tip = root + around(angle, rng.uniform(0.25, 0.5), rng.uniform(0.1, 0.35))
        size = rng.uniform(0.17, 0.27) * vec(1.15, 1.0, 0.75)
        parts += made_of(wood, capsule(root, tip, 0.035))
        parts += made_of(leaf, ellipsoid(tip, size, orient(angle)))
    parts += made_of(leaf, ellipsoid(spine[3] + vec(0, 0, 0.2), (0.3, 0.26, 0.24)))
    return DemoObject("tree", parts)


def flowers(rng: Rng, variant: int) -> DemoObject:
    """Return flowers in a vase with water."""
    belly, neck, height = rng.uniform(0.26, 0.33), rng.uniform(0.13, 0.17), rng.uniform(0.6, 0.75)
    wall = 0.045
    ceramic, stem, petal, core = (draw(rng, k) for k in ("ceramic", "stem", "petal", "flesh"))
    parts = made_of(
        ceramic,
        vessel(0.0, 0.4 * height, 0.7 * belly, belly, wall, floor=1.5 * wall),
        vessel(0.4 * height, 0.8 * height, belly, neck, wall),
        vessel(0.8 * height, height, neck, 1.25 * neck, wall),
    )
    inner = 0.7 * belly - wall / 2, belly - wall / 2
    parts += made_of(draw(rng, "water"), cone((0, 0, wall), (0, 0, 0.4 * height), *inner))
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
        parts += made_of(stem, *curve([foot, middle, head], (0.03, 0.03)))
        parts += made_of(core, sphere(head, 0.075))
        parts += made_of(stem, ellipsoid(leaf_at, (0.07, 0.03, 0.16), leaf))
        petals = int(rng.integers(5, 7))
        for j in range(petals):
            frame = axes @ orient(2.0 * np.pi * j / petals)
            centre = head + 0.14 * frame[:, 0] + 0.015 * frame[:, 2]
            parts += made_of(petal, ellipsoid(centre, (0.11, 0.07, 0.035), frame))
    return DemoObject("flowers in a vase", parts)


def shrub(rng: Rng, variant: int) -> DemoObject:
    """Return a shrub of several leaf clusters on a patch of soil."""
    wood, leaf, young, soil = (draw(rng, k) for k in ("wood", "leaf", "leaf", "soil"))
    parts = made_of(soil, dome((0, 0, 0), (0.5, 0.42, 0.13)))
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(rng.integers(9, 13)):
        angle = start + 2.4 * k
        away = 0.14 + 0.045 * k * rng.uniform(0.8, 1.2)
        tip = around(angle, away, 0.85 - 0.045 * k + rng.normal(0.0, 0.05))
        size = rng.uniform(0.15, 0.24) * vec(1.1, 0.95, 0.8)
        parts += made_of(wood, capsule((0, 0, 0.05), tip, 0.035))
        parts += made_of(young if k % 3 == 0 else leaf, ellipsoid(tip, size, orient(angle, 0.4)))
    return DemoObject("shrub", parts)


def grass(rng: Rng, variant: int) -> DemoObject:
    """Return blades of grass on a sod, with a stone."""
    blade = draw(rng, "grass")
    half = vec(0.62, rng.uniform(0.4, 0.5), 0.1)
    parts = made_of(draw(rng, "soil"), box((0, 0, 0), half, rounding=0.05))
    for _ in range(34):
        foot = vec(*rng.uniform(-0.85, 0.85, 2) * half[:2], 0.05)
        bow = around(rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.05, 0.22), 0.0)
        tall = rng.uniform(0.3, 0.75)
        middle, tip = foot + 0.3 * bow + vec(0, 0, 0.6 * tall), foot + bow + vec(0, 0, tall)
        parts += made_of(blade, *curve([foot, middle, tip], (0.026, 0.02)))
    spot = vec(*rng.uniform(-0.5, 0.5, 2) * half[:2], 0.15)
    stone = rock(rng, spot, (0.2, 0.15, 0.13))
    parts += made_of(draw(rng, "stone"), stone)
    return DemoObject("grass", parts)


def fruit(rng: Rng, variant: int) -> DemoObject:
    """Return, in turn, an apple, a bunch of bananas or a pear."""
    flesh, wood = draw(rng, "flesh"), draw(rng, "wood")
    if variant % 3 == 1:
        parts = made_of(wood, sphere((0, 0, 0.04), 0.1))
        for k, angle in enumerate(vec(-0.35, 0.0, 0.4) + rng.normal(0.0, 0.06, 3)):
            bend = rng.uniform(0.95, 1.15)
            turn = np.linspace(0.0, 1.9, 7)
            along = np.column_stack([bend * np.sin(turn), 0 * turn, 0.55 * (1 - np.cos(turn))])
            along = along @ orient(angle).T
            fat = vec(0.07, 0.11, 0.13, 0.135, 0.12, 0.08) * (1.0 + 0.05 * k)
            parts += made_of(flesh, *curve(along, fat))
            parts += made_of(wood, sphere(along[-1], 0.06))
        return DemoObject("bananas", parts)
    leaf = draw(rng, "leaf")
    if variant % 3 == 2:
        lean = rng.normal(0.0, 0.06, 2)
        body = [sphere((*lean * k, 0.16 * k), 0.5 - 0.055 * k) for k in range(1, 5)]
        parts = made_of(flesh, ellipsoid((0, 0, 0), (0.5, 0.48, 0.47)), *body)
        top, name = vec(*lean * 4, 0.9), "pear"
    else:
        dip = sphere((0, 0, 0.62), 0.24)
        body = [ellipsoid((0, 0, 0), (0.5, 0.5, 0.45))]
        for k, wide in enumerate(rng.uniform(0.9, 1.1, 4)):
            place = around(0.4 + 1.57 * k, 0.13, 0.06)
            body.append(ellipsoid(place, 0.4 * vec(wide, wide, 0.98)))
        parts = made_of(flesh, *(carve(shape, dip) for shape in body))
        top, name = vec(0, 0, 0.36), "apple"
    bent = top + around(rng.uniform(0.0, 2.0 * np.pi), 0.12, 0.3)
    stalk = [top - vec(0, 0, 0.1), 0.5 * (top + bent) + vec(0, 0, 0.05), bent]
    parts += made_of(wood, *curve(stalk, (0.04, 0.035)))
    frame = orient(rng.uniform(0.0, 2.0 * np.pi), -0.35)
    parts += made_of(leaf, ellipsoid(bent + 0.2 * frame[:, 0], (0.22, 0.11, 0.03), frame))
    return DemoObject(name, parts)


def duck(rng: Rng, variant: int) -> DemoObject:
    """Return a rubber duck, looking along x."""
    body, beak, eye = draw(rng, "rubber"), draw(rng, "plastic"), draw(rng, "stone")
    long, wide, tall = rng.uniform(0.52, 0.6), rng.uniform(0.38, 0.44), rng.uniform(0.33, 0.38)
    head, at = rng.uniform(0.25, 0.3), vec(0.3 * long / 0.55, 0.0, tall + 0.24)
    look = orient(rng.normal(0.0, 0.2))  # turns the head a little to one side
    parts = made_of(
        body,
        ellipsoid((0, 0, 0), (long, wide, tall)),
        cone((-0.6 * long, 0, 0.1), (-1.2 * long, 0, tall + 0.12), 0.2, 0.04),
        cone((0.2, 0, 0.1), at, 0.3, 0.2),
        sphere(at, head),
    )
    for side in SIDES:
        shoulder, wing = (-0.12, side * 0.9 * wide, 0.06), orient(side * 0.15, 0.25)
        parts += made_of(body, ellipsoid(shoulder, (0.3, 0.09, 0.18), wing))
    for z, size in ((0.0, 0.055), (-0.07, 0.04)):
        bill = at + look @ vec(head + 0.07, 0, z - 0.02)
        parts += made_of(beak, ellipsoid(bill, (0.17, 0.15, size), look))
    for side in SIDES:
        parts += made_of(eye, sphere(at + head * look @ vec(0.8, side * 0.45, 0.38), 0.055))
    return DemoObject("rubber duck", parts)


def ball(rng: Rng, variant: int) -> DemoObject:
    """Return, in turn, a ball with a painted half, a plain ball or an oval ball with laces."""
    skin, paint = draw(rng, "rubber"), draw(rng, "plastic")
    if variant % 3 == 2:
        round_, long = rng.uniform(0.33, 0.38), rng.uniform(0.55, 0.62)
        lace, top = draw(rng, "foam"), round_ - 0.01
        parts = made_of(skin, ellipsoid((0, 0, 0), (long, round_, round_)))
        along = capsule((-0.22, 0, round_), (0.22, 0, round_), 0.045)
        across = [capsule((x, -0.09, top), (x, 0.09, top), 0.04) for x in (-0.16, 0, 0.16)]
        parts += made_of(lace, along, *across)
        # Half a turn about z leaves the ball unchanged.
        return DemoObject("oval ball", parts, symmetric=True)
    coats = ((half_space((0, 0, 0), direction(rng)), paint),) if variant % 3 == 0 else ()
    name = "half-painted ball" if coats else "plain ball"
    return DemoObject(name, [Part(sphere((0, 0, 0), 0.5), skin, coats)], symmetric=True)


def soda_can(rng: Rng, variant: int) -> DemoObject:
    """Return a can; every second can is dented and has an open tab."""
    metal, drink = draw(rng, "aluminium"), draw(rng, "water")
    r, h = rng.uniform(0.25, 0.3), rng.uniform(0.9, 1.05)
    walls = [
        cylinder((0, 0, 0.07), (0, 0, h - 0.1), r),
        cone((0, 0, 0), (0, 0, 0.07), 0.78 * r, r),
        cone((0, 0, h - 0.1), (0, 0, h), r, 0.8 * r),
    ]
    content = cylinder((0, 0, 0.1), (0, 0, h - 0.15), r - 0.06)
    dented = variant % 2 == 1
    if dented:
        middle = around(rng.uniform(0, 2.0 * np.pi), r + 0.16, rng.uniform(0.35, 0.6) * h)
        content = carve(content, sphere(middle, 0.27 + 0.06))
        walls = [carve(wall, sphere(middle, 0.27)) for wall in walls]
    # The drink is deep inside; only metal is on the surface.
    parts = [Part(wall, metal, ((content.distance, drink),)) for wall in walls]
    parts += made_of(metal, torus((0, 0, h), (0, 0, 1), 0.78 * r, 0.03))
    if dented:
        tab = orient(rng.uniform(0.0, 2.0 * np.pi), -0.6)
        lug = box(vec(0, 0, h + 0.04) + 0.06 * tab[:, 0], (0.12, 0.06, 0.025), tab, 0.02)
        parts += made_of(draw(rng, "aluminium"), lug)
    return DemoObject("dented can" if dented else "soda can", parts, symmetric=not dented)


def crate(rng: Rng, variant: int) -> DemoObject:
    """Return a crate with ribs; every second crate has a latch and a raised lid."""
    frame, panel = draw(rng, "steel"), draw(rng, "aluminium")
    half = vec(0.5, rng.uniform(0.34, 0.42), rng.uniform(0.24, 0.31))
    parts = made_of(panel, box((0, 0, 0), half - 0.04))
    for axis, *sides in product(range(3), SIDES, SIDES):
        centre, size = np.insert(sides, axis, 0) * (half - 0.05), np.full(3, 0.05)
        size[axis] = half[axis]
        parts += made_of(frame, box(centre, size, rounding=0.015))
    for side in SIDES:
        parts += made_of(frame, box((0, side * (half[1] - 0.03), 0), (0.05, 0.03, half[2])))
    if variant % 2 == 0:
        return DemoObject("metal crate", parts, symmetric=True)
    lid = orient(0.0, -0.12)
    parts += made_of(panel, box((-0.04, 0, half[2] + 0.09), (0.52, half[1], 0.035), lid))
    latch = vec(half[0] + 0.03, rng.uniform(-0.6, 0.6) * half[1], 0.3 * half[2])
    parts += made_of(draw(rng, "steel"), box(latch, (0.05, 0.07, 0.09), rounding=0.02))
    return DemoObject("crate with a lid", parts)


def sand(rng: Rng, variant: int) -> DemoObject:
    """Return, in turn, a sand castle or a bucket of sand with a shovel."""
    dry, plastic = draw(rng, "sand"), draw(rng, "plastic")
    if variant % 2 == 1:
        parts = pot(rng, rng.uniform(0.42, 0.48), rng.uniform(0.6, 0.7), plastic, draw(rng, "sand"))
        top = vec(0, 0, 0.48)
        parts += made_of(dry, dome((0.03, 0, 0.48), (0.36, 0.33, 0.2)))
        lean = orient(rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.3, 0.5))
        grip, across = top + 0.75 * lean[:, 2], 0.14 * lean[:, 0]
        parts += made_of(draw(rng, "wood"), capsule(top, grip, 0.045))
        parts += made_of(plastic, capsule(grip - across, grip + across, 0.045))
        return DemoObject("bucket of sand", parts)
    wet = draw(rng, "sand")
    parts = made_of(dry, dome((0, 0, 0), (0.75, rng.uniform(0.5, 0.65), 0.22)))
    places = vec(-0.32, -0.1, 0), vec(0.05, 0.22, 0), vec(0.34, -0.08, 0)
    for k, place in enumerate(places):
        foot = place + vec(*rng.normal(0.0, 0.03, 2), 0)
        r, h = rng.uniform(0.13, 0.18), 0.36 + 0.13 * k + rng.uniform(0.0, 0.06)
        top = foot + vec(0, 0, h)
        parts += made_of(wet, cone(foot, top, 1.2 * r, r))
        if k < 2:
            parts += made_of(wet, cone(top, top + vec(0, 0, 0.26), 1.2 * r, 0.02))
        else:
            parts += made_of(draw(rng, "wood"), capsule(top, top + vec(0, 0, 0.36), 0.025))
            parts += made_of(draw(rng, "petal"), box(top + vec(0.11, 0, 0.3), (0.11, 0.022, 0.08)))
    for a, b in pairwise(places):
        turn = orient(float(np.arctan2(b[1] - a[1], b[0] - a[0])))
        parts += made_of(wet, box(0.5 * (a + b) + vec(0, 0, 0.15), (0.24, 0.06, 0.16), turn))
    return DemoObject("sand castle", parts)


def snowman(rng: Rng, variant: int) -> DemoObject:
    """Return a snowman with stick arms, a carrot and a hat, on a patch of mud."""
    snow, stick, hat = draw(rng, "snow"), draw(rng, "wood"), draw(rng, "foam")
    r = vec(0.36, 0.27, 0.19) * rng.uniform(0.92, 1.08, 3)
    z = vec(0.85 * r[0], 1.55 * r[0] + 0.75 * r[1], 1.55 * r[0] + 1.5 * r[1] + 0.75 * r[2])
    lean = rng.normal(0.0, 0.02, (3, 2))
    balls = np.column_stack([lean, z + 0.06])
    parts = made_of(draw(rng, "mud"), dome((0, 0, 0), (0.52, 0.44, 0.11)))
    parts += made_of(snow, *map(sphere, balls, r))
    for side in SIDES:
        rise = rng.uniform(0.05, 0.3)
        shoulder = balls[1] + vec(0, side * 0.8 * r[1], 0.05)
        elbow = shoulder + vec(0.03, side * 0.22, rise)
        hand = elbow + vec(0.05, side * 0.16, rng.uniform(-0.02, 0.15))
        twig = elbow + vec(-0.05, side * 0.14, rng.uniform(0.1, 0.2))
        parts += made_of(stick, *curve([shoulder, elbow, hand], (0.028, 0.024)))
        parts += made_of(stick, capsule(elbow, twig, 0.022))
    look = orient(rng.normal(0.0, 0.25))
    nose = balls[2] + look @ vec(0.9 * r[2], 0, 0)
    parts += made_of(draw(rng, "flesh"), cone(nose, nose + 0.24 * look[:, 0], 0.06, 0.015))
    top = balls[2] + vec(0, 0, 0.75 * r[2])
    for height, width in ((0.05, 1.15), (0.24, 0.75)):
        parts += made_of(hat, cylinder(top, top + vec(0, 0, height), width * r[2]))
    coal = draw(rng, "stone")
    for height in (-0.08, 0.08):
        where = balls[1] + vec(np.sqrt(r[1] ** 2 - height**2), 0, height)
        parts += made_of(coal, sphere(where, 0.04))
    return DemoObject("snowman", parts)


def jello(rng: Rng, variant: int) -> DemoObject:
    """Return a jello block on a plate; every second block has a cherry and a spoon."""
    flesh, plate = draw(rng, "jello"), draw(rng, "ceramic")
    side, height = rng.uniform(0.27, 0.33), rng.uniform(0.16, 0.22)
    parts = made_of(plate, vessel(0.0, 0.12, 0.4, 0.62, 0.06, floor=0.06))
    parts += made_of(flesh, box((0, 0, 0.04 + height), (side, side, height), rounding=0.06))
    if variant % 2 == 1:
        return DemoObject("jello block", parts, symmetric=True)
    cherry = vec(0.4 * side, -0.3 * side, 0.1 + 2 * height)
    parts += made_of(draw(rng, "flesh"), sphere(cherry, 0.1))
    twig = cherry + around(rng.uniform(0.0, 2.0 * np.pi), 0.1, 0.24)
    parts += made_of(draw(rng, "stem"), capsule(cherry, twig, 0.024))
    bowl, grip = vec(0.1, side + 0.13, 0.13), vec(0.7, side + 0.2, 0.2)
    spoon = ellipsoid(bowl, (0.14, 0.085, 0.035)), capsule(bowl + vec(0.08, 0, 0), grip, 0.026)
    parts += made_of(draw(rng, "steel"), *spoon)
    return DemoObject("jello with a cherry", parts)


def rocks(rng: Rng, variant: int) -> DemoObject:
    """Return a heap of stones, one of them mossy."""
    stone, moss = draw(rng, "stone"), draw(rng, "leaf")
    parts = made_of(draw(rng, "sand"), dome((0, 0, 0), (0.68, 0.52, 0.1)))
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(4):
        size = rng.uniform(0.75, 1.0) * vec(0.33, 0.27, 0.24) * (1.0 - 0.12 * k)
        place = around(start + 2.1 * k, 0.32 if k < 3 else 0.08, 0.18 if k < 3 else 0.44)
        coats = ((half_space(place, (0.2, 0.1, 1.0)), moss),) if k == 3 else ()
        parts.append(Part(rock(rng, place, size), draw(rng, "stone") if k else stone, coats))
    return DemoObject("rocks", parts)


def water(rng: Rng, variant: int) -> DemoObject:
    """Return a glass of water; every second glass has a straw and a lemon."""
    glass, wet = draw(rng, "glass"), draw(rng, "water")
    foot, rim, h = rng.uniform(0.22, 0.27), rng.uniform(0.3, 0.36), rng.uniform(0.8, 0.95)
    wall = 0.045
    level = rng.uniform(0.6, 0.75) * h
    radius = foot + (rim - foot) * level / h - 0.5 * wall
    parts = made_of(glass, vessel(0.0, h, foot, rim, wall, floor=1.6 * wall))
    parts += made_of(wet, cone((0, 0, wall), (0, 0, level), foot - 0.5 * wall, radius))
    if variant % 2 == 1:
        return DemoObject("glass of water", parts, symmetric=True)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    straw = around(angle, rim * 0.75, h + 0.05)
    bent = [around(angle + 3.14, 0.08, 0.12), straw, straw + around(angle, 0.22, 0.14)]
    parts += made_of(draw(rng, "plastic"), *curve(bent, (0.035, 0.035)))
    side, thickness = around(angle + 1.7, rim, h), 0.03 * orient(angle + 1.7)[:, 1]
    parts += made_of(draw(rng, "flesh"), cylinder(side - thickness, side + thickness, 0.15))
    return DemoObject("glass with a straw", parts)


CATALOGUE: dict[str, Callable[[Rng, int], DemoObject]] = {
    "tree": tree,
    "flowers": flowers,
    "shrubs": shrub,
    "grass": grass,
    "fruit": fruit,
    "rubber_ducks_and_toys": duck,
    "sport_balls": ball,
    "soda_cans": soda_can,
    "metal_crates": crate,
    "sand": sand,
    "snow_and_mud": snowman,
    "jello_block": jello,
    "rocks": rocks,
    "water-like_bodies": water,
}
"""Function that builds the demo's objects, for each of PixieVerse's categories."""

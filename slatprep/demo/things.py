"""Toys, balls, cans, crates, sand, snow, jello, rocks and water."""

from __future__ import annotations

import numpy as np

from slatprep.demo.materials import draw
from slatprep.demo.model import Model, Rng, around, curve, direction, orient, pot, rock, vec, vessel
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


def duck(rng: Rng, variant: int) -> Model:
    """Return a rubber duck, looking along x."""
    body, beak, eye = draw(rng, "rubber"), draw(rng, "plastic"), draw(rng, "stone")
    long, wide, tall = rng.uniform(0.52, 0.6), rng.uniform(0.38, 0.44), rng.uniform(0.33, 0.38)
    head, at = rng.uniform(0.25, 0.3), vec(0.3 * long / 0.55, 0.0, tall + 0.24)
    look = orient(rng.normal(0.0, 0.2))  # the head turned a little to one side
    belly = ellipsoid(vec(0, 0, 0), vec(long, wide, tall))
    tail = cone(vec(-0.6 * long, 0, 0.1), vec(-1.2 * long, 0, tall + 0.12), 0.2, 0.04)
    parts = [
        Part(belly, body),
        Part(tail, body),
        Part(cone(vec(0.2, 0, 0.1), at, 0.3, 0.2), body),
        Part(sphere(at, head), body),
    ]
    parts += [
        Part(
            ellipsoid(
                vec(-0.12, side * 0.9 * wide, 0.06),
                vec(0.3, 0.09, 0.18),
                orient(side * 0.15, 0.25),
            ),
            body,
        )
        for side in (-1, 1)
    ]
    for z, size in ((0.0, 0.055), (-0.07, 0.04)):
        bill = at + look @ vec(head + 0.07, 0, z - 0.02)
        parts.append(Part(ellipsoid(bill, vec(0.17, 0.15, size), look), beak))
    for side in (-1, 1):
        spot = at + head * look @ vec(0.8, side * 0.45, 0.38)
        parts.append(Part(sphere(spot, 0.055), eye))
    return Model("rubber duck", tuple(parts))


def ball(rng: Rng, variant: int) -> Model:
    """Return, in turn, a ball with a painted half, a plain one, an oval one with laces."""
    skin, paint = draw(rng, "rubber"), draw(rng, "plastic")
    if variant % 3 == 2:
        round_, long = rng.uniform(0.33, 0.38), rng.uniform(0.55, 0.62)
        lace = draw(rng, "foam")
        parts = [Part(ellipsoid(vec(0, 0, 0), vec(long, round_, round_)), skin)]
        parts.append(Part(capsule(vec(-0.22, 0, round_), vec(0.22, 0, round_), 0.045), lace))
        parts += [
            Part(capsule(vec(x, -0.09, round_ - 0.01), vec(x, 0.09, round_ - 0.01), 0.04), lace)
            for x in (-0.16, 0.0, 0.16)
        ]
        # Turned half round about z it is the same.
        return Model("oval ball", tuple(parts), symmetric=True)
    coats = ((half_space(vec(0, 0, 0), direction(rng)), paint),) if variant % 3 == 0 else ()
    name = "half-painted ball" if coats else "plain ball"
    return Model(name, (Part(sphere(vec(0, 0, 0), 0.5), skin, coats),), symmetric=True)


def soda_can(rng: Rng, variant: int) -> Model:
    """Return a can, every second one dented and with an open tab."""
    metal, drink = draw(rng, "aluminium"), draw(rng, "water")
    r, h = rng.uniform(0.25, 0.3), rng.uniform(0.9, 1.05)
    body = cylinder(vec(0, 0, 0.07), vec(0, 0, h - 0.1), r)
    foot = cone(vec(0, 0, 0), vec(0, 0, 0.07), 0.78 * r, r)
    neck = cone(vec(0, 0, h - 0.1), vec(0, 0, h), r, 0.8 * r)
    rim = torus(vec(0, 0, h), vec(0, 0, 1), 0.78 * r, 0.03)
    content = cylinder(vec(0, 0, 0.1), vec(0, 0, h - 0.15), r - 0.06)
    # The content lies deep inside; the surface meets the metal alone.
    walls = (body, foot, neck)
    if variant % 2 == 0:
        parts = [Part(wall, metal, ((content.distance, drink),)) for wall in walls]
        parts.append(Part(rim, metal))
        return Model("soda can", tuple(parts), symmetric=True)
    middle = around(rng.uniform(0, 2.0 * np.pi), r + 0.16, rng.uniform(0.35, 0.6) * h)
    content = carve(content, sphere(middle, 0.27 + 0.06))
    dented = [carve(wall, sphere(middle, 0.27)) for wall in walls]
    parts = [Part(wall, metal, ((content.distance, drink),)) for wall in dented]
    parts.append(Part(rim, metal))
    tab = orient(rng.uniform(0.0, 2.0 * np.pi), -0.6)
    lug = box(vec(0, 0, h + 0.04) + 0.06 * tab[:, 0], vec(0.12, 0.06, 0.025), tab, 0.02)
    parts.append(Part(lug, draw(rng, "aluminium")))
    return Model("dented can", tuple(parts))


def crate(rng: Rng, variant: int) -> Model:
    """Return a crate with ribs, every second one with a latch and a raised lid."""
    frame, panel = draw(rng, "steel"), draw(rng, "aluminium")
    half = vec(0.5, rng.uniform(0.34, 0.42), rng.uniform(0.24, 0.31))
    parts = [Part(box(vec(0, 0, 0), half - 0.04), panel)]
    corners = [(sy, sz) for sy in (-1, 1) for sz in (-1, 1)]
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for sides in corners:
            centre, size = np.zeros(3), np.full(3, 0.05)
            centre[others] = np.array(sides) * (half[others] - 0.05)
            size[axis] = half[axis]
            parts.append(Part(box(centre, size, rounding=0.015), frame))
    for side in (-1, 1):
        brace = vec(0, side * (half[1] - 0.03), 0)
        parts.append(Part(box(brace, vec(0.05, 0.03, half[2])), frame))
    if variant % 2 == 0:
        return Model("metal crate", tuple(parts), symmetric=True)
    lid = orient(0.0, -0.12)
    parts.append(Part(box(vec(-0.04, 0, half[2] + 0.09), vec(0.52, half[1], 0.035), lid), panel))
    latch = vec(half[0] + 0.03, rng.uniform(-0.6, 0.6) * half[1], 0.3 * half[2])
    parts.append(Part(box(latch, vec(0.05, 0.07, 0.09), rounding=0.02), draw(rng, "steel")))
    return Model("crate with a lid", tuple(parts))


def sand(rng: Rng, variant: int) -> Model:
    """Return, in turn, a sand castle or a bucket of sand with a shovel."""
    dry, plastic = draw(rng, "sand"), draw(rng, "plastic")
    if variant % 2 == 1:
        parts = pot(rng, rng.uniform(0.42, 0.48), rng.uniform(0.6, 0.7), plastic, draw(rng, "sand"))
        top = 0.48
        parts.append(Part(dome(vec(0.03, 0, top), vec(0.36, 0.33, 0.2)), dry))
        lean = orient(rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.3, 0.5))
        grip = vec(0, 0, top) + 0.75 * lean[:, 2]
        parts.append(Part(capsule(vec(0, 0, top), grip, 0.045), draw(rng, "wood")))
        parts.append(
            Part(capsule(grip - 0.14 * lean[:, 0], grip + 0.14 * lean[:, 0], 0.045), plastic)
        )
        return Model("bucket of sand", tuple(parts))
    wet = draw(rng, "sand")
    parts = [Part(dome(vec(0, 0, 0), vec(0.75, rng.uniform(0.5, 0.65), 0.22)), dry)]
    places = [vec(-0.32, -0.1, 0), vec(0.05, 0.22, 0), vec(0.34, -0.08, 0)]
    for k, place in enumerate(places):
        place = place + vec(*rng.normal(0.0, 0.03, 2), 0)
        r, h = rng.uniform(0.13, 0.18), 0.36 + 0.13 * k + rng.uniform(0.0, 0.06)
        parts.append(Part(cone(place, place + vec(0, 0, h), 1.2 * r, r), wet))
        if k < 2:
            spire = place + vec(0, 0, h)
            parts.append(Part(cone(spire, spire + vec(0, 0, 0.26), 1.2 * r, 0.02), wet))
        else:
            mast = place + vec(0, 0, h)
            parts.append(Part(capsule(mast, mast + vec(0, 0, 0.36), 0.025), draw(rng, "wood")))
            flag = mast + vec(0.11, 0, 0.3)
            parts.append(Part(box(flag, vec(0.11, 0.022, 0.08)), draw(rng, "petal")))
    for a, b in ((0, 1), (1, 2)):
        middle, along = 0.5 * (places[a] + places[b]), places[b] - places[a]
        turn = orient(float(np.arctan2(along[1], along[0])))
        parts.append(Part(box(middle + vec(0, 0, 0.15), vec(0.24, 0.06, 0.16), turn), wet))
    return Model("sand castle", tuple(parts))


def snowman(rng: Rng, variant: int) -> Model:
    """Return a snowman with stick arms, a carrot and a hat, on a patch of mud."""
    snow, stick, hat = draw(rng, "snow"), draw(rng, "wood"), draw(rng, "foam")
    r = vec(0.36, 0.27, 0.19) * rng.uniform(0.92, 1.08, 3)
    z = vec(0.85 * r[0], 1.55 * r[0] + 0.75 * r[1], 1.55 * r[0] + 1.5 * r[1] + 0.75 * r[2])
    lean = rng.normal(0.0, 0.02, (3, 2))
    balls = np.column_stack([lean, z + 0.06])
    parts = [Part(dome(vec(0, 0, 0), vec(0.52, 0.44, 0.11)), draw(rng, "mud"))]
    parts += [Part(sphere(c, k), snow) for c, k in zip(balls, r, strict=True)]
    for side in (-1, 1):
        rise = rng.uniform(0.05, 0.3)
        shoulder = balls[1] + vec(0, side * 0.8 * r[1], 0.05)
        elbow = shoulder + vec(0.03, side * 0.22, rise)
        hand = elbow + vec(0.05, side * 0.16, rng.uniform(-0.02, 0.15))
        twig = elbow + vec(-0.05, side * 0.14, rng.uniform(0.1, 0.2))
        parts += curve([shoulder, elbow, hand], [0.028, 0.024], stick)
        parts.append(Part(capsule(elbow, twig, 0.022), stick))
    look = orient(rng.normal(0.0, 0.25))
    nose = balls[2] + look @ vec(0.9 * r[2], 0, 0)
    parts.append(Part(cone(nose, nose + 0.24 * look[:, 0], 0.06, 0.015), draw(rng, "flesh")))
    top = balls[2] + vec(0, 0, 0.75 * r[2])
    parts.append(Part(cylinder(top, top + vec(0, 0, 0.05), 1.15 * r[2]), hat))
    parts.append(Part(cylinder(top, top + vec(0, 0, 0.24), 0.75 * r[2]), hat))
    coal = draw(rng, "stone")
    for height in (-0.08, 0.08):
        where = balls[1] + vec(np.sqrt(r[1] ** 2 - height**2), 0, height)
        parts.append(Part(sphere(where, 0.04), coal))
    return Model("snowman", tuple(parts))


def jello(rng: Rng, variant: int) -> Model:
    """Return a jello block on a plate, in turn with cherry and spoon or without."""
    flesh, plate = draw(rng, "jello"), draw(rng, "ceramic")
    side = rng.uniform(0.27, 0.33)
    height = rng.uniform(0.16, 0.22)
    dish = vessel(0.0, 0.12, 0.4, 0.62, 0.06, floor=0.06)
    block = box(vec(0, 0, 0.04 + height), vec(side, side, height), rounding=0.06)
    parts = [Part(dish, plate), Part(block, flesh)]
    if variant % 2 == 1:
        return Model("jello block", tuple(parts), symmetric=True)
    cherry = vec(0.4 * side, -0.3 * side, 0.1 + 2 * height)
    parts.append(Part(sphere(cherry, 0.1), draw(rng, "flesh")))
    twig = cherry + around(rng.uniform(0.0, 2.0 * np.pi), 0.1, 0.24)
    parts.append(Part(capsule(cherry, twig, 0.024), draw(rng, "stem")))
    steel = draw(rng, "steel")
    bowl, grip = vec(0.1, side + 0.13, 0.13), vec(0.7, side + 0.2, 0.2)
    parts.append(Part(ellipsoid(bowl, vec(0.14, 0.085, 0.035)), steel))
    parts.append(Part(capsule(bowl + vec(0.08, 0, 0), grip, 0.026), steel))
    return Model("jello with a cherry", tuple(parts))


def rocks(rng: Rng, variant: int) -> Model:
    """Return a heap of stones, one of them mossy."""
    stone, moss = draw(rng, "stone"), draw(rng, "leaf")
    parts = [Part(dome(vec(0, 0, 0), vec(0.68, 0.52, 0.1)), draw(rng, "sand"))]
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(4):
        size = rng.uniform(0.75, 1.0) * vec(0.33, 0.27, 0.24) * (1.0 - 0.12 * k)
        place = around(start + 2.1 * k, 0.32 if k < 3 else 0.08, 0.18 if k < 3 else 0.44)
        coats = ((half_space(place, vec(0.2, 0.1, 1.0)), moss),) if k == 3 else ()
        parts.append(Part(rock(rng, place, size), draw(rng, "stone") if k else stone, coats))
    return Model("rocks", tuple(parts))


def water(rng: Rng, variant: int) -> Model:
    """Return a glass of water, in turn with straw and lemon or without."""
    glass, wet = draw(rng, "glass"), draw(rng, "water")
    foot, rim, h = rng.uniform(0.22, 0.27), rng.uniform(0.3, 0.36), rng.uniform(0.8, 0.95)
    wall = 0.045
    level = rng.uniform(0.6, 0.75) * h
    radius = foot + (rim - foot) * level / h - 0.5 * wall
    body = cone(vec(0, 0, wall), vec(0, 0, level), foot - 0.5 * wall, radius)
    parts = [Part(vessel(0.0, h, foot, rim, wall, floor=1.6 * wall), glass), Part(body, wet)]
    if variant % 2 == 1:
        return Model("glass of water", tuple(parts), symmetric=True)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    straw = around(angle, rim * 0.75, h + 0.05)
    bent = straw + around(angle, 0.22, 0.14)
    parts += curve(
        [around(angle + 3.14, 0.08, 0.12), straw, bent], [0.035, 0.035], draw(rng, "plastic")
    )
    side = around(angle + 1.7, rim, h)
    lemon = cylinder(
        side - 0.03 * orient(angle + 1.7)[:, 1], side + 0.03 * orient(angle + 1.7)[:, 1], 0.15
    )
    parts.append(Part(lemon, draw(rng, "flesh")))
    return Model("glass with a straw", tuple(parts))

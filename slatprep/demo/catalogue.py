"""The demo's objects: one builder for each PixieVerse category.

A builder's `variant` counts the objects of its category, so that a dataset has each kind in turn.
"""

from __future__ import annotations

from collections.abc import Callable

from slatprep.demo import plants, things
from slatprep.demo.model import Model, Rng

Builder = Callable[[Rng, int], Model]

CATALOGUE: dict[str, Builder] = {
    "tree": plants.tree,
    "flowers": plants.flowers,
    "shrubs": plants.shrub,
    "grass": plants.grass,
    "fruit": plants.fruit,
    "rubber_ducks_and_toys": things.duck,
    "sport_balls": things.ball,
    "soda_cans": things.soda_can,
    "metal_crates": things.crate,
    "sand": things.sand,
    "snow_and_mud": things.snowman,
    "jello_block": things.jello,
    "rocks": things.rocks,
    "water-like_bodies": things.water,
}
"""The builder of the demo's objects for each of PixieVerse's categories."""

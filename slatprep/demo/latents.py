"""Make synthetic latents of a SLAT in the space of an encoder.

Latents of a space without moments have TRELLIS's, repeated every eight channels. See
`slatprep.records.encoders`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.records import FEATS_MEAN, FEATS_STD, TRELLIS, LatentSpace
from slatprep.records.encoders import LATENTS

LatentKind = Literal["placeholder", "material"]

Encoder = Literal["trellis", "sam3d", "trellis2", "trellis2-512", "plain", "plain-128"]

SPACES = {name: LATENTS[name] for name in ("trellis", "sam3d", "trellis2", "trellis2-512")}
"""The space of each encoder's latents; ``plain`` and ``plain-128`` stand for any other encoder."""

for _name, _side in (("plain", 64), ("plain-128", 128)):
    SPACES[_name] = LatentSpace(_name, 16, _side)

NOISE = 0.5
"""Standard deviation of the noise in latents that depend on the material."""

_CODES: NDArray[np.float64] = np.linalg.qr(np.random.default_rng(20250101).normal(size=(8, 8)))[0]
_PROPERTY_CENTRE = np.array([7.0, 2.8, 0.33])
_PROPERTY_SPREAD = np.array([4.0, 1.1, 0.12])


def make_latents(
    rng: np.random.Generator,
    kind: LatentKind,
    centres: NDArray[np.float64],
    material: NDArray[np.uint8],
    properties: NDArray[np.float32],
    space: LatentSpace = TRELLIS,
) -> NDArray[np.float32]:
    """Return latents (N, channels) float32 for SLAT voxels with centres (N, 3) in the unit cube.

    ``placeholder`` latents are normal noise. ``material`` latents are `NOISE` times this noise,
    plus `clean_latents` in the first eight channels. Both are then scaled to the encoder's mean and
    standard deviation. `properties` (N, 3) are Young's modulus, density, Poisson's ratio, SI.
    """
    z = rng.normal(size=(len(centres), space.channels))
    if kind == "material":
        z *= NOISE
        z[:, :8] += clean_latents(centres, material, properties)
    moments = (space.mean, space.std) if space.mean else (FEATS_MEAN, FEATS_STD)
    mean, std = (np.resize(one, space.channels) for one in moments)
    return np.asarray((mean + std * z).astype(np.float32))


def clean_latents(
    centres: NDArray[np.float64], material: NDArray[np.uint8], properties: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return ``material`` latents without noise, standardised (N, 8).

    They are ``2 * code[material] + p @ code[:3] + sin(pi * x) @ code[3:6] / 2``. Here ``code`` are
    eight fixed orthonormal vectors, ``p`` the three properties (log10 Young's modulus, log10
    density, Poisson's ratio) mapped to about -1..1, and ``x`` the voxel's centre. They are linear
    in the targets, so a linear model of single voxels has the right form. Neighbouring voxels do
    not help, because the noise of each voxel is independent.
    """
    mapped = properties.astype(np.float64)
    mapped[:, :2] = np.log10(mapped[:, :2])
    mapped = (mapped - _PROPERTY_CENTRE) / _PROPERTY_SPREAD
    place = np.sin(np.pi * centres)
    return np.asarray(2.0 * _CODES[material] + mapped @ _CODES[:3] + 0.5 * place @ _CODES[3:6])

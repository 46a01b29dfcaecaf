"""Make synthetic latents of a SLAT, with an encoder's number of channels.

Latents with 32 channels have the mean and standard deviation of TRELLIS.2's shape latents;
others have TRELLIS's, repeated every eight channels. See `slatprep.records.encoders`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.records import FEATS_MEAN, FEATS_STD
from slatprep.records.encoders import SHAPE_MEAN, SHAPE_STD

LatentKind = Literal["placeholder", "material"]

Encoder = Literal["trellis", "sam3d", "trellis2", "trellis2-512", "plain", "plain-128"]

GRIDS: dict[Encoder, tuple[int, int]] = {
    "trellis": (8, 64),
    "sam3d": (8, 64),
    "trellis2": (32, 64),
    "trellis2-512": (32, 32),
    "plain": (16, 64),
    "plain-128": (16, 128),
}
"""Number of channels of each encoder's latents, and of voxels along each axis.

``plain`` and ``plain-128`` stand for any other encoder.
"""

MEAN, STD = np.array(FEATS_MEAN), np.array(FEATS_STD)

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
    channels: int = 8,
) -> NDArray[np.float32]:
    """Return latents (N, channels) float32 for SLAT voxels with centres (N, 3) in the unit cube.

    ``placeholder`` latents are normal noise. ``material`` latents are `NOISE` times this noise,
    plus `clean_latents` in the first eight channels. Both are then scaled to the encoder's mean and
    standard deviation. `properties` (N, 3) are Young's modulus, density, Poisson's ratio, SI.
    """
    z = rng.normal(size=(len(centres), channels))
    if kind == "material":
        z *= NOISE
        z[:, :8] += clean_latents(centres, material, properties)
    mean, std = np.resize(MEAN, channels), np.resize(STD, channels)
    if channels == len(SHAPE_MEAN):
        mean, std = np.array(SHAPE_MEAN), np.array(SHAPE_STD)
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

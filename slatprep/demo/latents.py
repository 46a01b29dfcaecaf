"""Stand-ins for the eight latent channels of a SLAT.

Mean and standard deviation of each channel are those that TRELLIS publishes
for ``slat_flow_img_dit_L_64l8p2_fp16``.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry import voxel_centres

LatentKind = Literal["placeholder", "material"]

MEAN = np.array([-2.1688, -0.0043, -0.1335, -0.0842, -0.5271, 0.7239, -1.1414, 1.2039])
STD = np.array([2.3777, 2.3864, 2.1244, 2.1749, 2.6639, 2.3712, 2.6217, 2.6845])

NOISE = 0.5
"""Share of noise (as a standard deviation) in latents that follow the material."""

_CODES: NDArray[np.float64] = np.linalg.qr(np.random.default_rng(20250101).normal(size=(8, 8)))[0]
_PROPERTY_CENTRE = np.array([7.0, 2.8, 0.33])
_PROPERTY_SPREAD = np.array([4.0, 1.1, 0.12])


def make_latents(
    rng: np.random.Generator,
    kind: LatentKind,
    coords: NDArray[np.uint8],
    material: NDArray[np.uint8],
    properties: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return latents (N, 8) float32 for SLAT voxels.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the noise.
    kind : {"placeholder", "material"}
        ``placeholder`` is normal noise. ``material`` depends on what is there:
        before mean and standard deviation are applied, channel vector ``z`` of
        a voxel is ``2 * code[material] + p @ code[:3] + sin(pi * x) @ code[3:6] / 2
        + 0.5 * noise``, with ``code`` eight fixed orthonormal vectors, ``p`` the
        three properties (log10 Young's modulus, log10 density, Poisson's
        ratio) mapped to about -1..1, and ``x`` the voxel's centre.
    coords : ndarray of uint8, shape (N, 3)
        SLAT voxels.
    material : ndarray of uint8, shape (N,)
        Class of each, 0..6.
    properties : ndarray of float32, shape (N, 3)
        Young's modulus, density and Poisson's ratio of each, SI.
    """
    noise = rng.normal(size=(len(coords), 8))
    if kind == "placeholder":
        return (MEAN + STD * noise).astype(np.float32)
    mapped = properties.astype(np.float64)
    mapped[:, :2] = np.log10(mapped[:, :2])
    mapped = (mapped - _PROPERTY_CENTRE) / _PROPERTY_SPREAD
    z = 2.0 * _CODES[material] + mapped @ _CODES[:3] + NOISE * noise
    z += 0.5 * np.sin(np.pi * voxel_centres(coords)) @ _CODES[3:6]
    feats: NDArray[np.float32] = (MEAN + STD * z).astype(np.float32)
    return feats

"""Take a known frame.

The transform is the source's, or the identity if the source states none. Quality, confidence and
verdict are measured as for any engine. The default engine's search serves as a check: if it finds a
placement that fits clearly better, the margin is negative.
"""

from __future__ import annotations

import numpy as np

from slatprep.align.field import lead_of_another
from slatprep.align.quality import measure_quality
from slatprep.geometry.frames import split_transform
from slatprep.parameters import AlignParameters
from slatprep.records import Alignment, Engine, MaterialField, Model, Search, StructuredLatents


def align(
    field: MaterialField, latents: StructuredLatents, parameters: AlignParameters
) -> Alignment:
    """Take the frame that the field states; see `slatprep.align.align`."""
    transform = np.eye(4) if field.frame is None else field.frame
    _, _, scale = split_transform(transform)
    quality = measure_quality(field, latents, transform, parameters.radius)
    return Alignment(
        transform=transform,
        engine=Engine.KNOWN,
        model=Model.RIGID if abs(scale - 1.0) < 1e-6 else Model.SIMILARITY,
        search=Search.NONE,
        quality=quality,
        # Placements that fit as well do not count: the source says which of them is right.
        margin=-lead_of_another(transform, quality, field, latents, parameters),
    )

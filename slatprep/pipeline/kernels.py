"""Compile the kernels once, before the workers of a build start.

Numba compiles a kernel when it is first called and keeps it on disk. Workers
that start without it would each compile all of them, at the same time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from slatprep.align import align
from slatprep.align.deformation import map_of
from slatprep.geometry.kernel import KEPT
from slatprep.geometry.voxels import voxels_of
from slatprep.judge import judge
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.records import RESOLUTION, MaterialField, StructuredLatents
from slatprep.sample import sample

WHEN = (
    "once after installing"
    if KEPT
    else "in each process, as no cache folder can be written to (NUMBA_CACHE_DIR names one)"
)
"""When kernels are compiled, for the user."""


def compile_kernels(note: Callable[[str], None] | None = None) -> None:
    """Compile all kernels of alignment, sampling and judgement, and keep them on disk.

    Parameters
    ----------
    note : callable, optional
        Gets a line to show when something has to be compiled, which takes
        20 to 40 s in all, and one when that is done; otherwise this takes 1 s.
    """
    from numba.core import event

    class Told(event.Listener):
        told = False

        def on_start(self, event: Any) -> None:
            if note and not self.told:
                note(f"compiling the numerical kernels, {WHEN}: 20 to 40 s")
            self.told = True

        def on_end(self, event: Any) -> None:
            pass

    start, told = time.monotonic(), Told()
    with event.install_listener("numba:compile", told):
        _process_a_bent_shape()
    if note and told.told:
        note(f"compiled in {time.monotonic() - start:.0f} s")


def _process_a_bent_shape() -> None:
    """Align, sample and judge an L whose SLAT is bent so far that it is stretched, with a stray."""
    occupied = np.zeros((RESOLUTION,) * 3, dtype=bool)
    occupied[20:44, 22:36, 26:34] = occupied[20:26, 22:36, 34:50] = True
    voxels = voxels_of(occupied)
    count = len(voxels)
    field = MaterialField(
        occupied, voxels, np.zeros(count, np.uint8), np.ones((count, 3), np.float32)
    )
    bent = voxels.copy()
    bent[:, 2] += ((bent[:, 0] - 20) ** 2 // 25).astype(np.uint8)
    bent = np.append(bent, np.zeros((1, 3), np.uint8), axis=0)  # far from all that is annotated
    latents = StructuredLatents(bent, np.zeros((len(bent), 8), np.float32))
    alignment = align(field, latents, AlignParameters(model="deformable"))
    places = map_of(alignment).places(latents.coords)
    annotation = sample(field, places, SampleParameters())
    judge(field, latents, alignment, annotation, SampleParameters())

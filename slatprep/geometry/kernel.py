"""Numba's compiler, as all kernels are compiled."""

from __future__ import annotations

from functools import partial

from numba import njit


def _can_be_kept() -> bool:
    try:
        njit(cache=True)(_can_be_kept)  # looks for a folder, compiles nothing
    except RuntimeError:
        return False
    return True


KEPT = _can_be_kept()
"""Whether there is a folder in which compiled code can be kept for the next process.

Numba takes the first that can be written to of NUMBA_CACHE_DIR, ``__pycache__``
beside the source and the user's cache, and refuses to cache where there is none,
as in a container whose root is read-only.
"""

kernel = partial(njit, cache=KEPT)

"""Numba's compiler with the settings of all kernels."""

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
"""Whether compiled code can be cached for the next process.

Numba uses the first writable folder of NUMBA_CACHE_DIR, ``__pycache__`` beside the source, and the
user's cache. It refuses to cache if there is none, as in a container with a read-only root.
"""

kernel = partial(njit, cache=KEPT)

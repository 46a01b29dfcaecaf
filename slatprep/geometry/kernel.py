"""Numba's compiler with the settings of all kernels."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache


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


class _KeptIfPossible(FunctionCache):
    """Numba's cache of a function, where a full disk costs only the next process time."""

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function with options of Numba."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = njit(**options)(function)
        if KEPT:
            dispatcher._cache = _KeptIfPossible(function)  # type: ignore[no-untyped-call]
        return dispatcher

    return compiled

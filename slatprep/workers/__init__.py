"""Workers: processes of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

_Result = TypeVar("_Result")

Progress = Callable[[int, int], None]
"""Callback that gets two numbers, done and total, of assets unless stated otherwise."""


def counted(results: Iterable[_Result], total: int, progress: Progress | None) -> Iterator[_Result]:
    """Yield results, and report after each how many of `total` are done."""
    for done, result in enumerate(results, 1):
        yield result
        if progress:
            progress(done, total)

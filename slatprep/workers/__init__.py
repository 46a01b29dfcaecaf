"""Workers: processes of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Callback that gets two numbers, done and total, of assets unless stated otherwise."""

"""Who computes: processes of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called with the number done and the number of all, of assets unless stated otherwise."""

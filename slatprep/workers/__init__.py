"""Who computes: processes of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called with what is done and what there is in all: assets, where nothing else is said."""

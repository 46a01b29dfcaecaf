"""Packages with adapters of their own, as somebody would have installed them."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest

from slatprep.readers import adapters


@contextmanager
def package(
    site: Path, name: str, modules: Mapping[str, str], points: str, patch: pytest.MonkeyPatch
) -> Iterator[None]:
    """Install modules as version 1.0 of a package with these entry points."""
    about = site / f"{name}-1.0.dist-info"
    about.mkdir(parents=True)
    for module, code in modules.items():
        (site / f"{module}.py").write_text(code)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(points)
    patch.syspath_prepend(str(site))
    for cached in (adapters._known, adapters._loaded):
        cached.cache_clear()
    yield
    for cached in (adapters._known, adapters._loaded):
        cached.cache_clear()
    for module in modules:
        sys.modules.pop(module, None)

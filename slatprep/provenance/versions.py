"""The versions of everything that makes an asset's numbers."""

from __future__ import annotations

import platform
from functools import lru_cache
from importlib import metadata

from slatprep.align import engine_versions
from slatprep.parameters import AlignParameters


@lru_cache(maxsize=8)
def library_versions(parameters: AlignParameters) -> dict[str, str]:
    """Return the versions of everything that makes an asset's numbers."""
    # Cached: asking for them takes longer than reading an asset.
    return {
        "slatprep": metadata.version("slatprep"),
        "python": platform.python_version(),
        **numeric_versions(parameters),
    }


@lru_cache(maxsize=8)
def numeric_versions(parameters: AlignParameters) -> dict[str, str]:
    """Return the versions of the libraries that make an asset's numbers."""
    return {
        "numpy": metadata.version("numpy"),
        "scipy": metadata.version("scipy"),
        **engine_versions(parameters),
    }

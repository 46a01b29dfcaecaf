"""Find the transform from the PixieVerse frame to the SLAT frame."""

from __future__ import annotations

from importlib import metadata
from importlib.util import find_spec

from slatprep.errors import ConfigError
from slatprep.parameters import AlignParameters
from slatprep.records import Alignment, Engine, MaterialField, StructuredLatents

_PACKAGES = {
    "field": ("numpy", "scipy", "numba"),
    "open3d": ("numpy", "open3d-cpu", "open3d"),
    "small_gicp": ("numpy", "small_gicp"),
    "known": ("numpy", "scipy", "numba"),
}
"""The packages that make each engine's numbers."""

_EXTRAS = {"open3d": "paper", "small_gicp": "bench"}
"""Engines that are packages of their own, and the extra that installs each."""


def align(
    field: MaterialField, latents: StructuredLatents, parameters: AlignParameters
) -> Alignment:
    """Find the transform that lays a PixieVerse field on a SLAT.

    Parameters
    ----------
    field : MaterialField
        The PixieVerse side; only its geometry is used.
    latents : StructuredLatents
        The SLAT side; only its voxels are used.
    parameters : AlignParameters
        Which engine, and how.

    Returns
    -------
    Alignment
        The transform with its quality and every candidate's score.
    """
    require_engine(parameters)
    # Imported when first used: Open3D alone takes seconds.
    match parameters.engine:
        case Engine.FIELD:
            from slatprep.align.field import align as align_field

            return align_field(field, latents, parameters)
        case Engine.OPEN3D:
            from slatprep.align.open3d_icp import align as align_open3d

            return align_open3d(field, latents, parameters)
        case Engine.SMALL_GICP:
            from slatprep.align.gicp import align as align_gicp

            return align_gicp(field, latents, parameters)
        case Engine.KNOWN:
            from slatprep.align.known import align as align_known

            return align_known(field, latents, parameters)


def require_engine(parameters: AlignParameters) -> None:
    """Make sure that an engine's package is installed, and Open3D can be loaded.

    ConfigError if it is not; the message says what to install.
    """
    extra = _EXTRAS.get(parameters.engine)
    if extra is not None and find_spec(parameters.engine) is None:
        raise ConfigError(
            f"the engine {parameters.engine} needs the package of that name, which is not "
            f"installed: pip install 'slatprep[{extra}]'"
        )
    if parameters.engine is Engine.OPEN3D:
        from slatprep.align.open3d_icp import load_open3d

        load_open3d()


def engine_versions(parameters: AlignParameters) -> dict[str, str]:
    """Return the versions, by package, of the libraries that make an engine's numbers.

    ConfigError if the engine is not installed.
    """
    require_engine(parameters)
    versions = {}
    for package in _PACKAGES[parameters.engine]:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue  # Open3D goes by two names; one of them is installed.
    return versions

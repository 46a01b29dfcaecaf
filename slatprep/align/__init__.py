"""Find the transform from the PixieVerse frame to the SLAT frame."""

from __future__ import annotations

from importlib import metadata
from importlib.util import find_spec

from slatprep.errors import ConfigError
from slatprep.parameters import AlignParameters
from slatprep.records import Alignment, Engine, MaterialField, StructuredLatents

_COMMON = "numpy", "scipy", "numba"
"""Packages that compute with every engine: quality, look-up and judgement use them too."""

_PACKAGES = {"open3d": ("open3d-cpu", "open3d"), "small_gicp": ("small_gicp",)}
"""Packages that compute the results of an engine besides."""

_EXTRAS = {"open3d": "paper", "small_gicp": "bench"}
"""Extra that installs the package of an engine."""


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
        The engine and its settings.

    Returns
    -------
    Alignment
        The transform with its quality and every candidate's score.
    """
    require_engine(parameters)
    # Imported on first use, as importing Open3D takes seconds.
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
    """Check that the engine's package is installed and that Open3D can be loaded.

    Raise ConfigError if it is not installed; the message says what to install. Raise SlatprepError
    if Open3D cannot be loaded.
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
    """Return the versions, by package, of the libraries that compute an asset with an engine.

    Raise ConfigError if the engine is not installed.
    """
    require_engine(parameters)
    versions = {}
    for package in (*_COMMON, *_PACKAGES.get(parameters.engine, ())):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue  # Open3D has two package names; only one is installed.
    return versions

"""slatprep: physics supervision for structured latents that one can trust.

The nouns and verbs that a notebook needs, loaded when they are first used:

- a store: `open_store`, `Store`, `StoredAsset`, `build_store`, `export_store`;
- its sources: `load_parameters`, `discover`, `read_field`, `read_latents`;
- two voxel sets: `align_voxels`, `annotate_voxels`, `apply_transform`;
- properties: `normalize_properties`, `denormalize_properties`, `PIXIE_RANGES`;
- the records that travel between them: `MaterialField`, `StructuredLatents`,
  `Alignment`, `Annotation`, `Normalization`, ...

The stages themselves are the modules `slatprep.align`, `slatprep.sample` and
`slatprep.normalize`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slatprep.api import (
        align_voxels,
        annotate_voxels,
        denormalize_properties,
        normalize_properties,
    )
    from slatprep.config import load_parameters
    from slatprep.demo import make_demo
    from slatprep.errors import ConfigError, InputError, SlatprepError, StoreError
    from slatprep.export import export_store
    from slatprep.geometry.frames import apply_transform, voxel_centres
    from slatprep.normalize import PIXIE_RANGES
    from slatprep.parameters import BuildParameters
    from slatprep.pipeline.dataset import build_store
    from slatprep.readers import discover, read_field, read_latents
    from slatprep.records import (
        MATERIAL_CLASSES,
        PROPERTY_COLUMNS,
        Alignment,
        Annotation,
        AssetPair,
        MaterialField,
        Normalization,
        PropertyRange,
        Quality,
        StructuredLatents,
        Verdict,
    )
    from slatprep.store import Store, StoredAsset, open_store

__version__ = "0.1.0"

_HOMES = {
    "slatprep.pipeline.dataset": ("build_store",),
    "slatprep.config": ("load_parameters",),
    "slatprep.demo": ("make_demo",),
    "slatprep.errors": ("ConfigError", "InputError", "SlatprepError", "StoreError"),
    "slatprep.export": ("export_store",),
    "slatprep.geometry.frames": ("apply_transform", "voxel_centres"),
    "slatprep.normalize": ("PIXIE_RANGES",),
    "slatprep.parameters": ("BuildParameters",),
    "slatprep.readers": ("discover", "read_field", "read_latents"),
    "slatprep.records": (
        "MATERIAL_CLASSES",
        "PROPERTY_COLUMNS",
        "Alignment",
        "Annotation",
        "AssetPair",
        "MaterialField",
        "Normalization",
        "PropertyRange",
        "Quality",
        "StructuredLatents",
        "Verdict",
    ),
    "slatprep.store": ("Store", "StoredAsset", "open_store"),
    "slatprep.api": (
        "align_voxels",
        "annotate_voxels",
        "denormalize_properties",
        "normalize_properties",
    ),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "MATERIAL_CLASSES",
    "PIXIE_RANGES",
    "PROPERTY_COLUMNS",
    "Alignment",
    "Annotation",
    "AssetPair",
    "BuildParameters",
    "ConfigError",
    "InputError",
    "MaterialField",
    "Normalization",
    "PropertyRange",
    "Quality",
    "SlatprepError",
    "Store",
    "StoreError",
    "StoredAsset",
    "StructuredLatents",
    "Verdict",
    "__version__",
    "align_voxels",
    "annotate_voxels",
    "apply_transform",
    "build_store",
    "denormalize_properties",
    "discover",
    "export_store",
    "load_parameters",
    "make_demo",
    "normalize_properties",
    "open_store",
    "read_field",
    "read_latents",
    "voxel_centres",
]


if not TYPE_CHECKING:  # to a type checker, this would make every misspelt name one that exists

    def __getattr__(name: str) -> object:
        # PEP 562: importing everything takes a second, importing the package must not.
        if name not in _HOME_OF:
            raise AttributeError(f"module 'slatprep' has no attribute {name!r}")
        value = getattr(importlib.import_module(_HOME_OF[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})

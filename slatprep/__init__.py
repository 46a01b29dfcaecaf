"""slatprep: physics supervision for structured latents that you can trust.

The names that a notebook needs, loaded on first use. ``__init__.pyi`` lists them
(Scientific Python's SPEC 1):

- a store: `open_store`, `Store`, `StoredAsset`, `build_store`, `export_store`;
- what is in it: `store_statistics`, `compare_stores`;
- its sources: `load_parameters`, `discover`, `read_field`, `read_latents`;
- two voxel sets: `align_voxels`, `annotate_voxels`, `apply_transform`, and
  `map_of`, which returns an alignment's map of points, a `PlaceMap`;
- properties: `normalize_properties`, `denormalize_properties`, `PIXIE_RANGES`;
- the records that travel between them: `MaterialField`, `StructuredLatents`,
  `Alignment`, `Annotation`, `Normalization`, ...

The stages themselves are the modules `slatprep.align`, `slatprep.sample` and
`slatprep.normalize`.
"""

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("slatprep")
    return _load(name)

# ruff: noqa: I001 (one import a module)
from .geometry.deformation import (
    PlaceMap as PlaceMap,
    map_of as map_of,
)
from .api import (
    align_voxels as align_voxels,
    annotate_voxels as annotate_voxels,
)
from .parameters.files import load_parameters as load_parameters
from .demo import make_demo as make_demo
from .errors import (
    ConfigError as ConfigError,
    InputError as InputError,
    SlatprepError as SlatprepError,
    StoreError as StoreError,
)
from .export import export_store as export_store
from .geometry.frames import (
    apply_transform as apply_transform,
    voxel_centres as voxel_centres,
)
from .inspect.compare import compare_stores as compare_stores
from .inspect.statistics import store_statistics as store_statistics
from .normalize import (
    PIXIE_RANGES as PIXIE_RANGES,
    denormalize_properties as denormalize_properties,
    normalize_properties as normalize_properties,
)
from .parameters import BuildParameters as BuildParameters
from .pipeline.dataset import build_store as build_store
from .pipeline.join import (
    concat_stores as concat_stores,
    subset_store as subset_store,
)
from .readers import (
    discover as discover,
    read_field as read_field,
    read_latents as read_latents,
)
from .records import (
    MATERIAL_CLASSES as MATERIAL_CLASSES,
    PROPERTY_COLUMNS as PROPERTY_COLUMNS,
    Alignment as Alignment,
    Annotation as Annotation,
    AssetPair as AssetPair,
    Deformation as Deformation,
    MaterialField as MaterialField,
    Normalization as Normalization,
    PropertyRange as PropertyRange,
    Quality as Quality,
    StructuredLatents as StructuredLatents,
    Verdict as Verdict,
)
from .store import (
    Store as Store,
    StoredAsset as StoredAsset,
    open_store as open_store,
)

__version__: str

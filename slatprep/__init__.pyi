from .api import (
    align_voxels as align_voxels,
)
from .api import (
    annotate_voxels as annotate_voxels,
)
from .api import (
    denormalize_properties as denormalize_properties,
)
from .api import (
    normalize_properties as normalize_properties,
)
from .config import load_parameters as load_parameters
from .demo import make_demo as make_demo
from .errors import (
    ConfigError as ConfigError,
)
from .errors import (
    InputError as InputError,
)
from .errors import (
    SlatprepError as SlatprepError,
)
from .errors import (
    StoreError as StoreError,
)
from .export import export_store as export_store
from .geometry.frames import apply_transform as apply_transform
from .geometry.frames import voxel_centres as voxel_centres
from .normalize import PIXIE_RANGES as PIXIE_RANGES
from .parameters import BuildParameters as BuildParameters
from .pipeline.dataset import build_store as build_store
from .readers import discover as discover
from .readers import read_field as read_field
from .readers import read_latents as read_latents
from .records import (
    MATERIAL_CLASSES as MATERIAL_CLASSES,
)
from .records import (
    PROPERTY_COLUMNS as PROPERTY_COLUMNS,
)
from .records import (
    Alignment as Alignment,
)
from .records import (
    Annotation as Annotation,
)
from .records import (
    AssetPair as AssetPair,
)
from .records import (
    MaterialField as MaterialField,
)
from .records import (
    Normalization as Normalization,
)
from .records import (
    PropertyRange as PropertyRange,
)
from .records import (
    Quality as Quality,
)
from .records import (
    StructuredLatents as StructuredLatents,
)
from .records import (
    Verdict as Verdict,
)
from .store import Store as Store
from .store import StoredAsset as StoredAsset
from .store import open_store as open_store

__version__: str

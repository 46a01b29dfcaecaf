from .dataset import (
    FEATS_MEAN as FEATS_MEAN,
)
from .dataset import (
    FEATS_STD as FEATS_STD,
)
from .dataset import (
    IGNORED as IGNORED,
)
from .dataset import (
    Draw as Draw,
)
from .dataset import (
    EpochSampler as EpochSampler,
)
from .dataset import (
    Item as Item,
)
from .dataset import (
    SlatDataset as SlatDataset,
)
from .dataset import (
    SlatLoader as SlatLoader,
)
from .dataset import (
    SparseBatch as SparseBatch,
)
from .dataset import (
    collate as collate,
)
from .splits import Shares as Shares
from .splits import split_of as split_of

def require_torch() -> None: ...

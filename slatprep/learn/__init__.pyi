# ruff: noqa: I001 (one import a module)
from .dataset import (
    FEATS_MEAN as FEATS_MEAN,
    FEATS_STD as FEATS_STD,
    IGNORED as IGNORED,
    Draw as Draw,
    EpochSampler as EpochSampler,
    Item as Item,
    SlatDataset as SlatDataset,
    SlatLoader as SlatLoader,
    SparseBatch as SparseBatch,
    collate as collate,
)
from .splits import (
    Shares as Shares,
    split_of as split_of,
)

def require_torch(device: str | None = "cpu") -> str: ...

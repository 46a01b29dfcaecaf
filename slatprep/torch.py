"""The store in PyTorch: ``pip install slatprep[train]``.

>>> from slatprep.torch import SlatDataset, SlatLoader
>>> train = SlatDataset("demo.zarr", "train", verdicts=("good",))  # doctest: +SKIP
>>> loader = SlatLoader(train, batch_size=4, shuffle=True, workers=2)  # doctest: +SKIP
>>> batch = next(iter(loader))  # doctest: +SKIP
>>> batch.coords.shape, batch.feats.shape  # doctest: +SKIP
(torch.Size([21234, 4]), torch.Size([21234, 8]))
"""

from slatprep.learn import require_torch

require_torch()

from slatprep.learn.dataset import (  # noqa: E402
    FEATS_MEAN,
    FEATS_STD,
    IGNORED,
    Draw,
    EpochSampler,
    Item,
    SlatDataset,
    SlatLoader,
    SparseBatch,
    collate,
)
from slatprep.learn.splits import Shares, split_of  # noqa: E402

__all__ = [
    "FEATS_MEAN",
    "FEATS_STD",
    "IGNORED",
    "Draw",
    "EpochSampler",
    "Item",
    "Shares",
    "SlatDataset",
    "SlatLoader",
    "SparseBatch",
    "collate",
    "split_of",
]

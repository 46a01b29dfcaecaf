"""A store as a PyTorch dataset, and batches in the form of TRELLIS's sparse tensors."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler, get_worker_info

from slatprep.errors import ConfigError, StoreError, amount
from slatprep.learn.augment import Augmentation, lattice_symmetries, move
from slatprep.learn.splits import select_assets
from slatprep.readers.splits import Shares, Split
from slatprep.records import FEATS_MEAN as FEATS_MEAN
from slatprep.records import FEATS_STD as FEATS_STD
from slatprep.records import UNANNOTATED, USABLE, Place
from slatprep.store import Store, open_store

IGNORED = -100
"""Class of voxels without annotation, which `torch.nn.functional.cross_entropy` ignores."""

_COLUMNS = ("coords", "feats", "properties", "material", "valid", "confidence")


class Draw(NamedTuple):
    """An asset of one epoch; the epoch decides its augmentation."""

    number: int
    epoch: int


@dataclass
class Item:
    """One asset as tensors.

    Attributes
    ----------
    asset_id : str
        Id of the asset.
    coords : Tensor of int32, shape (N, 3)
        SLAT voxels.
    feats : Tensor of float32, shape (N, channels)
        Latents, standardised with the encoder's mean and standard deviation.
    properties : Tensor of float32, shape (N, P)
        The store's properties in [-1, 1]; 0 where not valid.
    material : Tensor of int64, shape (N,)
        Class, below `Contents.n_labels`; `IGNORED` where not valid.
    valid : Tensor of bool, shape (N,)
        Which voxels have targets.
    confidence : Tensor of float32, shape (N,)
        Probability that the class is right; 0 where not valid.
    """

    asset_id: str
    coords: Tensor
    feats: Tensor
    properties: Tensor
    material: Tensor
    valid: Tensor
    confidence: Tensor


@dataclass
class SparseBatch:
    """Concatenated assets in the form of TRELLIS's ``SparseTensor``.

    ``SparseTensor(feats=batch.feats, coords=batch.coords)`` makes a tensor of a batch.

    Attributes
    ----------
    asset_ids : list of str
        Ids by the value of the batch column.
    coords : Tensor of int32, shape (N, 4)
        Batch column, then the voxel.
    feats, properties, material, valid, confidence : Tensor
        As in `Item`, with N rows.
    """

    asset_ids: list[str]
    coords: Tensor
    feats: Tensor
    properties: Tensor
    material: Tensor
    valid: Tensor
    confidence: Tensor

    @property
    def layout(self) -> list[slice]:
        """Rows of each asset, as ``SparseTensor.layout``."""
        counts = torch.bincount(self.coords[:, 0].long(), minlength=len(self.asset_ids))
        stops = np.cumsum(counts.tolist()).tolist()
        return [slice(a, b) for a, b in zip([0, *stops[:-1]], stops, strict=True)]

    def to(self, device: torch.device | str) -> SparseBatch:
        """Return the batch on a device."""
        return self._each(lambda tensor: tensor.to(device=device, non_blocking=True))

    def pin_memory(self) -> SparseBatch:
        """Return the batch in pinned memory; `DataLoader` calls this."""
        return self._each(Tensor.pin_memory)

    def _each(self, change: Callable[[Tensor], Tensor]) -> SparseBatch:
        return SparseBatch(self.asset_ids, *(change(getattr(self, name)) for name in _COLUMNS))


class SlatDataset(Dataset[Item]):
    """The assets of one split of a store.

    Parameters
    ----------
    store : Store or path
        An open store, or its path or URL. Worker processes, forked or spawned, each open it
        themselves.
    split : {"train", "val", "test"}, optional
        Only the objects of this split, see `slatprep.readers.splits.split_objects`.
    shares : Shares
        Shares of the splits.
    splits : mapping of str to {"train", "val", "test"}, optional
        Split of each object by id, such as from `slatprep.learn.splits.assign_store`;
        by default the split by hash.
    verdicts : str or collection of str
        Only assets with one of these verdicts, by default good and doubtful ones; empty or ``all``
        takes all.
    max_ambiguity : float, optional
        Only assets with at most this ambiguity.
    min_confidence : float, optional
        Least probability that a voxel's class is right for the voxel to be valid.
    augmentation : {"none", "upright", "all"}
        Symmetries of the lattice to draw from, see `slatprep.learn.augment`.
    seed : int
        Decides, with the epoch and the asset's id, which symmetry is drawn.

    Raises
    ------
    ConfigError
        If no asset is left, or the split, a verdict or `augmentation` is unknown, or
        `min_confidence` or `seed` is out of its range.
    StoreError
        If the store cannot be read.
    """

    def __init__(
        self,
        store: Store | str | Place,
        split: Split | None = None,
        *,
        shares: Shares = Shares(),  # noqa: B008 (immutable)
        splits: Mapping[str, Split] | None = None,
        verdicts: Collection[str] = USABLE,
        max_ambiguity: float | None = None,
        min_confidence: float | None = None,
        augmentation: Augmentation = "none",
        seed: int = 0,
    ) -> None:
        if min_confidence is not None and not 0 <= min_confidence <= 1:
            raise ConfigError(f"min_confidence is {min_confidence}; expected 0 to 1")
        if seed < 0:
            raise ConfigError(f"seed is {seed}; expected 0 or more")
        self.store = open_store(store, copy=True)
        self.split = split
        every = select_assets(self.store, split, shares=shares, splits=splits)
        fit = select_assets(self.store, verdicts=verdicts, max_ambiguity=max_ambiguity)
        self.indices = np.intersect1d(every, fit, assume_unique=True)
        self._left_out = len(every) - len(self)
        if len(self.indices) == 0:
            raise ConfigError(
                f"{self.store.path} has no asset of split {split or 'all'} that passes the "
                f"filter, of {len(self.store)} in all; expected at least one. Loosen the filter, "
                "change the shares, or add objects (at least as many as splits)"
            )
        self.asset_ids = [self.store.ids[index] for index in self.indices]
        self.seed, self.min_confidence, self.epoch = seed, min_confidence, 0
        self._symmetries = lattice_symmetries(augmentation)
        self._latents = self.store.contents.latents

    def __len__(self) -> int:
        return len(self.indices)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch that decides the augmentation; a `SlatLoader` has an epoch of its own."""
        self.epoch = epoch

    def __repr__(self) -> str:
        return (
            f"<SlatDataset {self.store.path}, split {self.split or 'all'}: "
            f"{amount(len(self), 'asset')}, {self._left_out:,} left out by verdict or ambiguity>"
        )

    def __getitem__(self, key: int | Draw) -> Item:
        draw = key if isinstance(key, Draw) else Draw(key, self.epoch)
        if not -len(self) <= draw.number < len(self):
            raise IndexError(f"asset {draw.number} of {len(self)}")
        try:
            rows = self.store.read(int(self.indices[draw.number]), _COLUMNS)
        except StoreError as error:
            if get_worker_info() is None:
                raise
            # PyTorch hands on an error of a worker only if its class takes one text.
            raise StoreError(str(error)) from error
        asset_id = self.asset_ids[draw.number]
        valid, confidence = rows["valid"], rows["confidence"]
        if self.min_confidence is not None:
            valid = valid & (confidence >= self.min_confidence)
        material = rows["material"].astype(np.int64)
        material[~valid | (rows["material"] == UNANNOTATED)] = IGNORED
        symmetry, side = self._symmetry(asset_id, draw), self._latents.resolution
        return Item(
            asset_id,
            torch.from_numpy(move(rows["coords"].astype(np.int32), symmetry, side)),
            torch.from_numpy(self._latents.standardise(rows["feats"])),
            torch.from_numpy(np.where(valid[:, None], rows["properties"], np.float32(0))),
            torch.from_numpy(material),
            torch.from_numpy(valid),
            torch.from_numpy(np.where(valid, confidence, np.float32(0))),
        )

    def _symmetry(self, asset_id: str, draw: Draw) -> np.ndarray:
        # Not from a worker's generator, since the draw must not depend on the number of workers.
        words = np.frombuffer(asset_id.encode("utf-8").ljust(4, b"\0"), np.uint8)
        rng = np.random.default_rng([self.seed, draw.epoch, *words.tolist()])
        return np.asarray(self._symmetries[rng.integers(len(self._symmetries))])


def collate(items: Sequence[Item]) -> SparseBatch:
    """Make one sparse batch of at least one asset, in the given order."""
    coords = [
        torch.nn.functional.pad(item.coords, (1, 0), value=number)
        for number, item in enumerate(items)
    ]
    others = (torch.cat([getattr(item, name) for item in items]) for name in _COLUMNS[1:])
    return SparseBatch([item.asset_id for item in items], torch.cat(coords), *others)


class EpochSampler(Sampler[Draw]):
    """Each of `length` assets once, in an order that follows from seed and epoch.

    Each pass that begins is the next epoch. Without `shuffle` the order is that of the store.
    """

    def __init__(self, length: int, *, shuffle: bool, seed: int) -> None:
        self.length, self.shuffle, self.seed = length, shuffle, seed
        self.epoch = self.first = 0

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[Draw]:
        epoch, first = self.epoch, self.first
        self.epoch, self.first = epoch + 1, 0
        order = np.arange(self.length)
        if self.shuffle:
            order = np.random.default_rng([self.seed, epoch]).permutation(self.length)
        return (Draw(int(index), epoch) for index in order[first:])


class SlatLoader(DataLoader[SparseBatch]):
    """Batches of a `SlatDataset`, which do not depend on the number of workers.

    Parameters
    ----------
    dataset : SlatDataset, Store or path
        The assets to load; of a store, those that a `SlatDataset` takes by default.
    batch_size : int
        Assets in a batch; the last may have fewer.
    shuffle : bool
        Whether each epoch has another order, which follows from the dataset's seed.
    workers : int
        Processes that read ahead; 0 reads in this process.
    start_method : {"fork", "spawn", "forkserver"}, optional
        How the processes are started; by default as usual on the platform.
    pin_memory : bool
        Whether to pin batches in memory, for faster copies to a GPU.

    Examples
    --------
    >>> loader = SlatLoader(SlatDataset("demo.zarr", "train"), 4)  # doctest: +SKIP
    >>> for epoch in range(10):  # doctest: +SKIP
    ...     loader.set_epoch(epoch)
    ...     for batch in loader:
    ...         print(batch.coords.shape, batch.feats.shape)
    """

    def __init__(
        self,
        dataset: SlatDataset | Store | str | Place,
        batch_size: int = 1,
        *,
        shuffle: bool = False,
        workers: int = 0,
        start_method: str | None = None,
        pin_memory: bool = False,
    ) -> None:
        if not isinstance(dataset, SlatDataset):
            dataset = SlatDataset(dataset)
        self.order = EpochSampler(len(dataset), shuffle=shuffle, seed=dataset.seed)
        super().__init__(
            dataset,  # type: ignore[arg-type]  # of items, which `collate` makes batches of
            batch_size,
            sampler=self.order,
            num_workers=workers,
            collate_fn=collate,
            multiprocessing_context=start_method if workers else None,
            pin_memory=pin_memory,
        )

    def set_epoch(self, epoch: int, batches: int = 0) -> None:
        """Set the epoch of the next pass, which decides order and augmentation.

        The pass skips its first `batches`. Without a call, each pass is the next epoch. ConfigError
        if `batches` is negative.
        """
        if batches < 0:
            raise ConfigError(f"batches to skip: {batches}; expected 0 or more")
        self.order.epoch, self.order.first = epoch, batches * (self.batch_size or 1)

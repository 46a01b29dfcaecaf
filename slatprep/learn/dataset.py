"""A store as a PyTorch dataset, and batches in the form of TRELLIS's sparse tensors."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from slatprep.errors import ConfigError
from slatprep.learn.augment import Augmentation, lattice_symmetries, move
from slatprep.learn.splits import Shares, Split, select_assets
from slatprep.records import FEATS_MEAN as FEATS_MEAN
from slatprep.records import FEATS_STD as FEATS_STD
from slatprep.records import UNANNOTATED, Place
from slatprep.store import Store, open_store

IGNORED = -100
"""Class of a voxel without annotation: what `torch.nn.functional.cross_entropy` passes over."""

_COLUMNS = ("coords", "feats", "properties", "material", "valid", "confidence")


class Draw(NamedTuple):
    """One asset of one epoch; the epoch decides its augmentation."""

    number: int
    epoch: int


@dataclass
class Item:
    """One asset as tensors.

    Attributes
    ----------
    asset_id : str
        Id of the row.
    coords : Tensor of int32, shape (N, 3)
        SLAT voxels.
    feats : Tensor of float32, shape (N, channels)
        Latents, standardised with the encoder's mean and standard deviation
        unless the store's have been standardised already.
    properties : Tensor of float32, shape (N, P)
        The store's properties in [-1, 1]; 0 where not valid.
    material : Tensor of int64, shape (N,)
        Class 0..6; -100 where not valid.
    valid : Tensor of bool, shape (N,)
        Where the targets mean something.
    confidence : Tensor of float32, shape (N,)
        How likely the class is right; 0 where not valid, 1 elsewhere in a store
        of format 1, which does not tell.
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
    """Assets one after the other, as TRELLIS's ``SparseTensor`` has them.

    ``SparseTensor(feats=batch.feats, coords=batch.coords)`` is one.

    Attributes
    ----------
    asset_ids : list of str
        One for each value of the batch column.
    coords : Tensor of int32, shape (N, 4)
        Batch column, then the voxel.
    feats, properties, material, valid, confidence : Tensor
        As in `Item`, of N rows.
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
        return self._each(lambda tensor: tensor.to(device, non_blocking=True))

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
        An open store, or where one lies. Worker processes, forked or spawned,
        each read it for themselves.
    split : {"train", "val", "test"}, optional
        Which objects, as `slatprep.learn.splits.split_objects` decides; all if not given.
    shares : Shares
        Shares of the splits.
    splits : mapping of str to {"train", "val", "test"}, optional
        Split by object id, such as those of `slatprep.learn.splits.assign_store`,
        instead of the hash.
    verdicts : collection of str, optional
        Verdicts that are good enough; all if not given.
    max_ambiguity : float, optional
        Largest ambiguity that is good enough.
    min_confidence : float, optional
        Voxels whose class is less likely right are not valid.
    augmentation : {"none", "upright", "all"}
        Symmetries of the lattice to draw from, see `slatprep.learn.augment`.
    seed : int
        Decides, with the epoch and the asset's id, which symmetry is drawn.

    Raises
    ------
    ConfigError
        If no asset is left, or confidence is asked for and the store has none.
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
        verdicts: Collection[str] | None = None,
        max_ambiguity: float | None = None,
        min_confidence: float | None = None,
        augmentation: Augmentation = "none",
        seed: int = 0,
    ) -> None:
        self.store = store if isinstance(store, Store) else open_store(store, copy=True)
        self.indices = select_assets(
            self.store,
            split,
            shares=shares,
            splits=splits,
            verdicts=verdicts,
            max_ambiguity=max_ambiguity,
        )
        if len(self.indices) == 0:
            raise ConfigError(
                f"{self.store.path} has no asset of split {split or 'all'} that passes the "
                f"filter, of {len(self.store)} in all; expected one at least: "
                "loosen the filter, change the shares, or add objects (as many as splits are "
                "the least)"
            )
        self.asset_ids = [self.store.ids[index] for index in self.indices]
        if min_confidence is not None:
            require_confidence(self.store)
        self.seed, self.min_confidence = seed, min_confidence
        self._symmetries = lattice_symmetries(augmentation)
        self._latents = self.store.contents.latents

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, key: int | Draw) -> Item:
        draw = key if isinstance(key, Draw) else Draw(key, 0)
        if not 0 <= draw.number < len(self):
            raise IndexError(f"asset {draw.number} of {len(self)}")
        rows = self.store.read(int(self.indices[draw.number]), _COLUMNS)
        asset_id = self.asset_ids[draw.number]
        valid, confidence = rows["valid"], rows["confidence"]
        if self.store.format_version == 1:
            confidence = valid.astype(np.float32)
        if self.min_confidence is not None:
            valid = valid & (confidence >= self.min_confidence)
        material = rows["material"].astype(np.int64)
        material[~valid | (rows["material"] == UNANNOTATED)] = IGNORED
        return Item(
            asset_id,
            torch.from_numpy(move(rows["coords"].astype(np.int32), self._symmetry(asset_id, draw))),
            torch.from_numpy(self._latents.standardise(rows["feats"])),
            torch.from_numpy(np.where(valid[:, None], rows["properties"], np.float32(0))),
            torch.from_numpy(material),
            torch.from_numpy(valid),
            torch.from_numpy(confidence),
        )

    def _symmetry(self, asset_id: str, draw: Draw) -> np.ndarray:
        # Not from a worker's own generator: the draw must not depend on the number of workers.
        words = np.frombuffer(asset_id.encode("utf-8").ljust(4, b"\0"), np.uint8)
        rng = np.random.default_rng([self.seed, draw.epoch, *words.tolist()])
        return np.asarray(self._symmetries[rng.integers(len(self._symmetries))])


def require_confidence(store: Store) -> None:
    """Make sure that a store tells how likely its classes are right.

    Raises
    ------
    ConfigError
        If it has format 1, which does not.
    """
    if store.format_version == 1:
        raise ConfigError(
            f"{store.path} has format 1, without the confidence of voxels; expected format 2 or "
            "later: build it again"
        )


def collate(items: Sequence[Item]) -> SparseBatch:
    """Make one sparse batch of several assets.

    Parameters
    ----------
    items : sequence of Item
        One at least.
    """
    coords = [
        torch.nn.functional.pad(item.coords, (1, 0), value=number)
        for number, item in enumerate(items)
    ]
    others = (torch.cat([getattr(item, name) for item in items]) for name in _COLUMNS[1:])
    return SparseBatch([item.asset_id for item in items], torch.cat(coords), *others)


class EpochSampler(Sampler[Draw]):
    """Every asset once, in an order that seed and epoch decide.

    Parameters
    ----------
    length : int
        Number of assets.
    shuffle : bool
        In the order of the store if False.
    seed : int
        With the epoch, decides the order.
    """

    def __init__(self, length: int, *, shuffle: bool, seed: int) -> None:
        self.length, self.shuffle, self.seed = length, shuffle, seed
        self.epoch = 0

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[Draw]:
        order = np.arange(self.length)
        if self.shuffle:
            order = np.random.default_rng([self.seed, self.epoch]).permutation(self.length)
        return (Draw(int(index), self.epoch) for index in order)


class SlatLoader(DataLoader[Item]):
    """Batches of a `SlatDataset`, the same ones whatever the number of workers.

    Parameters
    ----------
    dataset : SlatDataset
        What to load.
    batch_size : int
        Assets in a batch; the last may have fewer.
    shuffle : bool
        A new order each epoch, which the dataset's seed decides.
    workers : int
        Processes that read ahead; 0 reads in this one.
    start_method : {"fork", "spawn", "forkserver"}, optional
        How they start; the platform's way if not given.
    pin_memory : bool
        For a GPU.

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
        dataset: SlatDataset,
        batch_size: int = 1,
        *,
        shuffle: bool = False,
        workers: int = 0,
        start_method: str | None = None,
        pin_memory: bool = False,
    ) -> None:
        self.order = EpochSampler(len(dataset), shuffle=shuffle, seed=dataset.seed)
        super().__init__(
            dataset,
            batch_size,
            sampler=self.order,
            num_workers=workers,
            collate_fn=collate,
            multiprocessing_context=start_method if workers else None,
            pin_memory=pin_memory,
        )

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch, which decides order and augmentation."""
        self.order.epoch = epoch

"""One npz an asset, as TRELLIS's dataset toolkit writes latents, with the targets added."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from slatprep.export.assets import TARGETS, Exported
from slatprep.export.formats import ExportOptions, Writer
from slatprep.storage.names import file_name
from slatprep.store import Store, StoredAsset


def writer(store: Store, ids: Sequence[str], options: ExportOptions) -> Writer:
    """Return what writes one npz an asset; see `slatprep.export.FORMATS`."""
    return Writer(write)


def write(directory: Path, number: int, assets: Iterable[StoredAsset]) -> Iterator[Exported]:
    """Write one npz an asset: TRELLIS's ``coords`` and ``feats``, and the `TARGETS`.

    Parameters
    ----------
    directory : Path
        Where to.
    number : int
        Of the batch; unused, as each asset has its own file.
    assets : iterable of StoredAsset
        The assets of the batch.

    Yields
    ------
    Exported
        What was written of each.
    """
    for asset in assets:
        name = f"{file_name(asset.asset_id)}.npz"
        arrays = {key: getattr(asset, key) for key in ("coords", "feats", *TARGETS)}
        np.savez_compressed(directory / name, **arrays)
        yield Exported(asset, name, len(asset.coords))

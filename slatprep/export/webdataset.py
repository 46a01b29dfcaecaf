"""WebDataset shards: tar files in which the members with one key are a sample."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import orjson

from slatprep.export import formats
from slatprep.storage.files import file_name
from slatprep.store import Store, StoredAsset


def writer(store: Store, ids: Sequence[str], options: formats.ExportOptions) -> formats.Writer:
    """Return the writer of shards of `options.shard_size` assets; see `slatprep.export.FORMATS`."""
    return formats.Writer(write, batch=options.shard_size)


def write(
    directory: Path, number: int, assets: Iterable[StoredAsset]
) -> Iterator[formats.Exported]:
    """Write shard `number` with ``<key>.json`` and ``<key>.npz`` for each asset.

    The key is the asset's id with dots encoded: for WebDataset a key ends at the first dot.
    """
    shard = f"shard-{number:06d}.tar"
    with tarfile.open(directory / shard, "w") as tar:
        for asset in assets:
            key = file_name(asset.asset_id, dots=False)
            about = {**formats.describe_columns(asset), "transform": asset.transform.tolist()}
            _add(tar, f"{key}.json", orjson.dumps(about))
            names = formats.with_merged(
                asset.store, "coords", "feats", *formats.TARGETS, "distance", "place"
            )
            # Not compressed, since a training loop reads it repeatedly.
            packed = io.BytesIO()
            np.savez(packed, **{name: getattr(asset, name) for name in names})
            _add(tar, f"{key}.npz", packed.getvalue())
            yield formats.Exported(asset, shard, len(asset.coords))


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    # A new TarInfo has no owner and time 0, so the bytes are reproducible.
    member = tarfile.TarInfo(name)
    member.size = len(content)
    tar.addfile(member, io.BytesIO(content))

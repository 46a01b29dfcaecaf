"""Shards of the WebDataset convention: a tar whose members of one key are one sample."""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from slatprep.export.assets import ExportedAsset, describe_columns, file_name
from slatprep.provenance.jsonable import jsonable


class ShardWriter:
    """A shard that is being written; a context manager.

    Parameters
    ----------
    path : Path
        The tar file.
    """

    def __init__(self, path: Path) -> None:
        self._tar = tarfile.open(path, "w")  # noqa: SIM115 - closed by __exit__

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._tar.close()

    def add(self, asset: ExportedAsset) -> None:
        """Write an asset as one sample: ``<key>.json`` and ``<key>.npz``.

        The key is the asset's id without dots, since WebDataset takes what
        follows the first dot for the member's kind.
        """
        key = file_name(asset.asset_id, dots=False)
        about = {**describe_columns(asset), "transform": asset.transform}
        text = json.dumps(jsonable(about), allow_nan=False, ensure_ascii=False)
        self._add(f"{key}.json", text.encode())
        arrays = io.BytesIO()
        # Not compressed: a training loop reads this again and again.
        np.savez(
            arrays,
            coords=asset.coords,
            feats=asset.feats,
            properties=asset.properties,
            material=asset.material,
            valid=asset.valid,
            distance=asset.distance,
        )
        self._add(f"{key}.npz", arrays.getvalue())

    def _add(self, name: str, content: bytes) -> None:
        # A TarInfo of its own has no owner and time 0, so the bytes repeat.
        member = tarfile.TarInfo(name)
        member.size = len(content)
        self._tar.addfile(member, io.BytesIO(content))

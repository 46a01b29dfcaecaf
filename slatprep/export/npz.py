"""The layout that TRELLIS's dataset of structured latents loads, with the targets added.

The root has ``latents/<model>/<sha256>.npz`` and ``metadata.csv``. By its columns TRELLIS
chooses and finds the files (its ``DATASET.md`` and ``trellis/datasets``).
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from slatprep.errors import ConfigError
from slatprep.export.formats import TARGETS, Exported, ExportOptions, Writer, with_merged
from slatprep.storage.files import file_name
from slatprep.store import Store, StoredAsset

METADATA = "metadata.csv"

_NO_WORDS = frozenset({"na", "null", "none", "true", "false"})
"""Words that pandas, with which TRELLIS reads `METADATA`, does not read as text."""


def writer(store: Store, ids: Sequence[str], options: ExportOptions) -> Writer:
    """Return the writer of TRELLIS's layout; see `slatprep.export.FORMATS`.

    Raises ConfigError if the model's name cannot name a folder.
    """
    model = options.latent_model
    if not model or model != file_name(model):
        raise ConfigError(
            f"latent_model is {model!r}; expected an encoder's name, of letters, digits, . _ and -"
        )
    return Writer(partial(write, model), finish=partial(write_metadata, model))


def write(
    model: str, directory: Path, number: int, assets: Iterable[StoredAsset]
) -> Iterator[Exported]:
    """Write an npz for each asset: TRELLIS's ``coords`` and ``feats``, and the `TARGETS`.

    `model` is the encoder's name, which names the folder; `number` has no use here.
    """
    folder = PurePosixPath("latents", model)
    (directory / folder).mkdir(parents=True, exist_ok=True)
    for asset in assets:
        name = str(folder / f"{_stem(asset.asset_id)}.npz")
        names = with_merged(asset.store, "coords", *TARGETS)
        arrays = {key: getattr(asset, key) for key in names}
        space = asset.store.contents.latents
        arrays |= space.beside_voxels
        # TRELLIS's dataset standardises the latents that it reads.
        arrays["feats"] = space.as_encoded(asset.feats)
        np.savez_compressed(directory / name, **arrays)
        yield Exported(asset, name, len(asset.coords))


def write_metadata(model: str, directory: Path, entries: Sequence[dict[str, Any]]) -> list[str]:
    """Write the table by which TRELLIS's dataset finds the latents; return its name.

    ``aesthetic_score`` is not known, and TRELLIS would leave out an asset without a number. ``inf``
    passes every threshold, and nobody mistakes it for a measured score.
    """
    with (directory / METADATA).open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("sha256", "aesthetic_score", "num_voxels", f"latent_{model}"))
        for entry in entries:
            stem = PurePosixPath(entry["file"]).name.removesuffix(".npz")
            table.writerow((stem, "inf", entry["points"], True))
    return [METADATA]


def _stem(asset_id: str) -> str:
    """Return a name for an asset's file that pandas reads as the same text."""
    name = file_name(asset_id)
    try:
        if name == str(int(name)) and len(name) < 19:  # It survives as int64.
            return name
    except ValueError:
        pass
    try:
        float(name)
    except ValueError:
        if name.casefold() not in _NO_WORDS:
            return name
    return f"%{ord(name[0]):02X}{name[1:]}"

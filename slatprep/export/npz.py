"""npz files of arrays: for TRELLIS's dataset, in shards for WebDataset, and for VoMP's scripts.

TRELLIS's dataset of structured latents loads ``latents/<model>/<sha256>.npz``. It chooses and finds
these files by the columns of ``metadata.csv`` (its ``DATASET.md`` and ``trellis/datasets``). This
export adds the targets to them. A shard is a tar file in which the members with one key are a
sample. The array ``voxel_data`` has the fields of VoMP's dataset and of its predictions
(https://github.com/nv-tlabs/vomp). VoMP's scripts for warp.fem, Newton and libuipc read them at
their own points.
"""

from __future__ import annotations

import csv
import io
import tarfile
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import orjson

from slatprep.errors import ConfigError
from slatprep.export.formats import (
    ROWS,
    TARGETS,
    TRELLIS_ENCODER,
    Exported,
    ExportOptions,
    Points,
    Writer,
    annotated_points,
    describe_columns,
    one_by_one,
)
from slatprep.records import TRELLIS
from slatprep.storage.files import file_name
from slatprep.store import Store, StoredAsset
from slatprep.store.layout import MERGED_COLUMNS

METADATA = "metadata.csv"

_NO_WORDS = frozenset({"na", "null", "none", "true", "false"})
"""Words that pandas, with which TRELLIS reads `METADATA`, does not read as text."""


def trellis(store: Store, ids: Sequence[str], options: ExportOptions) -> Writer:
    """Return the writer of TRELLIS's layout; see `slatprep.export.FORMATS`.

    Raises ConfigError if the model's name cannot name a folder.
    """
    encoder, model = store.contents.latents.encoder, options.latent_model
    if model is None:
        model = TRELLIS_ENCODER if encoder == TRELLIS.encoder else encoder
    if not model or model != file_name(model):
        raise ConfigError(
            f"latent_model is {model!r}; expected an encoder's name, of letters, digits, . _ and -"
        )
    return one_by_one(partial(write_latents, model), finish=partial(write_metadata, model))


def write_latents(model: str, directory: Path, asset: StoredAsset) -> Exported:
    """Write an asset's npz: TRELLIS's ``coords`` and ``feats``, and the `TARGETS`.

    `model` is the encoder's name, which names the folder.
    """
    arrays, contents = _arrays(asset, "coords", *TARGETS), asset.store.contents
    space = contents.latents
    arrays |= space.beside_voxels | contents.beside_labels
    arrays["ranges"] = asset.store.normalization.spans
    # TRELLIS's dataset standardises the latents that it reads.
    arrays["feats"] = space.as_encoded(asset.feats)
    name = str(PurePosixPath("latents", model, f"{_stem(asset.asset_id)}.npz"))
    return _write(directory, name, asset, len(asset.coords), arrays)


def _arrays(asset: StoredAsset, *names: str) -> dict[str, Any]:
    """Return arrays of an asset by name, with the arrays of merged labels if the store has them."""
    merged = MERGED_COLUMNS if asset.store.merges else ()
    return {name: getattr(asset, name) for name in (*names, *merged)}


def _write(
    directory: Path, name: str, asset: StoredAsset, points: int, arrays: dict[str, Any]
) -> Exported:
    """Write arrays of an asset, compressed."""
    (directory / name).parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(directory / name, **arrays)
    return Exported(asset, name, points)


def write_metadata(model: str, directory: Path, entries: Sequence[dict[str, Any]]) -> list[str]:
    """Write the table by which TRELLIS's dataset finds the latents; return its name.

    ``aesthetic_score`` is not known, and TRELLIS would leave out an asset without a number. ``inf``
    passes every threshold, and nobody mistakes it for a measured score.
    """
    with (directory / METADATA).open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        more = ("confidence", "expected_accuracy")
        table.writerow(("sha256", "aesthetic_score", "num_voxels", f"latent_{model}", *more))
        for entry in entries:
            stem = PurePosixPath(entry["file"]).name.removesuffix(".npz")
            told = (entry[name] for name in more)
            table.writerow((stem, "inf", entry["points"], True, *told))
    return [METADATA]


def _stem(asset_id: str) -> str:
    """Return a name for an asset's file that pandas reads as the same text."""
    name = file_name(asset_id)
    whole = name.removeprefix("-").isdecimal()
    if whole and len(name) < 19 and name == str(int(name)):  # It survives as int64.
        return name
    encoded = f"%{ord(name[0]):02X}{name[1:]}"
    try:
        float(name)
    except ValueError:
        return encoded if name.casefold() in _NO_WORDS else name
    return encoded


def webdataset(store: Store, ids: Sequence[str], options: ExportOptions) -> Writer:
    """Return the writer of shards of `options.shard_size` assets; see `slatprep.export.FORMATS`."""
    return Writer(write_shard, batch=options.shard_size)


def write_shard(directory: Path, number: int, assets: Iterable[StoredAsset]) -> Iterator[Exported]:
    """Write shard `number` with ``<key>.json`` and ``<key>.npz`` for each asset.

    The key is the asset's id with dots encoded: for WebDataset a key ends at the first dot.
    """
    shard = f"shard-{number:06d}.tar"
    with tarfile.open(directory / shard, "w") as tar:
        for asset in assets:
            key = file_name(asset.asset_id, dots=False)
            about = {**describe_columns(asset), "transform": asset.transform.tolist()}
            _add(tar, f"{key}.json", orjson.dumps(about))
            arrays = _arrays(asset, *ROWS)
            # Not compressed, since a training loop reads it repeatedly.
            packed = io.BytesIO()
            np.savez(packed, **arrays)
            _add(tar, f"{key}.npz", packed.getvalue())
            yield Exported(asset, shard, len(asset.coords))


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    # A new TarInfo has no owner and time 0, so the bytes are reproducible.
    member = tarfile.TarInfo(name)
    member.size = len(content)
    tar.addfile(member, io.BytesIO(content))


NUMBERS = ("x", "y", "z", "youngs_modulus", "poissons_ratio", "density")
"""The numbers of a voxel: centre in the unit cube, E in Pa, density in kg/m^3."""

FOLDER = "voxels"


def voxel_data(store: Store, ids: Sequence[str], options: ExportOptions) -> Writer:
    """Return the writer of an npz for each asset; see `slatprep.export.FORMATS`."""
    points = options.points or "slat"
    return one_by_one(partial(write_voxels, points), points=points)


def write_voxels(points: Points, directory: Path, asset: StoredAsset) -> Exported:
    """Write ``voxels/<id>_with_materials.npz`` of an asset."""
    there = annotated_points(asset, points)
    modulus, density, ratio = there.solid(asset).T
    names = np.array(asset.store.contents.labels)
    # As wide as VoMP's own, unless a name is longer; cut names could become equal.
    segment = "segment_id", np.promote_types("<U32", names.dtype)
    columns = [*there.in_slat.T, modulus, ratio, density, names[there.material]]
    rows = np.rec.fromarrays(columns, np.dtype([*((name, "<f4") for name in NUMBERS), segment]))
    name = f"{FOLDER}/{file_name(asset.asset_id)}_with_materials.npz"
    return _write(directory, name, asset, len(rows), {"voxel_data": rows})

"""Write source files in each of their forms, and damage their bytes."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass

import numpy as np

Rng = np.random.Generator


@dataclass(frozen=True)
class Form:
    """A format: how its demo is made, and which file of an asset is damaged."""

    role: str
    recipe: dict[str, str]
    rebuilt: bool = False


FORMS = {
    "raw grid (npy)": Form("grid", {}),
    "prediction (npy, 11 channels)": Form("grid", {"source": "pixie-predictions"}),
    "prediction (npy, 4 channels)": Form("grid", {"source": "pixie-prediction-ids"}),
    "mask (npy)": Form("mask", {}),
    "bounds (npz)": Form("bounds", {}),
    "SLAT (npz)": Form("slat", {"slat_form": "npz"}),
    "SLAT (npz, batch column)": Form("slat", {"slat_form": "npz-batch"}),
    "SLAT (sound npz of damaged arrays)": Form("slat", {"slat_form": "npz"}, rebuilt=True),
    "SLAT (HDF5)": Form("slat", {"slat_form": "hdf5"}),
    "SLAT (HDF5, gzip, shuffle, fletcher32)": Form("slat", {"slat_form": "hdf5-packed"}),
    "SLAT (HDF5, a group an asset)": Form("slat", {"slat_form": "hdf5-groups"}),
    "map (csv)": Form("map", {}),
    "metadata (csv)": Form("metadata", {"slat_names": "sha256"}),
    "categories (json)": Form("categories", {}),
}


def damage(data: bytes, rng: Rng, head: int = 160) -> bytes:
    """Damage bytes in one to four places, half of the time near the beginning."""
    for _ in range(rng.integers(1, 5)):
        if not data:
            return data
        within = min(len(data), head) if rng.random() < 0.5 else len(data)
        at = int(rng.integers(within))
        kind = rng.integers(8)
        if kind == 0:
            edit, cut = bytes([data[at] ^ (1 << int(rng.integers(8)))]), 1
        elif kind == 1:
            edit, cut = rng.bytes(int(rng.integers(1, 9))), int(rng.integers(0, 9))
        elif kind == 2:
            return data[:at]
        elif kind == 3:
            edit, cut = bytes(int(rng.integers(1, 64))), int(rng.integers(1, 64))
        elif kind == 4:
            edit, cut = EXTREMES[rng.integers(len(EXTREMES))], 4
        elif kind == 5:
            edit, cut = b"", int(rng.integers(1, 64))
        elif kind == 6:
            start = int(rng.integers(len(data)))
            edit = data[start : start + int(rng.integers(1, 64))]
            cut = len(edit)
        else:
            edit, cut = rng.bytes(2), 2
        data = data[:at] + edit + data[at + cut :]
    return data


EXTREMES = (
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\0\0\0\x80",
    np.float32(np.nan).tobytes(),
    np.float32(np.inf).tobytes(),
    np.float32(-1).tobytes(),
    np.float32(7.5).tobytes(),
    np.float32(1e38).tobytes(),
)


def damage_slat(data: bytes, rng: Rng) -> bytes:
    """Damage the arrays of an npz and put them into a sound archive."""
    file = io.BytesIO()
    method = zipfile.ZIP_DEFLATED if rng.random() < 0.5 else zipfile.ZIP_STORED
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(file, "w", method) as new:
        hit = int(rng.integers(3))
        for number, name in enumerate(old.namelist()):
            content = old.read(name)
            new.writestr(name, damage(content, rng) if hit in (number, 2) else content)
    return file.getvalue()

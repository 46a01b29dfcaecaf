"""Damaged files either read to something valid or raise InputError, and nothing else."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.raw_sources import COORDS, FEATS, npy, pair_of, raw_grid

from slatprep.errors import InputError
from slatprep.readers import read_field, read_latents
from slatprep.records import AssetPair

SETTINGS = settings(max_examples=150, derandomize=True, database=None)

# Where, how many bytes are replaced, and by what: a flip, a cut, an insertion, all of them; or
# all that follows is cut off.
CUT = st.one_of(st.integers(0, 40), st.just(10**9))
EXTREMES = st.sampled_from([b"\0", b"\xff", b"\xff" * 8, b"\0" * 8, b"\xff\xff\xff\x7f"])
EDIT = st.tuples(st.floats(0, 1), CUT, st.one_of(st.binary(max_size=12), EXTREMES))
EDITS = st.lists(EDIT, min_size=1, max_size=6)


def mutate(data: bytes, edits: list[tuple[float, int, bytes]], within: int | None = None) -> bytes:
    for position, cut, insert in edits:
        at = int(position * min(len(data), within or len(data)))
        data = data[:at] + insert + data[at + cut :]
    return data


def savez(save: Callable[..., None]) -> bytes:
    file = io.BytesIO()
    save(file, coords=COORDS, feats=FEATS)
    return file.getvalue()


def hdf5(libver: str, **options: object) -> bytes:
    file = io.BytesIO()
    with h5py.File(file, "w", libver=libver) as holder:
        holder.create_dataset("coords", data=COORDS, **options)
        holder.create_dataset("feats", data=FEATS, **options)
    return file.getvalue()


PACKED = {"compression": "gzip", "shuffle": True, "fletcher32": True, "chunks": (2, 3)}
SLATS = {
    "npz": ("a.npz", savez(np.savez)),
    "compressed npz": ("a.npz", savez(np.savez_compressed)),
    "hdf5": ("a.h5", hdf5("earliest")),
    "new hdf5": ("a.h5", hdf5("latest")),
    "packed hdf5": ("a.h5", hdf5("earliest", **PACKED)),
    "new packed hdf5": ("a.h5", hdf5("latest", **PACKED)),
}
GRID = npy(raw_grid())
MASK = npy(raw_grid()[..., 3] != 7)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], AssetPair]:
    root: Path = tmp_path_factory.mktemp("mutated")
    return lambda slat: pair_of(root, root / slat)


def read_latents_or_refuse(pair: AssetPair) -> bool:
    try:
        latents = read_latents(pair)
    except InputError as error:
        assert error.path.startswith(str(pair.slat))
        return False
    assert (latents.coords.dtype, latents.feats.dtype) == (np.uint8, np.float32)
    assert (latents.coords.shape, latents.feats.shape[1:]) == ((len(latents.feats), 3), (8,))
    assert len(np.unique(latents.coords, axis=0)) == len(latents.coords) > 0
    assert latents.coords.max() < 64
    assert np.isfinite(latents.feats).all()
    return True


@pytest.mark.parametrize("form", SLATS)
@SETTINGS
@example(edits=[])
@given(edits=EDITS)
def test_mutated_slat(pair, form, edits):
    name, data = SLATS[form]
    pair(name).slat.write_bytes(mutate(data, edits))
    assert read_latents_or_refuse(pair(name)) or edits


@pytest.mark.parametrize("compressed", [False, True])
@SETTINGS
@given(edits=EDITS)
def test_mutated_array_in_a_sound_archive(pair, compressed, edits):
    """Checksums stop most mutations of an npz; here the archive is made around the damage."""
    method = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(pair("a.npz").slat, "w", method) as archive:
        archive.writestr("coords.npy", mutate(npy(COORDS), edits))
        archive.writestr("feats.npy", mutate(npy(FEATS), edits[1:]))
    read_latents_or_refuse(pair("a.npz"))


@settings(SETTINGS, max_examples=60)
@given(edits=EDITS, head=st.booleans(), of_mask=st.booleans())
def test_mutated_grid_and_mask(pair, edits, head, of_mask):
    made = pair("a.npz")
    within = 160 if head else None
    made.grid.write_bytes(GRID if of_mask else mutate(GRID, edits, within))
    made.mask.write_bytes(mutate(MASK, edits, within) if of_mask else MASK)
    try:
        field = read_field(made)
    except InputError as error:
        assert error.path in (str(made.grid), str(made.mask))
        return
    assert len(field.voxels) == len(field.material) == len(field.properties) > 0
    assert field.occupancy[tuple(field.voxels.T)].all()
    assert field.material.max() <= 6
    assert np.isfinite(field.properties).all()
    assert (field.properties[:, :2] > 0).all()
    assert ((field.properties[:, 2] >= -1) & (field.properties[:, 2] <= 0.5)).all()

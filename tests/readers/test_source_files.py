"""Files as such: paths that leave, headers that lie, archives that explode, bytes that changed."""

import io
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.memory import less_than
from support.raw_sources import COORDS, FEATS, npy, pair_of, raw_grid

from slatprep.errors import InputError
from slatprep.readers import read_field, read_latents
from slatprep.readers.files import ArraySpec, load_source, npy_array, npz_arrays
from slatprep.records import AssetPair
from slatprep.storage.place import storage_of

ROWS = {"feats": ArraySpec(shapes=((None, 8),), kinds="f")}


def npy_header(text: str, version: int = 1) -> bytes:
    length = struct.pack("<H" if version == 1 else "<I", len(text))
    return b"\x93NUMPY" + bytes([version, 0]) + length + text.encode("latin-1")


def npz_bytes(compression: int = zipfile.ZIP_DEFLATED, **members: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return file.getvalue()


def refused(match: str, read: Callable[..., object], *arguments: object, below: int = 8) -> None:
    """Have `read` raise an error that matches, at less than so many MiB of memory."""
    with less_than(below * 2**20), pytest.raises(InputError, match=match):
        read(*arguments)


def test_paths_that_leave_the_root(tmp_path):
    root = tmp_path / "root"
    (root / "sub").mkdir(parents=True)
    np.save(tmp_path / "outside.npy", COORDS)
    (root / "link.npy").symlink_to(tmp_path / "outside.npy")
    (root / "folder").symlink_to(tmp_path)
    for name in ("../outside.npy", "sub/../../outside.npy", "link.npy", "folder/outside.npy"):
        with pytest.raises(InputError, match="out of its root"):
            load_source(root / name, root, "grid")


def test_paths_that_are_no_file_of_the_root(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "inside").write_bytes(b"x")
    (tmp_path / "link").symlink_to("inside")
    (tmp_path / "torn").symlink_to("gone")
    (tmp_path / "endless").symlink_to("/dev/zero")
    for name, fault in (
        ("folder", "not a regular file"),
        ("pipe", "not a regular file"),
        ("loop", "cannot be opened"),
        ("torn", "is a link that leads nowhere"),
        ("endless", "leads to /d"),
        ("a\0b", "cannot be opened"),
        ("none", "does not exist"),
        ("", "not a regular file"),
    ):
        with pytest.raises(InputError, match=fault):
            load_source(tmp_path / name, tmp_path, "grid")
    with pytest.raises(InputError, match="cannot be opened"):
        storage_of(tmp_path / "folder").locate(tmp_path / "inside")
    assert storage_of(tmp_path).locate(tmp_path / "link")[1] == "link"


def test_file_that_is_too_large_is_not_read(tmp_path):
    with (tmp_path / "big.npy").open("wb") as file:
        file.truncate(2**40)  # sparse: a terabyte that takes no room
    with pytest.raises(InputError, match="larger than 128 MiB"):
        load_source(tmp_path / "big.npy", tmp_path, "grid")


@pytest.mark.parametrize("text", [
    "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 8)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (200000, 8)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 8)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (3.0, 8)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (0, 10**30)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (3, 8)",
    "{'descr': '<f4', 'fortran_order': False}",
    "{'descr': '<f999', 'fortran_order': False, 'shape': (3, 8)}",
    "{'descr': '|V1000000000', 'fortran_order': False, 'shape': (3, 8)}",
    "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (3, 8)}",
    "{'descr': {'a': 1}, 'fortran_order': False, 'shape': (3, 8)}",
    "{'descr': '|O', 'fortran_order': False, 'shape': (3, 8)}",
    "[" * 3000,
    "-" * 4000,
    "(" * 90 + ")" * 90,
    "[]",
    "7",
    "'",
    "\xff\x00",
    "",
])  # fmt: skip
@pytest.mark.parametrize("version", [1, 2])
def test_npy_headers_that_lie(text, version):
    data = npy_header(text, version) + FEATS.tobytes()
    refused(r"^x\.npy: ", npy_array, data, "x.npy", ROWS["feats"])


def test_npz_that_claims_gigabytes_costs_nothing():
    header = b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1) + b" " * 100
    bomb = npz_bytes(feats=header + b" " * 2**26)
    assert len(bomb) < 2**20
    refused(r"x\.npz \[feats\]", npz_arrays, bomb, "x.npz", ROWS)
    header = npy_header("{'descr': '<f4', 'fortran_order': False, 'shape': (335544320, 8)}\n")
    honest = npz_bytes(feats=header + b"\0" * 1000)
    # The same claim in the archive's own directory, so that both agree.
    size = struct.pack("<I", len(header) + 1000)
    claimed = honest.replace(size, struct.pack("<I", 2**32 - 2))
    for data in (honest, claimed):
        refused(r"x\.npz \[feats\].*335544320, 8", npz_arrays, data, "x.npz", ROWS, below=4)


def test_npz_bomb_is_not_inflated_whatever_its_directory_says():
    # 64 MiB of zeros behind the header of a small array.
    bomb = npz_bytes(feats=npy(FEATS) + b"\0" * 2**26)
    refused("announces 96 bytes of data", npz_arrays, bomb, "x.npz", ROWS, below=4)
    real = struct.pack("<I", len(npy(FEATS)) + 2**26)
    lie = bomb.replace(real, struct.pack("<I", len(npy(FEATS))))
    assert lie != bomb
    refused(r"x\.npz \[feats\]: is damaged \(Bad CRC", npz_arrays, lie, "x.npz", ROWS, below=4)


def test_npz_that_numpy_does_not_write_is_refused():
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("feats.npy", npy(FEATS))
        archive.writestr("feats.npy", npy(FEATS))
    for data, said in (
        (npz_bytes(zipfile.ZIP_BZIP2, feats=npy(FEATS)), "uses zip compression"),
        (npz_bytes(zipfile.ZIP_LZMA, feats=npy(FEATS)), "uses zip compression"),
        (file.getvalue(), "has 2 arrays named 'feats'"),
        (npz_bytes(**{f"m{i}": b"" for i in range(300)}), "more than 256 members"),
        (npz_bytes(), "has no array 'feats'"),
        (npy(FEATS), "npz archive: it is one array"),
        (pickle.dumps(FEATS), "npz archive: it looks like a pickle"),
        (npz_bytes(feats=npy(FEATS))[:-40], "npz archive: it begins as one, and may be cut off"),
    ):
        with pytest.raises(InputError, match=said):
            npz_arrays(data, "x.npz", ROWS)


def test_hdf5_that_claims_or_inflates_to_gigabytes_costs_nothing(make_pair):
    pair = make_pair()
    for name, fault, options in (
        ("a.h5", "does not unpack to 96 bytes", {"shape": (3, 8), "chunks": (3, 8)}),
        ("b.h5", "has shape", {"shape": (2**28, 8), "chunks": (2**20, 8)}),
    ):
        path = pair.slat.with_name(name)
        with h5py.File(path, "w") as file:
            file["coords"] = COORDS
            feats = file.create_dataset("feats", dtype="<f4", compression="gzip", **options)
            if name == "a.h5":
                feats.id.write_direct_chunk((0, 0), zlib.compress(b"\0" * 2**24))
        refused(fault, read_latents, replace(pair, slat=path))


def test_a_shape_of_truth_values_is_refused():
    """Python takes True for 1, and numpy makes an array of it that cannot be shaped again."""
    text = "{'descr': '<f4', 'fortran_order': False, 'shape': (True, 8)}"
    data = npy_header(text) + FEATS[:1].tobytes()
    refused(r"has shape \(True, 8\)", npy_array, data, "x.npy", ROWS["feats"])


SETTINGS = settings(max_examples=150, derandomize=True, database=None)

# Where, how many bytes are replaced (all that follow as well), and by what.
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

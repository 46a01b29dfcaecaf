"""Every form of a SLAT, and every fault of one."""

import hashlib
import os
from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.raw_sources import COORDS, FEATS

from slatprep.errors import InputError
from slatprep.readers import read_latents

BATCHED = np.concatenate([np.zeros((3, 1), np.int32), COORDS.astype(np.int32)], axis=1)


def hdf5_pair(pair, group="", **datasets):
    """Write datasets into an HDF5 file, at the top or in a group, and point the pair at it."""
    path = pair.slat.with_name("a.h5")
    with h5py.File(path, "a") as file:
        holder = file.require_group(group) if group else file
        for name, value in datasets.items():
            if isinstance(value, dict):
                holder.create_dataset(name, **value)
            else:
                holder[name] = value
    return replace(pair, slat=path, slat_group=group)


def check(latents):
    assert latents.coords.dtype == np.uint8
    assert latents.feats.dtype == np.float32
    np.testing.assert_array_equal(latents.coords, COORDS)
    np.testing.assert_array_equal(latents.feats, FEATS)


@pytest.mark.parametrize("coords", [COORDS, BATCHED], ids=["(N, 3)", "(N, 4)"])
@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.int64, ">i2"])
def test_npz(make_pair, coords, dtype):
    latents = read_latents(make_pair(coords=coords.astype(dtype)))
    check(latents)
    assert latents.warnings == ()


def test_compressed_and_fortran_ordered_npz(make_pair):
    pair = make_pair()
    np.savez_compressed(
        pair.slat, coords=np.asfortranarray(BATCHED), feats=np.asfortranarray(FEATS), extra="kept"
    )
    check(read_latents(pair))


@pytest.mark.parametrize(
    ("dtype", "warnings"),
    [(np.float16, ()), (">f4", ()), (np.float64, ("feats: float64 rounded to float32",))],
)
def test_feats_of_other_precision(make_pair, dtype, warnings):
    latents = read_latents(make_pair(feats=FEATS.astype(dtype)))
    check(latents)  # eighths are exact in each of these
    assert latents.warnings == warnings


@pytest.mark.parametrize("group", ["", "a", "slats/a"])
@pytest.mark.parametrize("coords", [COORDS, BATCHED], ids=["(N, 3)", "(N, 4)"])
def test_hdf5(make_pair, group, coords):
    check(read_latents(hdf5_pair(make_pair(), group, coords=coords, feats=FEATS)))


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "gzip"},
        {"compression": "gzip", "shuffle": True},
        {"fletcher32": True, "chunks": (2, 5)},
        {"compression": "gzip", "shuffle": True, "fletcher32": True, "chunks": (2, 8)},
        {"chunks": (1, 3)},
    ],
    ids=str,
)
def test_hdf5_chunks_and_filters(make_pair, options):
    feats = {"data": FEATS, **options}
    check(read_latents(hdf5_pair(make_pair(), "a", coords=COORDS, feats=feats)))


def test_sources(make_pair):
    pair = make_pair()
    shared = hdf5_pair(pair, "a", coords=COORDS, feats=FEATS)
    for each in (pair, shared):
        (source,) = read_latents(each).sources
        data = each.slat.read_bytes()
        assert source.role == "slat"
        assert source.path == each.slat.name
        assert source.size == len(data)
        assert source.sha256 == hashlib.sha256(data).hexdigest()


def test_shared_file_is_hashed_again_when_it_changed_in_the_same_tick(make_pair):
    pair = hdf5_pair(make_pair(), "a", coords=COORDS, feats=FEATS)
    before, state = read_latents(pair).sources[0].sha256, pair.slat.stat()
    with h5py.File(pair.slat, "r+") as file:
        file["a/feats"][0, 0] += 1
    os.utime(pair.slat, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert pair.slat.stat().st_size == state.st_size
    assert read_latents(pair).sources[0].sha256 != before


def _set(array, index, value):
    changed = array.copy()
    changed[index] = value
    return changed


BAD_ARRAYS = {
    "coords shape": ({"coords": COORDS[:, :2]}, "shape (3, 2)", "(N <= 262144, 3)"),
    "coords flat": ({"coords": COORDS.ravel()}, "shape (9,)", "(N <= 262144, 4)"),
    "coords float": ({"coords": COORDS.astype(np.float32)}, "dtype <f4", "integer"),
    "coords bool": ({"coords": COORDS > 0}, "dtype |b1", "integer"),
    "feats shape": ({"feats": FEATS[:, :7]}, "shape (3, 7)", "(N <= 262144, 8)"),
    "feats int": ({"feats": FEATS.astype(np.int32)}, "dtype <i4", "floating-point"),
    "lengths": ({"feats": FEATS[:2]}, "3 rows of coords but 2 of feats", "one latent per voxel"),
    "empty": ({"coords": COORDS[:0], "feats": FEATS[:0]}, "SLAT is empty", "at least one voxel"),
    "batch": ({"coords": _set(BATCHED, (2, 0), 1)}, "batch index 1 in row 2", "one asset"),
    "negative": (
        {"coords": _set(BATCHED, (1, 2), -1)},
        "coordinate (63, -1, 2) in row 1 is out of range",
        "0..63",
    ),
    "wraps in uint8": (
        {"coords": _set(BATCHED, (2, 1), 256)},
        "coordinate (256, 63, 63) in row 2 is out of range",
        "0..63",
    ),
    "duplicate": (
        {"coords": _set(COORDS, 2, COORDS[0])},
        "coordinate (0, 0, 0) occurs twice, in rows 0 and 2",
        "once",
    ),
    "infinity": ({"feats": _set(FEATS, (0, 0), -np.inf)}, "feats is -inf in row 0", "finite"),
    "too large": (
        {"feats": _set(FEATS.astype(np.float64), (2, 7), 1e300)},
        "feats is 1e+300 in row 2, channel 7",
        "float32",
    ),
    "too many rows": (
        {"coords": np.zeros((262145, 3), np.uint8)},
        "shape (262145, 3)",
        "N <= 262144",
    ),
}


@pytest.mark.parametrize("form", ["npz", "hdf5", "group"])
@pytest.mark.parametrize("fault", BAD_ARRAYS)
def test_bad_arrays(make_pair, fault, form):
    arrays, what, expected = BAD_ARRAYS[fault]
    arrays = {"coords": COORDS, "feats": FEATS, **arrays}
    pair = make_pair(**arrays)
    if form != "npz":
        pair = hdf5_pair(pair, "a" if form == "group" else "", **arrays)
    with pytest.raises(InputError) as caught:
        read_latents(pair)
    assert caught.value.path.startswith(str(pair.slat))
    assert what in caught.value.fault
    assert expected in caught.value.expected


@pytest.mark.parametrize("missing", ["coords", "feats"])
def test_missing_array(make_pair, missing):
    pair = make_pair()
    arrays = {"coords": COORDS, "feats": FEATS}
    del arrays[missing]
    np.savez(pair.slat, **arrays)
    with pytest.raises(InputError, match=f"0 arrays named '{missing}'"):
        read_latents(pair)
    with pytest.raises(InputError, match=f"has no dataset '{missing}'"):
        read_latents(hdf5_pair(pair, **arrays))


def test_missing_group(make_pair):
    pair = hdf5_pair(make_pair(), "a", coords=COORDS, feats=FEATS)
    with pytest.raises(InputError, match="has no group 'b'"):
        read_latents(replace(pair, slat_group="b"))


def test_npz_that_wants_pickle_is_refused(make_pair):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the pickle was run",))

    pair = make_pair()
    np.savez(pair.slat, coords=COORDS, feats=np.array([Trap()], dtype=object))
    with pytest.raises(InputError, match=r"a\.npz \[feats\].*pickle"):
        read_latents(pair)


def _soft(file, folder):
    file["elsewhere"] = FEATS
    file["feats"] = h5py.SoftLink("/elsewhere")


def _external_link(file, folder):
    file["feats"] = h5py.ExternalLink(str(folder / "secret.h5"), "feats")


def _external_storage(file, folder):
    file.create_dataset("feats", (3, 8), np.float32, external=[(str(folder / "secret.bin"), 0, 96)])


def _virtual(file, folder):
    layout = h5py.VirtualLayout((3, 8), np.float32)
    layout[:] = h5py.VirtualSource(str(folder / "secret.h5"), "feats", (3, 8))
    file.create_virtual_dataset("feats", layout)


@pytest.mark.parametrize(
    ("point", "fault"),
    [
        (_soft, "soft or external link"),
        (_external_link, "soft or external link"),
        (_external_storage, "keeps its values in another file"),
        (_virtual, "virtual dataset"),
    ],
)
def test_hdf5_that_points_elsewhere_is_refused(make_pair, tmp_path, point, fault):
    with h5py.File(tmp_path / "secret.h5", "w") as secret:
        secret["feats"] = FEATS
    (tmp_path / "secret.bin").write_bytes(FEATS.tobytes())
    pair = hdf5_pair(make_pair(), coords=COORDS)
    with h5py.File(pair.slat, "a") as file:
        point(file, tmp_path)
    with pytest.raises(InputError, match=fault):
        read_latents(pair)


def test_hdf5_that_was_never_filled_is_refused(make_pair):
    # HDF5 would read zeros, which are latents as good as any.
    for number, chunks in enumerate([None, (2, 8)]):
        pair = hdf5_pair(
            make_pair(),
            f"g{number}",
            coords=COORDS,
            feats={"shape": (3, 8), "dtype": np.float32, "chunks": chunks},
        )
        with pytest.raises(InputError, match=r"holds 0 of 96 bytes|its 0 chunks are not the 2"):
            read_latents(pair)


def test_hdf5_filters_that_are_not_known_are_refused(make_pair):
    pair = hdf5_pair(make_pair(), coords=COORDS, feats={"data": FEATS, "compression": "lzf"})
    with pytest.raises(InputError, match=r"\[feats\]: uses HDF5 filters \[32000\].*h5repack"):
        read_latents(pair)


def test_hdf5_chunk_that_fails_its_checksum_is_refused(make_pair):
    feats = {"data": FEATS, "fletcher32": True, "chunks": (3, 8)}
    pair = hdf5_pair(make_pair(), coords=COORDS, feats=feats)
    data = bytearray(pair.slat.read_bytes())
    data[data.index(FEATS.tobytes())] ^= 1
    pair.slat.write_bytes(data)
    with pytest.raises(InputError, match="checksum"):
        read_latents(pair)

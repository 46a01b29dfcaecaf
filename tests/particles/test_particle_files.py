"""Particles from numpy files, those of strangers included."""

import io
import zipfile

import numpy as np
import pytest

from slatprep.errors import InputError
from slatprep.particles.read import read_particles

POSITIONS = np.arange(12, dtype=np.float32).reshape(4, 3) / 100


def test_npy_and_npz_hold_the_same_particles(tmp_path):
    np.save(tmp_path / "a.npy", POSITIONS)
    np.savez(tmp_path / "b.npz", xyz=POSITIONS, weight=np.ones(4))
    for name in ("a.npy", "b.npz"):
        read = read_particles(tmp_path / name)
        np.testing.assert_array_equal(read.positions, POSITIONS.astype(np.float64))
        assert (read.axes, read.foreign) == ("slat", "")


def test_an_archive_that_claims_more_particles_than_there_can_be_is_refused(tmp_path):
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f8", "fortran_order": False, "shape": (10**10, 3)}
    )
    with zipfile.ZipFile(tmp_path / "p.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xyz.npy", head.getvalue() + bytes(10**6))
    with pytest.raises(InputError, match=r"\(10000000000, 3\); expected shape"):
        read_particles(tmp_path / "p.npz")


@pytest.mark.parametrize(
    ("arrays", "what"),
    [
        ({"other": POSITIONS}, "has no particles; expected one array named positions or"),
        ({"xyz": POSITIONS, "points": POSITIONS}, "has points and xyz; expected one array"),
        ({"xyz": POSITIONS[:, :2]}, r"has shape \(4, 2\)"),
        ({"xyz": np.array([["a"] * 3])}, "has dtype <U1"),
    ],
)
def test_arrays_that_are_no_particles_are_named(tmp_path, arrays, what):
    np.savez(tmp_path / "p.npz", **arrays)
    with pytest.raises(InputError, match=what):
        read_particles(tmp_path / "p.npz")

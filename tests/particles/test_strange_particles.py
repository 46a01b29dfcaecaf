"""Files of particles, strangers' too: nothing huge is set aside, and what is wrong is said."""

import io
import os
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from support.memory import less_than

from slatprep.errors import InputError
from slatprep.particles.read import read_particles

POSITIONS = np.arange(12, dtype=np.float32).reshape(4, 3) / 100
XYZ = "property float x\nproperty float y\nproperty float z\n"


def _ply(path: Path, elements: str, body: bytes, form: str = "binary_little_endian") -> Path:
    path.write_bytes(f"ply\nformat {form} 1.0\n{elements}end_header\n".encode() + body)
    return path


def refused(file: Path, said: str, most: float = 100e6) -> None:
    """Hold that a file is refused in words, with fewer bytes set aside."""
    with less_than(most), pytest.raises(InputError, match=said):
        read_particles(file)


def test_lists_are_no_fault_beside_the_coordinates_alone(tmp_path):
    body = struct.pack("<3fB2f", 0.1, 0.2, 0.3, 2, 1, 1)
    elements = f"element vertex 1\n{XYZ}property list uchar float w\n"
    assert read_particles(_ply(tmp_path / "p.ply", elements, body)).positions.shape == (1, 3)
    lists = elements.replace("float x", "list uchar float x")
    refused(_ply(tmp_path / "p.ply", lists, body), "list")


@pytest.mark.parametrize("rows", ["10000000000", "9" * 30])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("element", ["vertex", "face"])
def test_more_rows_than_bytes_are_refused_before_they_are_set_aside(element, form, rows, tmp_path):
    elements = f"element {element} {rows}\n{XYZ}property list uchar double w\n"
    file = _ply(tmp_path / "p.ply", elements, b"0 0 0 0\n", form)
    refused(file, "announces more rows than it has")


LONG = f"comment {'c' * 70_000}\n"
JUNK = {
    "underscores": "element junk 300_000_000\nproperty list uchar int q\n",
    "a sign": "element junk +1000000000\nproperty uchar q\n",
    "behind the vertices": f"element vertex 1\nproperty float x\n{LONG}"
    "element junk 1000000000\nproperty list uchar int q\n",
    "long comments": f"{LONG}element junk 1000000000\nproperty uchar q\n",
    "wide rows": "element junk 40\nproperty double q\n",
    "below 0": "element junk -1\nproperty double q\n",
}


@pytest.mark.parametrize("elements", JUNK.values(), ids=JUNK)
def test_a_small_file_takes_little_memory_whatever_it_announces(elements, tmp_path):
    file = _ply(tmp_path / "p.ply", elements + f"element vertex 1\n{XYZ}", b"\0" * 100)
    refused(file, r"p\.ply: .*(more rows than it has|rows below 0|fields x, y and z)", 20e6)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_millions_of_short_rows_are_refused_before_they_are_read(form, tmp_path):
    rows = 3_000_000
    body = b"0\n" * rows if form == "ascii" else b"\0" * rows
    elements = f"element junk {rows}\nproperty list uchar int q\nelement vertex 0\n{XYZ}"
    file = _ply(tmp_path / "p.ply", elements, body, form)
    refused(file, r"values of text or with lists .* at most 1,000,000", 50e6)


@pytest.mark.parametrize(
    ("elements", "body", "said"),
    [
        ("comment end_header\nelement junk 1000000000\nproperty list uchar int q\n", b"0 0 0\n",
         "more rows than it has"),
        ("element vertex 1\nproperty list uint float w\n", b"1 " * 5_000_000, "a line of 65,536"),
        (f"element vertex 300000\n{XYZ}property float a\n", b"0\n" * 1_200_000, "1,000,000"),
    ],
    ids=["a header behind a comment", "a line without end", "many short values"],
)  # fmt: skip
def test_text_costs_no_more_than_its_size(elements, body, said, tmp_path):
    elements = elements.replace("vertex 1\n", f"vertex 1\n{XYZ}")
    refused(_ply(tmp_path / "p.ply", elements, body, "ascii"), said, 30e6)


def test_a_large_file_is_refused_without_a_copy(tmp_path):
    rows = np.zeros((2_000_000, 3), dtype="<f4")
    rows[-1, 1] = np.nan
    file = _ply(tmp_path / "p.ply", f"element vertex {len(rows)}\n{XYZ}", rows.tobytes())
    refused(file, r"particle 1999999 lies at \[0.0, nan, 0.0\]", 1.5 * rows.nbytes)


def test_a_position_that_no_float32_holds_is_refused(tmp_path):
    np.save(tmp_path / "far.npy", np.array([[0.0, 0.1, 0.2], [0.0, -1e39, 0.2]]))
    refused(tmp_path / "far.npy", r"particle 1 lies at \[0.0, -1e\+39, 0.2\]", 1e6)


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian"])
def test_elements_before_the_vertices_are_stepped_over(form, tmp_path):
    order = "<" if form == "binary_little_endian" else ">"
    body = struct.pack(f"{order}3h", 7, 8, 9) + struct.pack(f"{order}6f", *range(6))
    elements = f"element junk 3\nproperty short q\nelement vertex 2\n{XYZ}"
    read = read_particles(_ply(tmp_path / "p.ply", elements, body, form))
    np.testing.assert_array_equal(read.positions, np.arange(6.0).reshape(2, 3))


def test_faces_behind_the_vertices_are_counted_and_left_unread(tmp_path):
    faces = "element face 300000\nproperty list uchar int vertex_indices\n"
    row = struct.pack("<3f", 0.1, 0.2, 0.3)
    body = row + struct.pack("<B3i", 3, 0, 0, 0) * 300_000
    file = _ply(tmp_path / "p.ply", f"element vertex 1\n{XYZ}{faces}", body)
    assert read_particles(file).positions.shape == (1, 3)
    torn = _ply(tmp_path / "torn.ply", f"element vertex 1\n{XYZ}{faces}", row + b"torn")
    refused(torn, "announces more rows than it has")


@pytest.mark.parametrize(("content", "said"), [
    (b"", "is no readable PLY with vertices"),
    (b"ply\n", "is no readable PLY with vertices"),
    (b"\0" * 2**21, "is no readable PLY with vertices"),
    (b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "is no readable PLY with vertices"),
    (f"ply\nformat ascii 1.0\nelement vertex 0\n{XYZ}end_header\n".encode(), "no particles"),
])  # fmt: skip
def test_a_file_without_particles_is_refused(content, said, tmp_path):
    (tmp_path / "p.ply").write_bytes(content)
    refused(tmp_path / "p.ply", said)


@pytest.mark.parametrize("name", ["p.ply", "p.npy"])
def test_a_pipe_is_not_waited_for(name, tmp_path):
    os.mkfifo(tmp_path / name)
    refused(tmp_path / name, "no regular file")


def test_an_archive_that_claims_more_particles_than_there_can_be_is_refused(tmp_path):
    head, claim = io.BytesIO(), {"descr": "<f8", "fortran_order": False, "shape": (10**10, 3)}
    np.lib.format.write_array_header_1_0(head, claim)
    with zipfile.ZipFile(tmp_path / "p.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xyz.npy", head.getvalue() + bytes(10**6))
    refused(tmp_path / "p.npz", r"\(10000000000, 3\); expected shape")


@pytest.mark.parametrize(("arrays", "what"), [
    ({"other": POSITIONS}, "has no particles; expected one array named positions or"),
    ({"xyz": POSITIONS, "points": POSITIONS}, "has points and xyz; expected one array"),
    ({"xyz": POSITIONS[:, :2]}, r"has shape \(4, 2\)"),
    ({"xyz": np.array([["a"] * 3])}, "has dtype <U1"),
])  # fmt: skip
def test_arrays_that_are_no_particles_are_named(tmp_path, arrays, what):
    np.savez(tmp_path / "p.npz", **arrays)
    refused(tmp_path / "p.npz", what)

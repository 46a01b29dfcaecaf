"""PLYs of strangers: nothing huge is set aside, and what is wrong is said."""

from __future__ import annotations

import os
import struct
import tracemalloc
from pathlib import Path

import pytest

from slatprep.errors import InputError
from slatprep.particles.read import read_particles

XYZ = "property float x\nproperty float y\nproperty float z\n"


def _ply(path: Path, elements: str, body: bytes, form: str = "binary_little_endian") -> Path:
    path.write_bytes(f"ply\nformat {form} 1.0\n{elements}end_header\n".encode() + body)
    return path


def test_a_list_in_place_of_a_coordinate_is_named(tmp_path: Path) -> None:
    elements = f"element vertex 1\n{XYZ.replace('float x', 'list uchar float x')}"
    file = _ply(tmp_path / "p.ply", elements, struct.pack("<B5f", 3, 1, 2, 3, 0, 0))
    with pytest.raises(InputError, match="list"):
        read_particles(file)


def test_lists_beside_the_coordinates_are_no_fault(tmp_path: Path) -> None:
    body = struct.pack("<3fB2f", 0.1, 0.2, 0.3, 2, 1, 1)
    elements = f"element vertex 1\n{XYZ}property list uchar float w\n"
    read = read_particles(_ply(tmp_path / "p.ply", elements, body))
    assert read.positions.shape == (1, 3)


@pytest.mark.parametrize("rows", ["10000000000", "9" * 30])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("element", ["vertex", "face"])
def test_more_rows_than_bytes_are_refused_before_anything_is_set_aside(
    element: str, form: str, rows: str, tmp_path: Path
) -> None:
    elements = f"element {element} {rows}\n{XYZ}property list uchar double w\n"
    with pytest.raises(InputError, match="announces more rows than it has"):
        read_particles(_ply(tmp_path / "p.ply", elements, b"0 0 0 0\n", form))


@pytest.mark.parametrize(
    "elements",
    [
        "element junk 300_000_000\nproperty list uchar int q\n",
        "element junk +1000000000\nproperty uchar q\n",
        "element vertex 1\nproperty float x\ncomment " + "c" * 70_000 + "\n"
        "element junk 1000000000\nproperty list uchar int q\n",
        "comment " + "c" * 70_000 + "\nelement junk 1000000000\nproperty uchar q\n",
        "element junk 40\nproperty double q\n",
        "element junk -1\nproperty double q\n",
    ],
    ids=["underscores", "a sign", "behind the vertices", "long comments", "wide rows", "below 0"],
)
def test_a_small_file_takes_little_memory_whatever_it_announces(
    elements: str, tmp_path: Path
) -> None:
    file = _ply(tmp_path / "p.ply", elements + f"element vertex 1\n{XYZ}", b"\0" * 100)
    tracemalloc.start()
    try:
        with pytest.raises(
            InputError, match=r"p\.ply: .*(more rows than it has|fields x, y and z)"
        ):
            read_particles(file)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_millions_of_short_rows_are_refused_before_they_are_read(form: str, tmp_path: Path) -> None:
    rows = 3_000_000
    body = b"0\n" * rows if form == "ascii" else b"\0" * rows
    elements = f"element junk {rows}\nproperty list uchar int q\nelement vertex 0\n{XYZ}"
    file = _ply(tmp_path / "p.ply", elements, body, form)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="rows of text or lists, and at most 200,000"):
            read_particles(file)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_faces_behind_the_vertices_are_counted_and_left_unread(tmp_path: Path) -> None:
    faces = "element face 300000\nproperty list uchar int vertex_indices\n"
    row = struct.pack("<3f", 0.1, 0.2, 0.3)
    body = row + struct.pack("<B3i", 3, 0, 0, 0) * 300_000
    file = _ply(tmp_path / "p.ply", f"element vertex 1\n{XYZ}{faces}", body)
    assert read_particles(file).positions.shape == (1, 3)
    torn = _ply(tmp_path / "torn.ply", f"element vertex 1\n{XYZ}{faces}", row + b"torn")
    with pytest.raises(InputError, match="announces more rows than it has"):
        read_particles(torn)


@pytest.mark.parametrize("content", [b"", b"ply\n", b"\0" * 2**21])
def test_a_header_without_end_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "p.ply").write_bytes(content)
    with pytest.raises(InputError, match="is no readable PLY with vertices"):
        read_particles(tmp_path / "p.ply")


@pytest.mark.parametrize("name", ["p.ply", "p.npy"])
def test_a_pipe_is_not_waited_for(name: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="no regular file"):
        read_particles(tmp_path / name)


@pytest.mark.parametrize("shape", ["(10000000000000, 3)", "(-5, 3)", "(5, 3)"])
def test_an_npy_that_claims_more_than_it_holds_is_refused(shape: str, tmp_path: Path) -> None:
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    content = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + b"1234"
    (tmp_path / "p.npy").write_bytes(content)
    with pytest.raises(InputError, match=r"p\.npy: "):
        read_particles(tmp_path / "p.npy")

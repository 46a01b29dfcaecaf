"""PLYs of strangers: nothing huge is set aside, and what is wrong is said."""

from __future__ import annotations

import os
import struct
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

"""Arrays in one file come back as they were, or not at all."""

import struct
from pathlib import Path

import google_crc32c
import numpy as np
import orjson
import pytest

from slatprep.errors import StoreError
from slatprep.storage.arrays import ArrayFile, write_arrays

ARRAYS = {
    "rows": np.arange(12, dtype=np.float32).reshape(4, 3),
    "columns": np.asfortranarray(np.arange(12.0).reshape(4, 3)),
    "every other": np.arange(10, dtype=np.uint8)[::2],
    "mask": np.array([True, False]),
    "words": np.array([("density", "kg/m\N{SUPERSCRIPT THREE}")]),
    "one": np.array(7),
    "none": np.empty((0, 3), dtype=np.int16),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with (tmp_path / "a.arrays").open("wb") as file:
        write_arrays(file, ARRAYS)
    return tmp_path / "a.arrays"


def test_arrays_come_back_as_they_were(path):
    with path.open("rb") as file:
        read = ArrayFile(file)
        assert list(read) == list(ARRAYS)
        for name in reversed(ARRAYS):
            assert read[name].dtype == ARRAYS[name].dtype
            assert read[name].flags.writeable
            np.testing.assert_array_equal(read[name], ARRAYS[name])
        with pytest.raises(KeyError):
            read["another"]


def test_no_flipped_bit_and_no_lost_end_is_passed_over(path):
    whole = path.read_bytes()
    for place in range(len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        with path.open("rb") as file, pytest.raises(StoreError, match="damaged"):
            dict(ArrayFile(file))
        path.write_bytes(whole[:place])
        with path.open("rb") as file, pytest.raises(StoreError, match="damaged"):
            dict(ArrayFile(file))


@pytest.mark.parametrize("entry", [
    1, ["<f4", [1], 0], [None, [1], 0, 0], ["|O", [1], 0, 0], ["V8", [1], 0, 0],
    [[["x", "|O"]], [1], 0, 0], ["no type", [1], 0, 0], ["<U0", [1], 0, 0], ["<f4", 1, 0, 0],
    ["<f4", ["1"], 0, 0], ["<f4", [-1, -1], 0, 0], ["<f4", [2.0], 0, 0],
    ["<f4", [2**40, 2**40], 0, 0], ["<f4", [2**36], 0, 0], ["<f4", [0, 2**63], 0, 0],
    ["<f4", [1] * 99, 0, 0], ["<f4", [1], -30, 0], ["<f4", [1], 2**62, 0], ["<f4", [1], "0", 0],
    b"[]", b'"rows"', b"{", b"", b"\xff",
])  # fmt: skip
def test_headers_that_nobody_wrote_are_refused(tmp_path, entry):
    text = entry if isinstance(entry, bytes) else orjson.dumps({"a": entry})
    start = struct.pack("<8sII", b"SLATARR1", len(text), google_crc32c.value(text))
    path = tmp_path / "a.arrays"
    path.write_bytes(start + text + bytes(64))
    with path.open("rb") as file, pytest.raises(StoreError, match="damaged"):
        dict(ArrayFile(file))

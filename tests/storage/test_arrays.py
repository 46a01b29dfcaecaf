"""Arrays in one file come back as they were, and members of an archive are found in few reads."""

import io
import random
import struct
from pathlib import Path

import google_crc32c
import numpy as np
import orjson
import pytest
from support.published import SparseArchive

from slatprep.errors import StoreError
from slatprep.storage.archives import Archive
from slatprep.storage.arrays import ArrayFile, write_arrays
from slatprep.storage.tar import ReadAhead, entries

ARRAYS = {
    "rows": np.arange(12, dtype=np.float32).reshape(4, 3),
    "columns": np.asfortranarray(np.arange(12.0).reshape(4, 3)),
    "every other": np.arange(10, dtype=np.uint8)[::2],
    "mask": np.array([True, False]),
    "words": np.array([("density", "kg/m\N{SUPERSCRIPT THREE}")]),
    "one": np.array(7),
    "none": np.empty((0, 3), dtype=np.int16),
}


def test_arrays_come_back_as_they_were(tmp_path):
    with (tmp_path / "a.arrays").open("xb") as file:
        write_arrays(file, ARRAYS)
    with (tmp_path / "a.arrays").open("rb") as file:
        read = ArrayFile(file)
        assert list(read) == list(ARRAYS)
        for name in reversed(ARRAYS):
            assert read[name].dtype == ARRAYS[name].dtype and read[name].flags.writeable
            np.testing.assert_array_equal(read[name], ARRAYS[name])
        with pytest.raises(KeyError):
            read["another"]


def refused(content: bytes) -> None:
    with pytest.raises(StoreError, match="damaged"):
        dict(ArrayFile(io.BytesIO(content)))


def test_no_flipped_bit_and_no_lost_end_is_passed_over():
    file = io.BytesIO()
    write_arrays(file, ARRAYS)
    whole = file.getvalue()
    for place in range(len(whole)):
        refused(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        refused(whole[:place])


@pytest.mark.parametrize("entry", [
    1, ["<f4", [1], 0], [None, [1], 0, 0], ["|O", [1], 0, 0], ["V8", [1], 0, 0],
    [[["x", "|O"]], [1], 0, 0], ["no type", [1], 0, 0], ["<U0", [1], 0, 0], ["<f4", 1, 0, 0],
    ["<f4", ["1"], 0, 0], ["<f4", [-1, -1], 0, 0], ["<f4", [2.0], 0, 0],
    ["<f4", [2**40, 2**40], 0, 0], ["<f4", [2**36], 0, 0], ["<f4", [0, 2**63], 0, 0],
    ["<f4", [1] * 99, 0, 0], ["<f4", [1], -30, 0], ["<f4", [1], 2**62, 0], ["<f4", [1], "0", 0],
    b"[]", b'"rows"', b"{", b"", b"\xff",
])  # fmt: skip
def test_headers_that_nobody_wrote_are_refused(entry):
    text = entry if isinstance(entry, bytes) else orjson.dumps({"a": entry})
    start = struct.pack("<8sII", b"SLATARR1", len(text), google_crc32c.value(text))
    refused(start + text + bytes(64))


WANTED = ("*/sample_*/material_grid.npy", "*/clip_features_mask.npy", "*/clip_features.npz")
ARCHIVE = Archive(Path("tree.tar"), "", 0, wanted=WANTED)


def objects(count: int, frame: int, spread: float, rng: random.Random) -> list[tuple[str, int]]:
    """Return names and sizes of 12 objects with so many frames, which differ by the spread."""
    files = []
    for number in range(12):
        name = f"{number:032x}"
        own = frame * rng.uniform(1 - spread, 1 + spread)
        videos = f"{name}/sample_0/gs_sim_gridsize_64_output"
        frames = [
            (f"{videos}/{k:04d}.png", int(own * rng.uniform(1 - spread, 1 + spread)))
            for k in range(int(count * rng.uniform(1 - spread, 1 + spread)))
        ]
        frames += [(f"{videos}/output.gif", 1_500_000), (f"{videos}/output.mp4", 200_000)]
        beside = [
            (f"{name}/clip_features.npz", 1000),
            (f"{name}/clip_features_features.npy", 402_653_312),
            (f"{name}/clip_features_mask.npy", 1_048_704),
        ]
        grid = [(f"{name}/sample_0/material_grid.npy", 4_194_432)]
        if rng.random() < 0.5:  # A walk is in the order of the disk, files before folders or not.
            rng.shuffle(frames)
            files += [*beside, *grid, *frames]
        else:
            files += [*beside[:1], *frames, *grid, *beside[1:]]
    return files


def index(files: list[tuple[str, int]]) -> tuple[list[str], SparseArchive]:
    archive = SparseArchive(files)
    found = entries(ReadAhead(archive, remote=True), archive.size, needed=ARCHIVE.may_hold)
    return [entry.name for entry, _ in found if entry], archive


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("spread", [0.0, 0.1, 0.6])
@pytest.mark.parametrize(
    ("count", "frame"),
    [(0, 1), (2, 9_000), (25, 20_000), (100, 60_000), (125, 120_000), (600, 30_000), (60, 900_000)],
)
def test_all_that_is_needed_is_found(count, frame, spread, seed):
    files = objects(count, frame, spread, random.Random(seed))
    names, archive = index(files)
    wanted = [name for name, _ in files if ARCHIVE.is_wanted(name)]
    assert [name for name in names if ARCHIVE.is_wanted(name)] == wanted
    assert archive.bytes < 0.015 * archive.size + 2**23
    if frame < 250_000:
        assert archive.requests < 12 * 25


def test_folder_that_may_hold_what_is_needed_is_read_file_by_file():
    files = [(f"a/sample_{k // 50}/{k}.png", 120_000) for k in range(200)]
    files += [(f"a/{k}.png", 120_000) for k in range(100)]
    files.insert(130, ("a/sample_2/material_grid.npy", 4_194_432))
    names, _ = index(files)
    assert names == [name for name, _ in files]


def test_a_copy_of_the_folder_further_on_hides_nothing():
    first = [(f"a/sample_0/frames/{k:04d}.png", 50_000) for k in range(100)]
    files = [("big.bin", 10**9), *first, ("a/clip_features_mask.npy", 1_048_704)]
    files += [("big.bin", 402_653_312), ("a/sample_0/material_grid.npy", 4_194_432), *first]
    names, _ = index(files)
    assert {"a/clip_features_mask.npy", "a/sample_0/material_grid.npy"} <= set(names)

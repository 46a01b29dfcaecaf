"""Measure how much of PixieVerse a build reads from a hub until it has a verified store.

    python benchmarks/published.py FOLDER [--objects 12] [--frames 100] [--latency 0.1]

Writes archives by class as Pixie's code does, at true size but sparse, and serves them like
the hub, with each answer delayed by the latency. Builds a store by one command from the dataset's
name, verifies it, and builds it again. Prints requests and bytes, and whether the store equals
the stores of the unpacked folder and of the archives on the disk. Then prints the cost of an
archive's index, by number and size of an object's frames.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import checkout  # noqa: F401 - says where the tests' support lies
import numpy as np
from support.published import CLASSES, SparseArchive
from support.published_hub import PublishedHub
from support.raw_sources import npy
from support.synthetic import Dataset, make_asset
from support.trees import tree

from slatprep.parameters import PixieverseSource
from slatprep.readers.published import wanted_members
from slatprep.storage.archives import Archive
from slatprep.storage.files import LocalFile
from slatprep.storage.tar import ReadAhead, entries

NAME = "vlongle/pixieverse"
CUBE = 64**3

FRAMES = ((0, 0), (25, 20_000), (100, 20_000), (100, 60_000), (125, 120_000), (125, 250_000),
          (600, 30_000), (125, 600_000), (300, 1_500_000))  # fmt: skip
"""Numbers of frames of an object, and their bytes, of which the index is measured."""


def members(name: str, grid: np.ndarray, frames: int, frame: int) -> list[tuple[str, bytes | int]]:
    """Return the files of an object in the order of a walk; a number stands for so many bytes."""
    mask = npy((grid[..., 3] != 7).astype(np.float32))
    bounds = io.BytesIO()
    np.savez(bounds, min_bounds=(-0.5,) * 3, max_bounds=(0.5,) * 3, voxel_size=1 / 64)
    videos = f"{name}/sample_0/gs_sim_gridsize_64_output"
    rng = np.random.default_rng(int(name, 16))
    sizes = (frame * rng.uniform(0.6, 1.4) * rng.uniform(0.6, 1.4, frames)).astype(int).tolist()
    return [
        (f"{name}/clip_features.npz", bounds.getvalue()),
        (f"{name}/clip_features_alphas.npy", 128 + 4 * CUBE),
        (f"{name}/clip_features_features.npy", 128 + 2 * 768 * CUBE),
        (f"{name}/clip_features_mask.npy", mask),
        (f"{name}/clip_features_pc.ply", 900_000),
        (f"{name}/clip_features_rgb.npy", 128 + 12 * CUBE),
        *((f"{videos}/{number:04d}.png", size) for number, size in enumerate(sizes)),
        (f"{videos}/output.gif", 1_500_000),
        (f"{videos}/output.mp4", 200_000),
        (f"{name}/sample_0/material_grid.npy", npy(grid)),
    ]


def make(folder: Path, objects: int, frames: int, frame: int) -> tuple[int, int]:
    """Write archives, needed files unpacked and SLATs; return bytes of archives and of those."""
    dataset, archives = Dataset(folder), folder / "hub" / "archives" / "render_outputs"
    archives.mkdir(parents=True)
    names, needed = [f"{number:032x}" for number in range(objects)], 0
    for number, category in enumerate(CLASSES):
        with (archives / f"{category}.tar").open("wb") as file:
            for k in range(number, objects, len(CLASSES)):
                asset = make_asset(k)
                dataset.write_slat(f"{names[k]}.npz", asset.coords, asset.feats)
                for name, data in members(names[k], asset.grid, frames, frame):
                    header = tarfile.TarInfo(name)
                    header.size = data if isinstance(data, int) else len(data)
                    file.write(header.tobuf())
                    end = file.tell() + header.size + -header.size % 512
                    if isinstance(data, bytes):
                        file.write(data)
                        path = folder / "render_outputs" / name
                        path.parent.mkdir(parents=True, exist_ok=True)
                        path.write_bytes(data)
                        needed += len(data)
                    file.seek(end)
            file.write(bytes(10_240))
    entries = {name: {"obj_class": CLASSES[k % len(CLASSES)]} for k, name in enumerate(names)}
    (folder / "classes.json").write_text(json.dumps(entries))
    return sum(path.stat().st_size for path in archives.iterdir()), needed


def run(*arguments: str | Path, **environment: str) -> float:
    """Run slatprep; return seconds."""
    begin = time.perf_counter()
    command = [sys.executable, "-m", "slatprep", *map(str, arguments), "--quiet"]
    subprocess.run(command, env=os.environ | environment, check=True)
    return time.perf_counter() - begin


def local_bytes(folder: Path, cache: Path) -> int:
    """Build from the archives on the disk; return the bytes that were read of them."""
    from slatprep.parameters.files import load_parameters
    from slatprep.pipeline.dataset import build_store

    own, count = LocalFile.pread, 0

    def pread(file: LocalFile, length: int, offset: int) -> bytes:
        nonlocal count
        data = own(file, length, offset)
        if ".tar" in str(Path(f"/proc/self/fd/{file.fileno()}").readlink()):
            count += len(data)
        return data

    LocalFile.pread = pread  # type: ignore[method-assign]
    os.environ["SLATPREP_CACHE"] = str(cache)
    roots = {"pixieverse": {"root": folder / "hub"}, "slat": {"root": folder / "slat"}}
    build_store(load_parameters(None, roots), folder / "local.zarr")
    LocalFile.pread = own  # type: ignore[method-assign]
    return count


def index_of(objects: int, frames: int, frame: int) -> str:
    """Read the headers of an archive; return what that took, as a row of a table."""
    grid = np.full((64, 64, 64, 4), 7, dtype=np.float32)
    listed = [
        (name, data if isinstance(data, int) else len(data))
        for number in range(objects)
        for name, data in members(f"{number:032x}", grid, frames, frame)
    ]
    file = SparseArchive(listed)
    wanted = wanted_members(PixieverseSource(Path()))
    archive = Archive(Path("tree.tar"), "", file.size, wanted=wanted)
    found = entries(ReadAhead(file, remote=True), file.size, needed=archive.may_hold)
    known = {entry.name for entry, _ in found if entry}
    needed = {name: size for name, size in listed if archive.is_wanted(name)}
    if not needed.keys() <= known:
        sys.exit("the index lacks members")
    whole = (file.bytes + sum(needed.values())) / file.size
    return (
        f"| {frames} of {frame // 1000} kB | {file.requests / objects:.1f} | "
        f"{file.bytes / objects / 1e6:.2f} MB | {whole:.2%} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--objects", type=int, default=12)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--frame-bytes", type=int, default=60_000)
    parser.add_argument("--latency", type=float, default=0.1)
    given = parser.parse_args()
    folder = given.folder / "published"
    shutil.rmtree(folder, ignore_errors=True)
    whole, needed = make(folder, given.objects, given.frames, given.frame_bytes)
    plain = folder / "unpacked.toml"
    plain.write_text(
        '[pixieverse]\nroot = "render_outputs"\n[slat]\nroot = "slat"\n'
        '[pairing]\ncategories = "classes.json"\n'
    )
    run("build-store", "--config", plain, "--out", folder / "unpacked.zarr")
    hub = PublishedHub()
    hub.delay = given.latency
    hub.publish(NAME, folder / "hub")
    settings = {
        "HF_ENDPOINT": hub.address, "HF_HOME": str(folder / "home"), "HF_HUB_DISABLE_XET": "1",
        "SLATPREP_CACHE": str(folder / "cache"),
    }  # fmt: skip
    store = folder / "pixieverse.zarr"
    build = ("build-store", "--pixieverse", f"hf://datasets/{NAME}", "--slat", folder / "slat")
    rows = []
    for what, command in (
        ("build", (*build, "--out", store)),
        ("verify --sources", ("verify", store, "--sources")),
        ("build again", (*build, "--out", store)),
    ):
        hub.requests.clear()
        hub.bytes = 0
        seconds = run(*command, **settings)
        rows.append((what, len(hub.requests), hub.ranges(), hub.bytes, seconds))
    local = local_bytes(folder, folder / "cache-local")
    print("| step | requests | of them ranges | bytes | share of the archives | s |")
    print("| --- | --- | --- | --- | --- | --- |")
    for what, requests, ranges, size, seconds in rows:
        print(f"| {what} | {requests} | {ranges} | {size:,} | {size / whole:.2%} | {seconds:.1f} |")
    print(f"| build from the disk | - | - | {local:,} | {local / whole:.2%} | - |")
    same = [tree(folder / f"{name}.zarr") == tree(store) for name in ("unpacked", "local")]
    print()
    print(
        f"{given.objects} objects, archives of {whole:,} bytes with {given.frames} frames of "
        f"{given.frame_bytes:,} bytes an object, {needed:,} bytes needed; equal to the store of "
        f"the unpacked folder: {same[0]}, of the archives on the disk: {same[1]}"
    )
    print("\n| frames of an object | requests | bytes | share with the members needed |")
    print("| --- | --- | --- | --- |")
    for frames, frame in FRAMES:
        print(index_of(given.objects, frames, frame))
    shutil.rmtree(folder)
    if not all(same):
        sys.exit(1)


if __name__ == "__main__":
    main()

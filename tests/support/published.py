"""PixieVerse as it is published: archives by class, each object's files as Pixie writes them."""

import io
import json
import tarfile
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from slatprep.parameters import BuildParameters
from slatprep.storage.place import place_of
from support.synthetic import Dataset, make_asset

BLOCK = tarfile.BLOCKSIZE
CLASSES = ("tree", "soda_cans", "sand")
IDS = [f"{number:032x}" for number in range(5)]


def add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    """Add a file to an archive."""
    member = tarfile.TarInfo(name)
    member.size = len(data)
    archive.addfile(member, io.BytesIO(data))


def add_link(tar: tarfile.TarFile, name: str, target: str, kind: bytes = tarfile.LNKTYPE) -> None:
    """Add a link to an archive, or a member of another kind that has no data."""
    member = tarfile.TarInfo(name)
    member.type, member.linkname = kind, target
    tar.addfile(member)


def write_object(folder: Path, grid: np.ndarray, seed: int = 0) -> None:
    """Write the files of an object that lie beside its grid, small ones in place of large."""
    rng = np.random.default_rng(seed)
    frames = folder / "sample_0" / "gs_sim_gridsize_64_output"
    frames.mkdir(parents=True)
    np.save(folder / "sample_0" / "material_grid.npy", grid)
    occupied = grid[..., 3] != 7
    np.save(folder / "clip_features_mask.npy", occupied.astype(np.float32))
    np.savez(folder / "clip_features.npz", min_bounds=(-0.5,) * 3, voxel_size=1 / 64)
    np.save(folder / "clip_features_features.npy", rng.random((8, 8, 8, 768)).astype(np.float16))
    for number in range(6):
        (frames / f"{number:04d}.png").write_bytes(rng.bytes(3000))
    (frames / "output.mp4").write_bytes(rng.bytes(50_000))


def publish(objects: Path, root: Path, suffix: str = ".tar") -> Path:
    """Put a folder of objects into archives by class; return the folder that has them."""
    folder = root / "archives" / "render_outputs"
    folder.mkdir(parents=True)
    names = sorted(path.name for path in objects.iterdir())
    for number, name in enumerate(CLASSES):
        pack(folder / f"{name}{suffix}", (objects / one for one in names[number :: len(CLASSES)]))
    return folder


def writing(path: Path) -> tarfile.TarFile:
    """Open a new archive, with gzip where its name says so."""
    return tarfile.open(path, "w:gz" if path.suffix == ".gz" else "w")


def pack(path: Path, objects: Iterable[Path]) -> None:
    """Write an archive of objects."""
    with writing(path) as archive:
        for one in objects:
            archive.add(one, arcname=one.name)


def make_published(folder: Path) -> Path:
    """Make five objects unpacked, in archives, and in archives with gzip; four have a SLAT."""
    dataset = Dataset(folder)
    for number, name in enumerate(IDS):
        asset = make_asset(number)
        write_object(folder / "pixieverse" / "render_outputs" / name, asset.grid, number)
        if number < 4:
            dataset.write_slat(f"{name}.npz", asset.coords, asset.feats)
    publish(folder / "pixieverse" / "render_outputs", folder / "tar")
    publish(folder / "pixieverse" / "render_outputs", folder / "gz", ".tar.gz")
    entries = {
        name: {"obj_class": CLASSES[number % 3], "vlm_filtering": {"is_appropriate": True}}
        for number, name in enumerate(IDS)
    }
    (folder / "classes.json").write_text(json.dumps(entries))
    return folder


class SparseArchive:
    """An archive of any size with empty files, whose reads are counted; holds headers alone."""

    def __init__(self, files: Iterable[tuple[str, int]]) -> None:
        self.headers, self.requests, self.bytes, at = dict[int, bytes](), 0, 0, 0
        for name, size in files:
            member = tarfile.TarInfo(name)
            member.size = size
            self.headers[at] = member.tobuf()
            at += BLOCK + size + -size % BLOCK
        self.begins, self.size = list(self.headers), at + 10_240

    def pread(self, length: int, offset: int) -> bytes:
        data = bytearray(max(0, min(length, self.size - offset)))
        self.requests, self.bytes = self.requests + 1, self.bytes + len(data)
        end = offset + len(data)
        for begin in self.begins[bisect_left(self.begins, offset - BLOCK) :]:
            if begin >= end:
                break
            first, last = max(begin, offset), min(begin + BLOCK, end)
            if first < last:
                part = self.headers[begin][first - begin : last - begin]
                data[first - offset : last - offset] = part
        return bytes(data)


def parameters(made: Path, root: str | Path, categories: bool = False) -> BuildParameters:
    """Return the parameters of a build from a root, below the folder or a URL."""
    base = Dataset(made).parameters("pixie")
    pairing = replace(base.pairing, categories=made / "classes.json" if categories else None)
    place = place_of(root) if "://" in str(root) else made / root
    return replace(base, pixieverse=replace(base.pixieverse, root=place), pairing=pairing)

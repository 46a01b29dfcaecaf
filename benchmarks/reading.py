"""Compare reading random whole assets for training, by slatprep and by the alternatives.

    python benchmarks/reading.py STORE.zarr

Every way reads the same arrays of the same assets, in the same shuffled
order. All ways run in turn in every repeat, so that a machine that slows down
slows all of them.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import util
from pathlib import Path
from typing import Annotated, Any

import click
import numpy as np
from numpy.typing import NDArray

from slatprep.cli.options import LastStore, Positive
from slatprep.cli.output import Output
from slatprep.cli.signature import command
from slatprep.errors import StoreError
from slatprep.storage.place import storage_of
from slatprep.store import open_store
from slatprep.store.reader import TRAINING_COLUMNS
from slatprep.workers import Progress
from slatprep.workers.local import single_threaded

STORED_COLUMNS = (*TRAINING_COLUMNS, "material", "valid", "distance", "place")
"""What every way holds of an asset; `TRAINING_COLUMNS` of it are read."""

Arrays = dict[str, NDArray[Any]]
Reader = Callable[[int], Arrays]


@dataclass(frozen=True)
class Way:
    """One way to keep a dataset and to read an asset of it.

    ``open`` is called in the process that reads; what it returns reads one
    asset. ``files`` is the folder or file that holds the data, and ``needs`` a
    module that slatprep does without.
    """

    name: str
    open: Callable[[Path], Reader]
    files: str
    needs: str | None = None


@dataclass(frozen=True)
class WayResult:
    """What was measured of one way.

    Attributes
    ----------
    name : str
        The way.
    size, files : int
        Bytes and files of all ``voxel/*`` arrays on disk.
    seconds : float
        Processor seconds an asset, warm, one process: the median of the repeats.
    warm : float
        Assets a second by the wall clock, warm, one process: the best repeat.
    warm_two : float
        The same with two processes at a time.
    cold : float or None
        The same with one process, after the system was asked to forget the
        files; None where it cannot be asked.
    ratio : float
        Median over the repeats of the processor time of uncompressed npz over
        this way's.
    """

    name: str
    size: int
    files: int
    seconds: float
    warm: float
    warm_two: float
    cold: float | None
    ratio: float


@dataclass(frozen=True)
class ReadBench:
    """Results of all ways on one store."""

    store: Path
    assets: int
    voxels: int
    repeats: int
    ways: tuple[WayResult, ...]
    left_out: tuple[str, ...]


def bench_read(
    store: Path,
    directory: Path,
    *,
    limit: int | None = None,
    repeats: int = 5,
    seed: int = 0,
    progress: Progress | None = None,
) -> ReadBench:
    """Measure how many assets a second can be read.

    Parameters
    ----------
    store : Path
        A store; its arrays are copied into the other forms.
    directory : Path
        Empty folder for those, about three times the size of the store.
    limit : int, optional
        At most so many assets, the first ones.
    repeats : int
        How often every way reads every asset.
    seed : int
        Of the order in which they are read.
    progress : callable, optional
        Called with the passes done and the passes in all.

    Returns
    -------
    ReadBench
        Sizes and speeds of every way whose library is installed.
    """
    # A second process would resolve a link in the path again.
    store = store.resolve()
    opened = open_store(store)
    assets = min(limit or len(opened), len(opened))
    write_forms(store, directory, assets)
    (directory / "store").symlink_to(store)
    ways = [way for way in WAYS if way.needs is None or util.find_spec(way.needs)]
    for way in ways:
        _require_equal(way, directory, opened.read(assets - 1), assets - 1)
    order = np.random.default_rng(seed).permutation(assets).tolist()
    measured: dict[str, list[tuple[float, ...]]] = {way.name: [] for way in ways}
    passes = [way for _ in range(repeats) for way in ways]
    with single_threaded():
        for done, way in enumerate(passes, start=1):
            wall, processor = _in_process(way, directory, order)
            two, cold = _two_processes(way, directory, order), np.nan
            if forget(directory / way.files):
                cold, _ = _in_process(way, directory, order, warm_up=False)
            measured[way.name].append((wall, two, cold, processor))
            if progress:
                progress(done, len(passes))
    reference = np.array(measured[REFERENCE])[:, -1]
    results = []
    for way in ways:
        warm, warm_two, cold, _ = (assets / np.min(measured[way.name], axis=0)).tolist()
        taken = np.array(measured[way.name])[:, -1]
        results.append(
            WayResult(
                way.name,
                *_size(directory, way),
                seconds=float(np.median(taken)) / assets,
                warm=warm,
                warm_two=warm_two,
                cold=None if np.isnan(cold) else cold,
                ratio=float(np.median(reference / taken)),
            )
        )
    left_out = tuple(way.name for way in WAYS if way not in ways)
    voxels = int(opened.offsets[assets])
    return ReadBench(store, assets, voxels, repeats, tuple(results), left_out)


def write_forms(store: Path, directory: Path, assets: int) -> None:
    """Write what the other ways read: npz of both kinds and one HDF5 file."""
    import h5py

    opened = open_store(store)
    for name in ("npz", "npz-compressed"):
        (directory / name).mkdir(parents=True)
    with h5py.File(directory / "all.h5", "w") as file:
        for row in range(assets):
            arrays = opened.read(row, STORED_COLUMNS)
            np.savez(directory / "npz" / f"{row}.npz", **arrays)  # type: ignore[arg-type]
            np.savez_compressed(directory / "npz-compressed" / f"{row}.npz", **arrays)  # type: ignore[arg-type]
            group = file.create_group(str(row))
            for name, array in arrays.items():
                group[name] = array


def forget(path: Path) -> bool:
    """Ask the system to drop a file, or all files of a folder, from memory."""
    if not hasattr(os, "posix_fadvise"):
        return False
    path = path.resolve()
    for file in [path] if path.is_file() else path.rglob("*"):
        if file.is_file():
            descriptor = os.open(file, os.O_RDONLY)
            try:
                os.fsync(descriptor)  # What is not on disk yet cannot be dropped.
                os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            finally:
                os.close(descriptor)
    return True


def _in_process(
    way: Way, directory: Path, order: Sequence[int], warm_up: bool = True
) -> tuple[float, float]:
    """Return wall clock and processor seconds that reading all assets takes."""
    read = way.open(directory)
    if warm_up:
        for row in order:
            read(row)
    begin, processor = time.perf_counter(), time.process_time()
    for row in order:
        read(row)
    return time.perf_counter() - begin, time.process_time() - processor


def _two_processes(way: Way, directory: Path, order: Sequence[int]) -> float:
    """Return the seconds in which two processes, half of the assets each, have read all."""
    context = multiprocessing.get_context("spawn")
    start = context.Barrier(3)
    workers = [
        context.Process(target=_worker, args=(way.name, directory, order[part::2], start))
        for part in (0, 1)
    ]
    for worker in workers:
        worker.start()
    start.wait()
    begin = time.perf_counter()
    start.wait()
    seconds = time.perf_counter() - begin
    for worker in workers:
        worker.join()
    return seconds


def _worker(name: str, directory: Path, order: Sequence[int], start: Any) -> None:
    try:
        with single_threaded():
            read = next(way for way in WAYS if way.name == name).open(directory)
            for row in order:
                read(row)
            start.wait()
            for row in order:
                read(row)
            start.wait()
    except BaseException:
        start.abort()  # Otherwise the other processes wait without end.
        raise


def _open_slatprep(directory: Path) -> Reader:
    return open_store(directory / "store").read


def _open_npz(folder: str, directory: Path) -> Reader:
    def read(row: int) -> Arrays:
        with np.load(directory / folder / f"{row}.npz", allow_pickle=False) as arrays:
            return {name: arrays[name] for name in TRAINING_COLUMNS}

    return read


def _open_hdf5(directory: Path) -> Reader:
    import h5py

    file = h5py.File(directory / "all.h5", "r")

    def read(row: int) -> Arrays:
        group = file[str(row)]
        return {name: group[name][()] for name in TRAINING_COLUMNS}

    return read


def _open_zarr(pipeline: str, directory: Path) -> Reader:
    import zarr

    zarr.config.set({"codec_pipeline.path": pipeline})
    group: Any = zarr.open_group(directory / "store", mode="r")
    arrays = {name: group[f"voxel/{name}"] for name in TRAINING_COLUMNS}
    offsets = group["asset/offset"][:].tolist()

    def read(row: int) -> Arrays:
        rows = slice(offsets[row], offsets[row + 1])
        return {name: array[rows] for name, array in arrays.items()}

    return read


def _open_tensorstore(directory: Path) -> Reader:
    import tensorstore

    offsets = open_store(directory / "store").offsets.tolist()
    context = tensorstore.Context({"data_copy_concurrency": {"limit": 1}})
    arrays = {
        name: tensorstore.open(
            {
                "driver": "zarr3",
                "kvstore": {"driver": "file", "path": f"{directory}/store/voxel/{name}/"},
            },
            context=context,
            read=True,
        ).result()
        for name in TRAINING_COLUMNS
    }

    def read(row: int) -> Arrays:
        first, last = offsets[row], offsets[row + 1]
        # All are asked for before the first is waited for, as its makers advise.
        pending = {name: array[first:last].read() for name, array in arrays.items()}
        return {name: future.result() for name, future in pending.items()}

    return read


REFERENCE = "npz"

_PYTHON = "zarr.core.codec_pipeline.BatchedCodecPipeline"
_RUST = "zarrs.ZarrsCodecPipeline"

WAYS = (
    Way("slatprep", _open_slatprep, "store"),
    Way(REFERENCE, partial(_open_npz, "npz"), "npz"),
    Way("npz compressed", partial(_open_npz, "npz-compressed"), "npz-compressed"),
    Way("one HDF5 file", _open_hdf5, "all.h5"),
    Way("zarr-python", partial(_open_zarr, _PYTHON), "store"),
    Way("zarrs under zarr-python", partial(_open_zarr, _RUST), "store", needs="zarrs"),
    Way("tensorstore", _open_tensorstore, "store", needs="tensorstore"),
)
"""All ways, each measured where what it needs is installed."""


def _require_equal(way: Way, directory: Path, expected: Arrays, row: int) -> None:
    found = way.open(directory)(row)
    for name, array in expected.items():
        if array.tobytes() != np.ascontiguousarray(found[name]).tobytes():
            raise StoreError(f"{way.name} reads other {name} of asset {row} than slatprep does")


def _size(directory: Path, way: Way) -> tuple[int, int]:
    """Return bytes and files that the arrays take."""
    path = (directory / way.files).resolve()
    if way.files == "store":
        path = path / "voxel"
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files), len(files)


@command("reading")
def main(
    output: Output,
    store: LastStore,
    *,
    assets: Annotated[Positive | None, "Most assets to read. [default: all]"] = None,
    repeats: Annotated[Positive, "Number of measurements."] = 5,
    seed: Annotated[int, "Seed of the order of reading."] = 0,
) -> None:
    """Read shuffled whole assets (coords, feats, properties) as training does.

    Compares slatprep's reader with npz (one file an asset, plain and
    compressed), one HDF5 file, zarr-python, and zarrs and tensorstore where
    they are installed. 'cold' is after asking the system to drop the files from its cache.

    Example
    -------
    python benchmarks/reading.py data/demo.zarr
    python benchmarks/reading.py data/demo.zarr --assets 400 --repeats 9
    """
    path = storage_of(store).local
    if path is None:
        raise click.UsageError(f"{store}: expected a store on the local disk")
    with (
        tempfile.TemporaryDirectory(dir=path.resolve().parent) as temporary,
        output.progress("passes") as progress,
    ):
        result = bench_read(
            path, Path(temporary), limit=assets, repeats=repeats, seed=seed, progress=progress
        )
    output.result(result, lambda: _show_read(output, result))


def _show_read(output: Output, result: ReadBench) -> None:
    output.table(
        f"Assets a second, {result.assets} assets of {result.voxels // result.assets} voxels, "
        f"best of {result.repeats} (processor ms an asset and its ratio to npz: medians)",
        ("way", "MB", "files", "warm", "warm, two", "cold", "ms", "ratio"),
        [
            (
                way.name,
                round(way.size / 1e6, 1),
                way.files,
                round(way.warm),
                round(way.warm_two),
                None if way.cold is None else round(way.cold),
                round(way.seconds * 1e3, 3),
                round(way.ratio, 2),
            )
            for way in result.ways
        ],
    )
    for name in result.left_out:
        output.note(f"{name}: not installed")


if __name__ == "__main__":
    main()

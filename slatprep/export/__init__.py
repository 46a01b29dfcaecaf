"""Take a store elsewhere: PLY, HDF5, WebDataset shards, or TRELLIS's npz.

Each format is one module. `export_store` chooses the assets, hands batches of
them to the format's writer, and moves the result into its place when it is
complete.
"""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from slatprep.errors import ConfigError
from slatprep.export import target
from slatprep.export.assets import (
    ExportedAsset,
    describe_columns,
    file_name,
    read_assets,
    select_assets,
)
from slatprep.export.bounds import Bounds, read_bounds
from slatprep.export.ply import Frame, Points
from slatprep.store import Store, open_store
from slatprep.workers.local import run_unordered

__all__ = ["FORMATS", "ExportOptions", "ExportSummary", "export_store"]

Format = Literal["ply", "hdf5", "webdataset", "npz"]
FORMATS: tuple[str, ...] = get_args(Format)
"""Names of the formats."""

Progress = Callable[[int, int], None]
"""Called with the assets done and the assets in all."""

_BATCH = 16
"""Assets a worker takes at a time, so that opening the store is not felt."""

_Entry = dict[str, Any]
"""An asset in the index of an export: its id, its file, its number of points."""


@dataclass(frozen=True)
class ExportOptions:
    """What only some formats ask for.

    Attributes
    ----------
    points : {"slat", "grid"}
        PLY: the SLAT's voxels with the annotations found for them, or the
        annotated voxels of the PixieVerse field.
    frame : {"slat", "pixieverse"}
        PLY: the unit cube of the SLAT, or the world of PixieVerse's bounds.
    shard_size : int
        WebDataset: assets in one shard.
    """

    points: Points = "slat"
    frame: Frame = "slat"
    shard_size: int = 256


@dataclass(frozen=True)
class ExportSummary:
    """What an export wrote: where, how many assets, points, files and bytes, in what time."""

    format: str
    path: Path
    assets: int
    points: int
    files: int
    size: int
    seconds: float
    notes: tuple[str, ...] = field(default=())


def export_store(
    store: str | Path,
    out: str | Path,
    format: Format,
    *,
    assets: Sequence[str] = (),
    verdicts: Sequence[str] = (),
    options: ExportOptions | None = None,
    jobs: int = 1,
    progress: Progress | None = None,
) -> ExportSummary:
    """Write assets of a store in another format.

    Parameters
    ----------
    store : str or Path
        The store.
    out : str or Path
        The file (``hdf5``) or directory (all others) to write. An export that
        is there is replaced when the new one is complete; anything else is
        left alone.
    format : {"ply", "hdf5", "webdataset", "npz"}
        What to write; docs/export.md says what is in each.
    assets : sequence of str
        Ids of the assets; empty takes all.
    verdicts : sequence of str
        Take only assets with one of these verdicts; empty takes all.
    options : ExportOptions, optional
        What only some formats ask for.
    jobs : int
        Worker processes; the bytes written do not depend on it. HDF5 is
        written by one.
    progress : callable, optional
        See `Progress`.

    Returns
    -------
    ExportSummary
        What was written.

    Raises
    ------
    ConfigError
        If no asset is left, an id is unknown, or `out` is something else or
        lies in the store.
    StoreError
        If the store cannot be read.
    """
    begin = time.perf_counter()
    if format not in FORMATS:
        raise ConfigError(f"format is {format!r}; expected one of {', '.join(FORMATS)}")
    options, store, out = options or ExportOptions(), Path(store), Path(out)
    opened = open_store(store)
    if store.resolve() in out.resolve().parents:
        raise ConfigError(f"{out} lies inside the store; expected a path outside {store}")
    ids = select_assets(opened, assets, verdicts)
    job = _Job(opened, ids, options, jobs, progress)
    notes: tuple[str, ...] = ()
    if format == "hdf5":
        entries = _export_hdf5(job, out)
    else:
        with target.directory(out) as directory:
            entries, notes = _WRITERS[format](job, directory)
            about = {**describe_store(opened, format), "notes": list(notes)}
            target.write_index(directory, about, entries)
    files = [out] if out.is_file() else [path for path in out.rglob("*") if path.is_file()]
    return ExportSummary(
        format=format,
        path=out,
        assets=len(entries),
        points=sum(entry["points"] for entry in entries),
        files=len(files),
        size=sum(path.stat().st_size for path in files),
        seconds=time.perf_counter() - begin,
        notes=notes,
    )


def describe_store(store: Store, format: str) -> dict[str, Any]:
    """Return what every export says of the store it was made from, JSON-ready."""
    attributes = store.attributes
    return {
        "format": target.FORMAT,
        "format_version": target.FORMAT_VERSION,
        "kind": format,
        "store": store.name,
        "manifest": attributes["manifest"],
        "resolution": attributes["resolution"],
        "material_classes": attributes["material_classes"],
        "property_columns": attributes["property_columns"],
        "property_units": ["Pa", "kg/m^3", "1"],
        "normalization": attributes["normalization"],
    }


@dataclass(frozen=True)
class _Job:
    """The assets to write, and how."""

    store: Store
    ids: list[str]
    options: ExportOptions
    jobs: int
    progress: Progress | None

    def run(
        self, function: Callable[..., list[_Entry]], tasks: Iterable[tuple[Any, ...]]
    ) -> list[_Entry]:
        """Run tasks, each of which returns its assets' entries; return all, sorted by id."""
        entries: list[_Entry] = []
        for part in run_unordered(function, tasks, self.jobs):
            entries += part
            if self.progress:
                self.progress(len(entries), len(self.ids))
        return sorted(entries, key=lambda entry: str(entry["asset_id"]))


def _export_files(job: _Job, write: Callable[..., int], directory: Path, suffix: str,
                  grid: bool = False) -> list[_Entry]:  # fmt: skip
    tasks = (
        (job.store.path, batch, directory, suffix, write, grid)
        for batch in _batches(job.ids, _BATCH)
    )
    return job.run(_write_files, tasks)


def _write_files(
    store: Path,
    ids: Sequence[str],
    directory: Path,
    suffix: str,
    write: Callable[[Path, ExportedAsset], int],
    grid: bool,
) -> list[_Entry]:
    """Write one file an asset, in a worker."""
    entries = []
    for asset in read_assets(open_store(store), ids, grid=grid):
        name = file_name(asset.asset_id) + suffix
        points = write(directory / name, asset)
        entries.append(_entry(asset, name, points))
    return entries


def _export_ply(job: _Job, directory: Path) -> tuple[list[_Entry], tuple[str, ...]]:
    from slatprep.export import ply

    options = job.options
    bounds: dict[str, Bounds] = {}
    notes: tuple[str, ...] = ()
    if options.frame == "pixieverse":
        bounds, notes = read_bounds(job.store, job.ids)
    write = functools.partial(
        ply.write_asset,
        points=options.points,
        frame=options.frame,
        bounds=bounds,
        max_distance=_max_distance(job.store),
    )
    return _export_files(job, write, directory, ".ply", options.points == "grid"), notes


def _export_npz(job: _Job, directory: Path) -> tuple[list[_Entry], tuple[str, ...]]:
    from slatprep.export import npz

    return _export_files(job, npz.write_asset, directory, ".npz"), ()


def _export_webdataset(job: _Job, directory: Path) -> tuple[list[_Entry], tuple[str, ...]]:
    tasks = (
        (job.store.path, batch, directory, f"shard-{number:06d}.tar")
        for number, batch in enumerate(_batches(job.ids, job.options.shard_size))
    )
    return job.run(_write_shard, tasks), ()


def _write_shard(store: Path, ids: Sequence[str], directory: Path, name: str) -> list[_Entry]:
    """Write one shard, in a worker."""
    from slatprep.export import webdataset

    entries = []
    with webdataset.ShardWriter(directory / name) as shard:
        for asset in read_assets(open_store(store), ids):
            shard.add(asset)
            entries.append(_entry(asset, name, len(asset.coords)))
    return entries


def _export_hdf5(job: _Job, out: Path) -> list[_Entry]:
    from slatprep.export import hdf5

    entries = []
    with target.file(out, hdf5.is_export) as path, hdf5.Writer(path) as writer:
        writer.describe(describe_store(job.store, "hdf5"))
        for asset in read_assets(job.store, job.ids):
            writer.add(asset)
            entries.append(_entry(asset, out.name, len(asset.coords)))
            if job.progress:
                job.progress(len(entries), len(job.ids))
    return entries


_WRITERS: dict[str, Callable[[_Job, Path], tuple[list[_Entry], tuple[str, ...]]]] = {
    "ply": _export_ply,
    "npz": _export_npz,
    "webdataset": _export_webdataset,
}


def _entry(asset: ExportedAsset, name: str, points: int) -> _Entry:
    return {**describe_columns(asset), "file": name, "points": points}


def _max_distance(store: Store) -> float:
    return float(store.attributes["build"]["parameters"]["sample"]["max_distance"])


def _batches(ids: Sequence[str], size: int) -> Iterator[list[str]]:
    iterator = iter(ids)
    while batch := list(itertools.islice(iterator, size)):
        yield batch

"""Take a store elsewhere: PLY, HDF5, WebDataset shards, or TRELLIS's npz.

Each format is one module. `export_store` chooses the assets, hands batches of
them to the format's writer, and moves the result into its place when it is
complete.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from slatprep.errors import ConfigError
from slatprep.export import target
from slatprep.export.assets import Exported, choose_ids, describe_columns
from slatprep.export.bounds import Bounds, read_bounds
from slatprep.export.ply import Frame, Points
from slatprep.records import Place
from slatprep.storage.place import place_of, storage_of
from slatprep.store import Store, StoredAsset, open_store
from slatprep.workers.local import run_unordered

__all__ = ["FORMATS", "ExportOptions", "ExportSummary", "export_store"]

Format = Literal["ply", "hdf5", "webdataset", "npz"]
FORMATS: tuple[str, ...] = get_args(Format)
"""Names of the formats."""

Progress = Callable[[int, int], None]
"""Called with the assets done and the assets in all."""

_BATCH = 16
"""Assets a worker takes at a time, so that opening the store does not count."""

_Write = Callable[[Path, int, Iterable[StoredAsset]], Iterable[Exported]]
"""Writes the assets of a batch, which has a number, below a directory."""

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
    store: str | Place,
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
    store : str or Place
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
    options, store, out = options or ExportOptions(), place_of(store), Path(out)
    opened = open_store(store)
    local = storage_of(store).local
    if local is not None and local.resolve() in out.resolve().parents:
        raise ConfigError(f"{out} lies inside the store; expected a path outside {store}")
    ids = choose_ids(opened, assets, verdicts)
    tell = progress or (lambda done, total: None)
    entries: list[_Entry] = []
    notes: tuple[str, ...] = ()
    if format == "hdf5":
        from slatprep.export import hdf5

        with target.file(out, hdf5.is_export) as file:
            about = _about(opened, format)
            for written in hdf5.write(file, about, map(opened.asset, ids)):
                entries.append(_entry(written))
                tell(len(entries), len(ids))
    else:
        with target.directory(out) as directory:
            write, batch, notes = _writer(format, opened, ids, options)
            tasks = (
                (write, opened, directory, number, batched)
                for number, batched in enumerate(_batches(ids, batch))
            )
            for part in run_unordered(_write_batch, tasks, jobs):
                entries += part
                tell(len(entries), len(ids))
            entries.sort(key=lambda entry: str(entry["asset_id"]))
            about = {**_about(opened, format), "notes": notes}
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


def _writer(
    format: Format, store: Store, ids: Sequence[str], options: ExportOptions
) -> tuple[_Write, int, tuple[str, ...]]:
    """Return what writes a batch, how many assets a batch has, and what a person should know."""
    from slatprep.export import npz, ply, webdataset

    if format == "npz":
        return npz.write, _BATCH, ()
    if format == "webdataset":
        return webdataset.write, options.shard_size, ()
    bounds: dict[str, Bounds] = {}
    notes: tuple[str, ...] = ()
    if options.frame == "pixieverse":
        bounds, notes = read_bounds(store, ids)
    write = functools.partial(
        ply.write,
        points=options.points,
        frame=options.frame,
        bounds=bounds,
        max_distance=float(store.attributes["build"]["parameters"]["sample"]["max_distance"]),
    )
    return write, _BATCH, notes


def _write_batch(
    write: _Write, store: Store, directory: Path, number: int, ids: Sequence[str]
) -> list[_Entry]:
    """Write a batch of assets, in a worker."""
    return [_entry(written) for written in write(directory, number, map(store.asset, ids))]


def _entry(written: Exported) -> _Entry:
    return {**describe_columns(written.asset), "file": written.file, "points": written.points}


def _about(store: Store, format: Format) -> dict[str, Any]:
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


def _batches(ids: Sequence[str], size: int) -> Iterator[Sequence[str]]:
    return (ids[start : start + size] for start in range(0, len(ids), size))

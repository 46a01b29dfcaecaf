"""Export a store as PLY, HDF5, WebDataset shards, npz of TRELLIS and VoMP, or USD.

`export_store` chooses the assets, passes batches of them to the
format's writer, and moves the result into place when it is complete.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

from slatprep.errors import ConfigError, require_one_of
from slatprep.export import target
from slatprep.export.formats import (
    Exported,
    ExportOptions,
    Writer,
    choose_ids,
    clipped_values,
    describe_columns,
)
from slatprep.records import USABLE, Place, words_of
from slatprep.storage.place import local_path_of
from slatprep.store import Store, open_store
from slatprep.store.reader import require_outside
from slatprep.workers import Progress
from slatprep.workers.local import require_workers, run_unordered

__all__ = ["FORMATS", "ExportOptions", "ExportSummary", "export_store"]


class Format(NamedTuple):
    """A format: where its function lies, and the fields of `ExportOptions` that it reads.

    The function takes the open store, the ids of the exported assets and the `ExportOptions`, and
    returns a `Writer`.
    """

    writer: str
    options: tuple[str, ...] = ()


FORMATS = {
    "ply": Format("slatprep.export.ply:writer", ("points", "frame")),
    "hdf5": Format("slatprep.export.hdf5:writer"),
    "webdataset": Format("slatprep.export.npz:webdataset", ("shard_size",)),
    "npz": Format("slatprep.export.npz:trellis", ("latent_model",)),
    "voxel_data": Format("slatprep.export.npz:voxel_data", ("points",)),
    "usd": Format("slatprep.export.usd:writer", ("points", "size", "materials")),
}
"""Each format by its name; to add a format, add its line here."""

_REPEATED = ("manifest", "resolution", "material_classes", "property_columns", "property_units",
             "latents", "normalization")  # fmt: skip
"""Attributes of a store that an export repeats."""

_Entry = dict[str, Any]
"""The entry of an asset in the index of an export: id, columns, file, number of points."""


@dataclass(frozen=True)
class ExportSummary:
    """The result of an export: path, number of assets, points, files and bytes, and time."""

    format: str
    path: Path
    assets: int
    points: int
    files: int
    size: int
    seconds: float
    notes: tuple[str, ...]


def export_store(
    store: Store | str | Place,
    out: str | Path,
    format: str,
    *,
    assets: Sequence[str | int] | None = None,
    verdicts: Sequence[str] | None = None,
    options: ExportOptions | None = None,
    jobs: int = 1,
    progress: Progress | None = None,
) -> ExportSummary:
    """Write assets of a store in another format.

    Parameters
    ----------
    store : Store, str or Place
        An open store, or its path or URL.
    out : str or Path
        The file (``hdf5``) or folder (all others) to write. The new export replaces an old one of
        the same format when complete; other files stay.
    format : str
        The format, one of `FORMATS`; see docs/export.md.
    assets : str, or sequence of str or int, optional
        Ids, beginnings of ids, or numbers; None takes all.
    verdicts : str or sequence of str, optional
        Only assets with one of these verdicts; empty or ``all`` takes all. By default `assets` are
        taken with any verdict; if `assets` is None, all good and doubtful ones are.
    options : ExportOptions, optional
        Options of some formats.
    jobs : int
        Worker processes; the bytes do not depend on it. One process writes HDF5.
    progress : callable, optional
        See `slatprep.workers.Progress`.

    Returns
    -------
    ExportSummary
        What was written.

    Raises
    ------
    ConfigError
        If no asset is named or left, an id is unknown, `jobs` is below 1, or `out` is a URL, lies
        in a store or holds something that is not an export of this format.
    StoreError
        If the store cannot be read.
    """
    begin = time.perf_counter()
    require_one_of("format", format, FORMATS)
    require_workers(jobs)
    if not isinstance(options := options or ExportOptions(), ExportOptions):
        raise ConfigError(f"options are {options!r:.80}; expected slatprep.export.ExportOptions")
    opened, out = open_store(store), local_path_of(out)
    require_outside(out)
    named, assets = assets is not None, words_of(assets)
    if named and not assets:
        raise ConfigError("assets is empty; expected one at least, or None for all")
    if verdicts is None:
        verdicts = () if assets else USABLE
    ids = choose_ids(opened, assets, verdicts)
    tell = progress or (lambda done, total: None)
    writer: Writer = resolve_name(FORMATS[format].writer)(opened, ids, options)
    about = _about(opened, format)
    clipped = clipped_values(opened, ids, writer.points)
    entries: list[_Entry] = []
    if writer.is_export is not None:
        with target.file(out, writer.is_export) as file:
            for written in writer.write(file, about, map(opened.asset, ids)):
                entries.append(_entry(written))
                tell(len(entries), len(ids))
            sizes = [file.stat().st_size]
    else:
        with target.directory(out, format) as directory:
            starts = range(0, len(ids), writer.batch)
            tasks = (
                (writer.write, opened, directory, number, ids[start : start + writer.batch])
                for number, start in enumerate(starts)
            )
            for part in run_unordered(_write_batch, tasks, jobs):
                entries += part
                tell(len(entries), len(ids))
            entries.sort(key=lambda entry: str(entry["asset_id"]))
            about |= {"notes": [*clipped, *writer.remarks(entries)]}
            if writer.finish is not None:
                about |= {"files": writer.finish(directory, entries)}
            target.write_index(directory, about, entries)
            sizes = [path.stat().st_size for path in directory.rglob("*") if path.is_file()]
    return ExportSummary(
        format=format,
        path=out,
        assets=len(entries),
        points=sum(entry["points"] for entry in entries),
        files=len(sizes),
        size=sum(sizes),
        seconds=time.perf_counter() - begin,
        notes=(*clipped, *writer.remarks(entries)),
    )


def _write_batch(
    write: Callable[..., Iterable[Exported]],
    store: Store,
    directory: Path,
    number: int,
    ids: Sequence[str],
) -> list[_Entry]:
    """Write a batch of assets, in a worker."""
    return [_entry(written) for written in write(directory, number, map(store.asset, ids))]


def _entry(written: Exported) -> _Entry:
    here = {"file": written.file, "points": written.points, **written.figures}
    return {**describe_columns(written.asset), **here}


def _about(store: Store, format: str) -> dict[str, Any]:
    """Return the description of the store that every export has, JSON-ready."""
    about = {
        "format": target.FORMAT,
        "format_version": target.FORMAT_VERSION,
        "kind": format,
        "store": store.name,
    }
    return about | {name: store.attributes[name] for name in _REPEATED}

"""`slatprep export`: write a store's assets in the formats of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slatprep.cli.options import (
    EXISTING_FOLDER,
    NEW_PATH,
    POSITIVE,
    ChoiceOf,
    command,
    complete_asset,
    jobs_option,
    note_left_out,
    note_split,
    option,
    split_options,
    split_rule,
    verdicts_option,
)
from slatprep.cli.output import Cell, Output
from slatprep.errors import ConfigError

if TYPE_CHECKING:
    from slatprep.records import Place

# The formats of each option; giving it with another format is an error.
_ONLY_FOR = {
    "points": ("ply", "voxel_data"),
    "frame": ("ply",),
    "shard_size": ("webdataset",),
    "latent_model": ("npz",),
}


@command()
@click.argument("store", type=EXISTING_FOLDER)
@option("--format", ChoiceOf("slatprep.export:FORMATS"), name="kind", required=True)
@option("--out", NEW_PATH, required=True, metavar="PATH")
@option("--asset", name="assets", multiple=True, metavar="ID", shell_complete=complete_asset)
@verdicts_option
@option("--split", ChoiceOf("slatprep.readers.splits:SPLITS", "all"), "all")
@split_options
@option("--points", ChoiceOf("slatprep.export.formats:Points"))
@option("--frame", ChoiceOf("slatprep.export.formats:Frame"))
@option("--shard-size", POSITIVE)
@option("--latent-model", metavar="NAME")
@jobs_option
def export(
    output: Output,
    store: Place,
    kind: Any,
    out: Path,
    split: Any,
    split_by: str | None,
    shares: str | None,
    **others: Any,
) -> None:
    """Write assets of STORE in a format of other tools.

    Properties are in SI units in PLY and voxel_data, normalised in WebDataset
    and npz, and both in HDF5. Every folder gets an index.json of its contents.

    Options
    -------
    --format: Point clouds with Pixie's fields, one HDF5 file, tar shards, the files of TRELLIS's
        dataset (npz and metadata.csv) with the targets added, or the npz of VoMP's scripts.
    --out: The file (hdf5) or folder (all others); an existing export is replaced when the new
        one is complete.
    --asset: An asset; may be repeated. [default: all]
    --split: Only objects of this split, as `slatprep train` splits them.
    --points: ply, voxel_data: SLAT voxels, or the voxels of the PixieVerse field. [default: slat]
    --frame: ply: the SLAT's unit cube, or PixieVerse's world coordinates. [default: slat]
    --shard-size: webdataset: assets a shard. [default: 256]
    --latent-model: npz: the encoder's name, latent_model in TRELLIS's configurations. [default:
        that of TRELLIS's published configurations]

    Example
    -------
    slatprep export data/demo.zarr --format ply --out demo.ply.d --verdict good
    slatprep export data/demo.zarr --format ply --out world --points grid --frame pixieverse
    slatprep export data/demo.zarr --format hdf5 --out demo.h5 --asset 5f61cc --asset 803c1a
    slatprep export data/demo.zarr --format webdataset --out shards --shard-size 128 --jobs 2
    slatprep export data/demo.zarr --format npz --out trellis
    slatprep export data/demo.zarr --format voxel_data --out vomp --points grid
    slatprep export data/demo.zarr --format webdataset --out train --split train --split-by pixie
    """
    options = {name: value for name in _ONLY_FOR if (value := others.pop(name)) is not None}
    for name in options:
        if kind not in _ONLY_FOR[name]:
            flag = f"--{name.replace('_', '-')}"
            raise ConfigError(f"{flag} is for --format {' or '.join(_ONLY_FOR[name])}, not {kind}")
    from slatprep.export import ExportOptions, export_store
    from slatprep.store import open_store

    if others["verdicts"] is None and not others["assets"]:
        note_left_out(output, open_store(store))
    if split != "all":
        others |= _of_split(output, store, split, split_rule(split_by, shares), **others)
    elif split_by is not None or shares is not None:
        raise ConfigError("--split-by and --shares define splits; choose one with --split")
    with output.progress("export") as progress:
        chosen = ExportOptions(**options)
        summary = export_store(store, out, kind, options=chosen, progress=progress, **others)

    cells: dict[str, Cell] = {
        "format": summary.format,
        "assets": summary.assets,
        "points": summary.points,
        "files": summary.files,
        "MB": summary.size / 1e6,
        "seconds": summary.seconds,
    }
    for note in summary.notes:
        output.note(note)
    output.made(summary, lambda: output.record(f"Exported to {summary.path}", cells))


def _of_split(
    output: Output,
    place: Place,
    split: Any,
    rule: dict[str, Any],
    assets: Any,
    verdicts: Any,
    **_: Any,
) -> dict[str, Any]:
    """Return the assets of a split and the verdicts that may go out."""
    from slatprep.learn.splits import assign_store, select_assets
    from slatprep.records import USABLE
    from slatprep.store import open_store

    if assets:
        raise ConfigError("--asset and --split both choose; give one of them")
    store = open_store(place)
    assignment = assign_store(store, **rule)
    note_split(output, assignment, f"{split}, by {rule['by']}")
    rows = select_assets(store, split, splits=assignment.splits)
    if not len(rows):
        raise ConfigError(f"{store.path}: no asset is in the split {split}, by {rule['by']}")
    return {
        "assets": [store.ids[row] for row in rows],
        "verdicts": USABLE if verdicts is None else verdicts,
    }

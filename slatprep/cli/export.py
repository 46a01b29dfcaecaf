"""`slatprep export`, `publish`, `describe`: write a store for other tools, hubs, catalogues."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from slatprep.cli import options
from slatprep.cli.output import Output, say
from slatprep.cli.signature import Click, command
from slatprep.errors import ConfigError
from slatprep.storage.place import storage_of

if TYPE_CHECKING:
    from slatprep.store import Store


@dataclass(frozen=True, kw_only=True)
class FormatOptions:
    """Options of some formats; None takes the format's own default.

    Attributes
    ----------
    points
        ply, voxel_data, usd: SLAT voxels, or the voxels of the PixieVerse field. [default: grid for
        usd, else slat]
    frame
        ply: the SLAT's unit cube, or PixieVerse's world coordinates. [default: slat]
    shard_size
        webdataset: assets per shard. [default: 256]
    latent_model : NAME
        npz: the encoder's name, latent_model in TRELLIS's configurations. [default: theirs for
        latents of TRELLIS, else the store's name of the encoder]
    size : METRES
        usd: width of the unit cube. [default: 1]
    materials
        usd: largest number of materials into which E and nu of an asset are binned, 7 or
        more. [default: 64]
    """

    points: Annotated[Any | None, options.ChoiceOf("slatprep.export.formats:Points")] = None
    frame: Annotated[Any | None, options.ChoiceOf("slatprep.export.formats:Frame")] = None
    shard_size: options.Positive | None = None
    latent_model: str | None = None
    size: options.Above0 | None = None
    materials: options.Positive | None = None

    def of(self, kind: str) -> dict[str, Any]:
        """Return the options that were given; refuse an option of another format."""
        from slatprep.export import FORMATS

        given = {name: value for name, value in vars(self).items() if value is not None}
        for name in given:
            if name not in FORMATS[kind].options:
                flag = f"--{name.replace('_', '-')}"
                formats = " or ".join(one for one in FORMATS if name in FORMATS[one].options)
                raise ConfigError(f"{flag} is for --format {formats}, not {kind}")
        return given


@command()
def export(
    output: Output,
    store: options.FolderOrUrl,
    *,
    kind: Annotated[Any, options.ChoiceOf("slatprep.export:FORMATS"), Click("--format")],
    out: options.NewFileOrFolder,
    assets: options.AssetsOrAll = (),
    verdicts: options.UsableVerdicts = None,
    split: Annotated[Any, options.ChoiceOf("slatprep.readers.splits:SPLITS", "all")] = "all",
    splits: options.SplitOptions,
    format_options: FormatOptions,
    jobs: options.Jobs = 1,
) -> None:
    """Write assets of STORE in the format of another tool.

    Properties are in SI units in PLY, voxel_data and USD, normalised in WebDataset
    and npz, and both in HDF5. Every folder gets an index.json of its contents.

    Parameters
    ----------
    kind
        ply: point clouds with Pixie's fields. hdf5: one file. webdataset: tar shards. npz:
        TRELLIS's files and the targets. voxel_data: VoMP's npz. usd: for Newton and Isaac Lab.
    out : PATH
        The file (hdf5) or folder (all others); an existing export of the same format is replaced
        when the new one is complete.
    split
        Take only objects of this split, as `slatprep train` splits them.

    Example
    -------
    slatprep export data/demo.zarr --format ply --out demo.ply.d --verdict good
    slatprep export data/demo.zarr --format ply --out world --points grid --frame pixieverse
    slatprep export data/demo.zarr --format hdf5 --out demo.h5 --asset 5f61cc --asset 803c1a
    slatprep export data/demo.zarr --format webdataset --out shards --shard-size 128 --jobs 2
    slatprep export data/demo.zarr --format npz --out trellis
    slatprep export data/demo.zarr --format voxel_data --out vomp --points grid
    slatprep export data/demo.zarr --format usd --out usd --size 0.3 --asset 5f61cc
    slatprep export data/demo.zarr --format webdataset --out train --split train --split-by pixie
    """
    given = format_options.of(kind)
    from slatprep.export import ExportOptions, export_store
    from slatprep.records import USABLE

    left_out: list[str] = []
    if split == "all" and splits.given:
        raise ConfigError("--split-by and --shares define splits; choose one with --split")
    if split != "all" and assets:
        raise ConfigError("--asset and --split both choose; give one of them")
    opened = options.opened(store)
    options.note_numbered(output, opened, assets)
    rows: Sequence[int] = range(len(opened))
    if split != "all":
        rows = _of_split(output, opened, split, splits.rule)
    if verdicts is None and not assets:
        left_out = options.note_left_out(output, opened, rows, USABLE)
        verdicts = USABLE
    if split != "all":
        assets = tuple(opened.ids[row] for row in rows)
    with output.progress("export") as progress:
        summary = export_store(
            opened,
            out,
            kind,
            assets=None if split == "all" and not assets else assets,
            verdicts=verdicts,
            options=ExportOptions(**given),
            jobs=jobs,
            progress=progress,
        )

    for note in summary.notes:
        output.note(note)
    cells = {name: getattr(summary, name) for name in ("format", "assets", "points", "files")}
    cells |= {"MB": summary.size / 1e6, "seconds": summary.seconds}
    document = vars(summary) | {"problems": left_out}
    output.made(document, lambda: output.record(f"Exported to {summary.path}", cells))


def _of_split(output: Output, store: Store, split: Any, rule: dict[str, Any]) -> list[int]:
    """Return the rows of the assets in a split."""
    from slatprep.learn.splits import select_assets

    which = f"{split}, by {rule['by']}"
    splits = options.split_of_objects(output, store, rule, which)
    rows: list[int] = select_assets(store, split, splits=splits).tolist()
    if not rows:
        raise ConfigError(f"{store.path}: no asset is in the split {which}")
    return rows


@command()
def publish(
    output: Output,
    store: options.FolderOrUrl,
    *,
    out: options.NewFolder,
    data: Annotated[Any, options.ChoiceOf("slatprep.export.publish:Data")] = "store",
    verdicts: options.UsableVerdicts = None,
    pictures: Annotated[int, click.IntRange(0, 60)] = 12,
    stated: options.StatedOptions,
) -> None:
    """Write STORE as a dataset for a hub, such as Hugging Face's.

    Writes a folder with the card (README.md, with statistics and a picture), the data and the
    checksum of every file. With a store it also has the description that catalogues read
    (croissant.json). Nothing is uploaded; use the hub's own tool.

    Parameters
    ----------
    out
        The folder; an earlier result is replaced when the new one is complete.
    data
        The store itself, which `slatprep.open_store("hf://datasets/...")` reads, or shards for
        `datasets.load_dataset`.
    pictures : N
        Number of assets in the card's picture.

    Example
    -------
    slatprep publish data/demo.zarr --out hub --license CC-BY-4.0
    slatprep publish data/demo.zarr --out hub --data webdataset --name "My demo"
    """
    from slatprep.export.croissant import Stated
    from slatprep.export.publish import publish_store
    from slatprep.records import USABLE

    if verdicts is not None and data == "store":
        raise ConfigError(
            "--verdict is for --data webdataset; `slatprep subset` chooses of a store"
        )
    opened = options.opened(store)
    chosen = USABLE if verdicts is None and data == "webdataset" else verdicts or ()
    rows = [row for row, kept in enumerate(opened.having(chosen)) if kept]
    drawn = {"assets.png": _picture(opened, rows, pictures)} if pictures and rows else {}
    with output.progress("publish") as progress:
        summary = publish_store(
            opened,
            out,
            data,
            stated=Stated(**vars(stated)),
            pictures=drawn,
            verdicts=chosen,
            progress=progress,
        )
    if summary.missing:
        output.note(f"the card and catalogues also ask for {', '.join(summary.missing)}")
    cells = {name: getattr(summary, name) for name in ("data", "assets", "files")}
    cells |= {"MB": summary.size / 1e6}
    output.made(summary, lambda: output.record(f"Dataset in {out}", cells))
    output.note(f"next: hf upload OWNER/NAME {out} --repo-type dataset")


def _picture(store: Store, rows: Sequence[int], count: int) -> bytes:
    """Draw `count` assets of the rows, from as many categories as possible."""
    from slatprep.inspect.pictures.write import sheet_of

    seen: dict[str, int] = {}
    turns = []
    for row in rows:
        category = str(store.column("category")[row])
        seen[category] = seen.get(category, 0) + 1
        turns.append((seen[category], row))
    return sheet_of(store, [store.ids[row] for _, row in sorted(turns)[:count]])


@command(context_settings={"show_default": False})
def describe(
    output: Output,
    store: options.FolderOrUrl,
    *,
    out: options.NewFile | None = None,
    location: str = "",
    stated: options.StatedOptions,
) -> None:
    """Describe STORE in Croissant, MLCommons' vocabulary for datasets.

    The description is JSON-LD: the files of every array, their shapes and
    meaning, the classes, the ranges of the properties, and the table of
    assets. Catalogues of datasets and the mlcroissant package read it.

    Parameters
    ----------
    out : FILE.json
        The file. [default: standard output]
    location : URL
        Place where readers will find the store. [default: its path, relative to the description]

    Example
    -------
    slatprep describe data/demo.zarr
    slatprep describe data/demo.zarr --out demo.croissant.json --name demo
    """
    from slatprep.export import croissant

    if not location:
        local, beside = storage_of(store).local, out.parent if out else Path()
        location = Path(os.path.relpath(local, beside)).as_posix() if local else str(store)
    told = croissant.Stated(**vars(stated))
    if told.missing:
        output.note(f"catalogues also ask for {', '.join(told.missing)}")
    document = croissant.describe(options.opened(store), told, location.rstrip("/"))
    text = croissant.to_json(document)
    if out is None:
        say(text, nl=False)
        return
    with output.new_file(out) as path:
        path.write_text(text, encoding="utf-8")
    output.made({"path": out}, lambda: output.note(f"description: {out}"))

"""Write pictures of alignments: a file for each, and a contact sheet of many."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import amount
from slatprep.inspect.check import FITNESS, AlignmentCheck, check_alignment
from slatprep.inspect.pictures import canvas
from slatprep.inspect.pictures.alignment import draw_alignment, error_picture, outlined
from slatprep.inspect.pictures.scene import FARTHEST, Scene, scene_of, views
from slatprep.pipeline.rows import SourceStore
from slatprep.records import PICTURE_FORMATS
from slatprep.storage.atomic import staged, writing
from slatprep.storage.files import file_name
from slatprep.store.reader import Store, StoredAsset
from slatprep.store.records import StoredRecords
from slatprep.workers import Progress, counted
from slatprep.workers.local import run_unordered

if TYPE_CHECKING:
    from PIL.Image import Image

SHEET = "sheet.png"
"""Name of the contact sheet in a folder of pictures."""

MOST = 60
"""Largest number of assets on one sheet."""

_ACROSS = 4
_THUMBNAIL = 200
_MARGIN, _HEAD, _GAP = 40, 84, 20
_TITLE = 26
"""Largest number of characters of a title beside the verdict."""
_CELL_WIDTH, _CELL_HEIGHT = 2 * _THUMBNAIL + _GAP, _THUMBNAIL + 66


def write_pictures(
    store: Store,
    checks: Sequence[AlignmentCheck],
    target: Path,
    *,
    jobs: int = 1,
    progress: Progress | None = None,
) -> tuple[list[Path], Path | None]:
    """Draw alignments as files; return the file of each asset, and the contact sheet or None.

    For a single asset, `target` may be a file with a suffix of `PICTURE_FORMATS`. Otherwise it is a
    folder, with a PNG per asset, named by its id. Several assets also get a sheet of the first
    `MOST`.
    """
    kind = target.suffix.lower()[1:]
    if len(checks) == 1 and kind in PICTURE_FORMATS:
        files = {checks[0].asset_id: target}
    else:
        kind = "png"
        files = {one.asset_id: target / f"{file_name(one.asset_id)}.png" for one in checks}
    on_sheet = {one.asset_id for one in checks[:MOST]} if len(checks) > 1 else ()
    source = SourceStore(store)
    tasks = ((source, one, kind, one.asset_id in on_sheet) for one in checks)
    cells: dict[str, _Cell | None] = {}
    drawn = run_unordered(_drawn, tasks, jobs)
    for asset_id, picture, cell in counted(drawn, len(checks), progress):
        _write(files[asset_id], picture)
        cells[asset_id] = cell
    if not on_sheet:
        return list(files.values()), None
    sheet = target / SHEET
    while sheet in files.values():
        sheet = sheet.with_name(f"_{sheet.name}")
    _write(sheet, _sheet([cell for one in checks if (cell := cells[one.asset_id])]))
    return list(files.values()), sheet


def sheet_of(store: Store, asset_ids: Sequence[str]) -> bytes:
    """Draw a contact sheet of up to `MOST` assets of a store."""
    chosen = map(store.asset, asset_ids[:MOST])
    return _sheet(
        [_cell(asset, scene_of(asset), check_alignment(store, asset.index)) for asset in chosen]
    )


def picture_of(asset: StoredAsset) -> Image:
    """Return an asset's picture, as `write_pictures` draws it."""
    import PIL.Image

    check = check_alignment(asset.store, asset.index)
    return PIL.Image.open(io.BytesIO(_drawn(asset.store, check, "png", False)[1]))


class _Cell(NamedTuple):
    """One asset of a contact sheet: its check, its title, and its images side by side."""

    check: AlignmentCheck
    title: str
    image: NDArray[np.float64]


def _drawn(
    store: Store, check: AlignmentCheck, kind: str, on_sheet: bool
) -> tuple[str, bytes, _Cell | None]:
    """Return an asset's id, its picture, and its cell of the sheet if `on_sheet`."""
    asset = store.asset(check.asset_id)
    scene, title = scene_of(asset), title_of(asset)
    alignment = StoredRecords(store).read(asset.index).alignment
    how = "engine {engine}, {model}, starts {search}".format_map(asset.columns)
    subtitle = f"{amount(len(asset.coords), 'SLAT voxel')}   {how}"
    finer = 1 if kind == "png" else 2
    with canvas.styled():
        figure = draw_alignment(scene, check, title, subtitle, alignment, finer)
        picture = canvas.in_format(figure, kind)
    return check.asset_id, picture, _cell(asset, scene, check) if on_sheet else None


def _cell(asset: StoredAsset, scene: Scene, check: AlignmentCheck) -> _Cell:
    view = views(scene, _THUMBNAIL)[0]
    images = *outlined(scene, view, scene.placed), error_picture(scene, view)
    return _Cell(check, title_of(asset), np.concatenate(images, axis=1))


def _sheet(cells: Sequence[_Cell]) -> bytes:
    """Draw cells, in their order, as one PNG."""
    columns = min(_ACROSS, max(len(cells), 2))
    rows = -(-len(cells) // columns)
    width = 2 * _MARGIN + columns * (_CELL_WIDTH + _GAP) - _GAP
    height = _HEAD + rows * _CELL_HEIGHT + _MARGIN

    with canvas.styled():
        figure = canvas.new_figure(width, height)
        canvas.write(figure, _MARGIN, 46, f"{len(cells)} alignments", weight="bold", size=12)
        words = "left: PixieVerse voxels by class, SLAT outlined; right: error per voxel, pale 0"
        canvas.note(figure, _MARGIN, 68, f"{words} to dark {FARTHEST:g} voxels")
        for number, (check, title, image) in enumerate(cells):
            row, column = divmod(number, columns)
            x, y = _MARGIN + column * (_CELL_WIDTH + _GAP), _HEAD + row * _CELL_HEIGHT
            canvas.draw_image(figure, x, y, image)
            line, bold = y + _THUMBNAIL + 16, {"size": 7.5, "weight": "bold"}
            canvas.write(figure, x, line, canvas.cut(title, _TITLE), **bold)
            right = {**bold, "color": canvas.VERDICT_COLOURS[check.verdict], "ha": "right"}
            canvas.write(figure, x + _CELL_WIDTH - _GAP, line, str(check.verdict), **right)
            canvas.note(figure, x, line + 17, check.asset_id[:40], 6.5)
            worse, sure = min(map(check.value, FITNESS)), check.value("confidence")
            words = f"confidence {sure:.3f}   fitness {worse:.3f} (the lower of both ways)"
            canvas.note(figure, x, line + 32, words, 6.5)
        return canvas.in_format(figure)


def title_of(asset: StoredAsset) -> str:
    """Return the title of an asset's picture: its category, if known, and its id."""
    category = str(asset.columns["category"]).replace("_", " ")
    return f"{category}: {asset.asset_id}" if category else asset.asset_id


def _write(path: Path, content: bytes) -> None:
    with writing("the picture (--picture says where, or none)", path), staged(path) as file:
        file.write_bytes(content)

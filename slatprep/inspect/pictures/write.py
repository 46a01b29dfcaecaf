"""Pictures of alignments as files: one for each, and a contact sheet of many."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from slatprep.errors import StoreError, amount
from slatprep.inspect.check import AlignmentCheck, check_alignment
from slatprep.inspect.pictures import canvas
from slatprep.inspect.pictures.alignment import draw_alignment, error_picture, outlined
from slatprep.inspect.pictures.scene import FARTHEST, Scene, scene_of, views
from slatprep.records import Place
from slatprep.storage.atomic import staged
from slatprep.storage.files import file_name
from slatprep.store.reader import Store, StoredAsset, open_store
from slatprep.store.records import StoredRecords
from slatprep.workers import Progress
from slatprep.workers.local import run_unordered

if TYPE_CHECKING:
    from PIL.Image import Image

SHEET = "sheet.png"
"""Name of the contact sheet in a folder of pictures."""

MOST = 60
"""Most assets on one sheet."""

_ACROSS = 4
_THUMBNAIL = 200
_MARGIN, _HEAD, _GAP = 40, 84, 20
_TITLE = 26
"""Most characters of a title beside the verdict."""
_CELL_WIDTH, _CELL_HEIGHT = 2 * _THUMBNAIL + _GAP, _THUMBNAIL + 66


def write_pictures(
    store: Store,
    checks: Sequence[AlignmentCheck],
    target: Path,
    *,
    jobs: int = 1,
    progress: Progress | None = None,
) -> tuple[list[Path], Path | None]:
    """Draw alignments as files; return the file of each asset, and the contact sheet if several.

    For a single asset `target` is a file with a suffix of `FORMATS`. Otherwise it is a folder for a
    PNG per asset, named by its id, and a contact sheet of the first `MOST`. StoreError if a file
    cannot be written, or a record cannot be read.
    """
    kind = target.suffix.lower()[1:]
    alone = len(checks) == 1 and kind in canvas.FORMATS
    shown = {check.asset_id: check for check in checks[:MOST]}
    drawn: dict[str, tuple[Scene, str]] = {}
    files = {
        check.asset_id: target if alone else target / f"{file_name(check.asset_id)}.png"
        for check in checks
    }
    tasks = ((store.path, check, kind if alone else "png") for check in checks)
    for done, (asset_id, picture, scene, title) in enumerate(run_unordered(_drawn, tasks, jobs), 1):
        _write(files[asset_id], picture)
        if asset_id in shown:
            drawn[asset_id] = scene, title
        if progress is not None:
            progress(done, len(checks))
    if len(checks) < 2:
        return list(files.values()), None
    scenes, titles = zip(*(drawn[asset_id] for asset_id in shown), strict=True)
    _write(target / SHEET, draw_sheet(scenes, list(shown.values()), titles))
    return list(files.values()), target / SHEET


def sheet_of(store: Store, asset_ids: Sequence[str]) -> bytes:
    """Draw a contact sheet of up to `MOST` assets of a store."""
    shown = [store.asset(asset_id) for asset_id in asset_ids[:MOST]]
    checks = [check_alignment(store, asset.asset_id) for asset in shown]
    return draw_sheet([scene_of(one) for one in shown], checks, [title_of(one) for one in shown])


def picture_of(asset: StoredAsset) -> Image:
    """Return an asset's picture, as `write_pictures` draws it."""
    import PIL.Image

    check = check_alignment(asset.store, asset.index)
    return PIL.Image.open(io.BytesIO(_drawn(asset.store.path, check, "png")[1]))


def _drawn(path: Place, check: AlignmentCheck, kind: str) -> tuple[str, bytes, Scene, str]:
    """Return an asset's id, its picture, and what a contact sheet shows of it."""
    store = open_store(path)
    asset = store.asset(check.asset_id)
    scene, title = scene_of(asset), title_of(asset)
    alignment = StoredRecords(store).of(check.asset_id).alignment
    with canvas.styled():
        finer = 1 if kind == "png" else 2
        figure = draw_alignment(scene, check, title, subtitle_of(asset), alignment, finer)
        return check.asset_id, canvas.in_format(figure, kind), scene, title


def draw_sheet(
    scenes: Sequence[Scene], checks: Sequence[AlignmentCheck], titles: Sequence[str]
) -> bytes:
    """Draw at most `MOST` alignments, in this order, as one PNG."""
    columns = min(_ACROSS, max(len(scenes), 2))
    rows = -(-len(scenes) // columns)
    width = 2 * _MARGIN + columns * (_CELL_WIDTH + _GAP) - _GAP
    height = _HEAD + rows * _CELL_HEIGHT + _MARGIN

    with canvas.styled():
        figure = canvas.new_figure(width, height)
        canvas.write(figure, _MARGIN, 46, f"{len(scenes)} alignments", weight="bold", size=12)
        canvas.write(
            figure, _MARGIN, 68, "left: PixieVerse voxels by class, SLAT outlined; "
            f"right: error per voxel, pale 0 to dark {FARTHEST:g} voxels",
            size=7, color=canvas.MUTED,
        )  # fmt: skip
        for number, (scene, check, title) in enumerate(zip(scenes, checks, titles, strict=True)):
            row, column = divmod(number, columns)
            x, y = _MARGIN + column * (_CELL_WIDTH + _GAP), _HEAD + row * _CELL_HEIGHT
            view = views(scene, _THUMBNAIL)[0]
            images = *outlined(scene, view, scene.placed), error_picture(scene, view)
            for k, image in enumerate(images):
                canvas.draw_image(figure, x + k * _THUMBNAIL, y, image)
            colour = canvas.VERDICT_COLOURS[check.verdict]
            line = y + _THUMBNAIL + 16
            canvas.write(figure, x, line, canvas.cut(title, _TITLE), size=7.5, weight="bold")
            right = {"size": 7.5, "weight": "bold", "color": colour, "ha": "right"}
            canvas.write(figure, x + _CELL_WIDTH - _GAP, line, str(check.verdict), **right)
            canvas.write(figure, x, line + 17, check.asset_id[:40], size=6.5, color=canvas.MUTED)
            worse = min(check.figure("fitness").value, check.figure("fitness_backward").value)
            sure = check.value("confidence")
            words = f"confidence {sure:.3f}   fitness {worse:.3f} (the lower of both ways)"
            canvas.write(figure, x, line + 32, words, size=6.5, color=canvas.MUTED)
        return canvas.in_format(figure)


def title_of(asset: StoredAsset) -> str:
    """Return the title of an asset's picture: its category where it is known, and its id."""
    category = str(asset.columns["category"]).replace("_", " ")
    return f"{category}: {asset.asset_id}" if category else asset.asset_id


def subtitle_of(asset: StoredAsset) -> str:
    """Return an asset's number of voxels and how it was aligned, in one line."""
    columns = asset.columns
    how = f"engine {columns['engine']}, {columns['model']}, starts {columns['search']}"
    return f"{amount(len(asset.coords), 'SLAT voxel')}   {how}"


def _write(path: Path, content: bytes) -> None:
    try:
        with staged(path) as file:
            file.write_bytes(content)
    except OSError as error:
        raise StoreError(
            f"the picture: cannot be written to {path} ({error.strerror or error}); make room "
            "there, or name another place with --picture, or --picture none"
        ) from error

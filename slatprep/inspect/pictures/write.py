"""Write pictures of alignments as files."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from slatprep.errors import StoreError, amount
from slatprep.inspect.check import AlignmentCheck, check_alignment
from slatprep.inspect.pictures.alignment import draw_alignment
from slatprep.inspect.pictures.canvas import FORMATS, STYLE, in_format
from slatprep.inspect.pictures.scene import Scene, scene_of
from slatprep.inspect.pictures.sheet import MOST, draw_sheet
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
    alone = len(checks) == 1 and kind in FORMATS
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
    import matplotlib.style

    store = open_store(path)
    asset = store.asset(check.asset_id)
    scene, title = scene_of(asset), title_of(asset)
    alignment = StoredRecords(store).of(check.asset_id).alignment
    # A user's matplotlibrc must not change the picture.
    with matplotlib.style.context(["default", STYLE]):
        finer = 1 if kind == "png" else 2
        figure = draw_alignment(scene, check, title, subtitle_of(asset), alignment, finer)
        return check.asset_id, in_format(figure, kind), scene, title


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

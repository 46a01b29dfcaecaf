"""Write the pictures of checked alignments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.inspect.check import AlignmentCheck
from slatprep.inspect.pictures.alignment import draw_alignment
from slatprep.inspect.pictures.canvas import FORMATS, STYLE, in_format
from slatprep.inspect.pictures.scene import Scene, scene_of
from slatprep.inspect.pictures.sheet import MOST, draw_sheet
from slatprep.provenance.stored import StoredRecords
from slatprep.storage.names import file_name
from slatprep.store.reader import Store, StoredAsset
from slatprep.workers import Progress

SHEET = "sheet.png"
"""Name of the contact sheet in a folder of pictures."""


def write_pictures(
    store: Store,
    checks: Sequence[AlignmentCheck],
    target: Path,
    *,
    progress: Progress | None = None,
) -> tuple[list[Path], Path | None]:
    """Draw alignments and write them as files.

    Parameters
    ----------
    store : Store
        The store.
    checks : sequence of AlignmentCheck
        The assets to draw, in the order of the contact sheet.
    target : Path
        A file that ends in the name of one of `FORMATS` for one asset, a folder otherwise: it gets
        a PNG an asset, named by its id, and a contact sheet of several.
    progress : callable, optional
        Called with the assets done and the assets in all.

    Returns
    -------
    pictures : list of Path
        The file of each asset.
    sheet : Path or None
        The contact sheet of the first `MOST` assets; None for one asset.

    Raises
    ------
    StoreError
        If a file cannot be written, or a record cannot be read.
    """
    import matplotlib.style

    kind = target.suffix.lower()[1:]
    alone = len(checks) == 1 and kind in FORMATS
    records = StoredRecords(store)
    pictures: list[Path] = []
    scenes: list[Scene] = []
    titles: list[str] = []
    for number, check in enumerate(checks):
        asset = store.asset(check.asset_id)
        scene, title = scene_of(asset), title_of(asset)
        alignment = records.of(check.asset_id).alignment
        # A user's matplotlibrc must not change the picture.
        with matplotlib.style.context(["default", STYLE]):
            finer = 2 if alone and kind != "png" else 1
            figure = draw_alignment(scene, check, title, subtitle_of(asset), alignment, finer)
            drawn = in_format(figure, kind if alone else "png")
        pictures.append(target if alone else target / f"{file_name(check.asset_id)}.png")
        _write(pictures[-1], drawn)
        if len(checks) > 1 and number < MOST:
            scenes.append(scene)
            titles.append(title)
        if progress is not None:
            progress(number + 1, len(checks))
    if not scenes:
        return pictures, None
    _write(target / SHEET, draw_sheet(scenes, checks[: len(scenes)], titles))
    return pictures, target / SHEET


def title_of(asset: StoredAsset) -> str:
    """Return what a picture calls an asset, whose id stands below: its category."""
    return str(asset.columns["category"]).replace("_", " ") or "category unknown"


def subtitle_of(asset: StoredAsset) -> str:
    """Return an asset's id, its size and how it was aligned, in one line."""
    columns = asset.columns
    how = f"engine {columns['engine']}, {columns['model']}, starts {columns['search']}"
    return f"{asset.asset_id}   {len(asset.coords):,} SLAT voxels   {how}"


def _write(path: Path, content: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    except OSError as error:
        raise StoreError(
            f"{path}: the picture cannot be written ({error.strerror}); name another place with "
            "--picture, or --picture none"
        ) from error

"""A contact sheet: for each of many alignments the two sides together, and the error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slatprep.inspect.check import AlignmentCheck
from slatprep.inspect.pictures import palette
from slatprep.inspect.pictures.alignment import error_picture, outlined
from slatprep.inspect.pictures.canvas import STYLE, in_format, new_figure, write
from slatprep.inspect.pictures.scene import FARTHEST, Scene, views

MOST = 60
"""Most assets on one sheet."""

_ACROSS = 4
_THUMBNAIL = 200
_MARGIN, _HEAD, _GAP = 40, 84, 20
_TITLE = 26
"""Most characters of a title beside the verdict."""
_CELL_WIDTH, _CELL_HEIGHT = 2 * _THUMBNAIL + _GAP, _THUMBNAIL + 66


def draw_sheet(
    scenes: Sequence[Scene], checks: Sequence[AlignmentCheck], titles: Sequence[str]
) -> bytes:
    """Draw at most `MOST` alignments, in this order, as one PNG."""
    import matplotlib.style

    columns = min(_ACROSS, max(len(scenes), 2))
    rows = -(-len(scenes) // columns)
    width = 2 * _MARGIN + columns * (_CELL_WIDTH + _GAP) - _GAP
    height = _HEAD + rows * _CELL_HEIGHT + _MARGIN

    with matplotlib.style.context(["default", STYLE]):
        figure = new_figure(width, height)
        write(figure, _MARGIN, 46, f"{len(scenes)} alignments", weight="bold", size=12)
        write(
            figure, _MARGIN, 68, "left: PixieVerse voxels by class, SLAT outlined; "
            f"right: error per voxel, pale 0 to dark {FARTHEST:g} voxels",
            size=7, color=palette.MUTED,
        )  # fmt: skip
        for number, (scene, check, title) in enumerate(zip(scenes, checks, titles, strict=True)):
            row, column = divmod(number, columns)
            x, y = _MARGIN + column * (_CELL_WIDTH + _GAP), _HEAD + row * _CELL_HEIGHT
            view = views(scene, _THUMBNAIL)[0]
            images = *outlined(scene, view, scene.placed), error_picture(scene, view)
            for k, image in enumerate(images):
                pixels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
                left, bottom = x + k * _THUMBNAIL, height - y - _THUMBNAIL
                figure.figimage(pixels, xo=left, yo=bottom, origin="upper")
            colour = palette.VERDICT_COLOURS[check.verdict]
            line = y + _THUMBNAIL + 16
            write(figure, x, line, _cut(title), size=7.5, weight="bold")
            write(figure, x + _CELL_WIDTH - _GAP, line, str(check.verdict), size=7.5, weight="bold",
                 color=colour, ha="right")  # fmt: skip
            write(figure, x, line + 17, check.asset_id[:40], size=6.5, color=palette.MUTED)
            worse = min(check.figure("fitness").value, check.figure("fitness_backward").value)
            sure = check.value("confidence")
            words = f"confidence {sure:.3f}   fitness {worse:.3f} (the lower of both ways)"
            write(figure, x, line + 32, words, size=6.5, color=palette.MUTED)
        return in_format(figure)


def _cut(title: str) -> str:
    return title if len(title) <= _TITLE else f"{title[: _TITLE - 1]}…"

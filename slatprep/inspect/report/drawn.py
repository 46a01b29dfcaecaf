"""Draw an asset as the page shows it: a thumbnail, and its voxels in a few kilobytes.

A thumbnail shows three directions; one image file holds many thumbnails. They are shaded by the
slope of the surface, unlike `slatprep.inspect.pictures.voxels.draw_voxels`. Along an axis of the
grid only one face of each cube is visible, and all faces would have the same tone. This is also
ten times as fast (3 ms per asset, not 30; 12 assets of 12,400 voxels). Palette indices make a
sheet a third as large as colours.

For the 3D view an asset is one stream of raw deflate (RFC 1951), which browsers can unpack. It
holds, for n voxels per edge and voxels in C order of the grid::

    n^3 / 8 bytes   occupancy of the SLAT, most significant bit first
    n^3 / 8 bytes   occupancy of the PixieVerse boundary, in its own frame
    N bytes each    class, each property, distance of the SLAT voxels
    K bytes         class of the boundary voxels

and for a deformed asset also::

    4 bytes         a step in edges of the cube, float32, little-endian
    3 K bytes       displacement of the centre of each boundary voxel along x, y and z of its
                    own frame before the transform, int8, in steps

Properties are quantised to `LEVELS` steps over [-1, 1], and distances over 0 to the largest
allowed distance. 255 means not valid, also for a class.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.deformation import PlaceMap
from slatprep.geometry.frames import apply_transform, invert_transform, voxel_centres
from slatprep.geometry.voxels import boundary, filled
from slatprep.inspect.tallies import Tally, tally
from slatprep.pipeline.rows import SourceStore
from slatprep.records import COLOURS, RESOLUTION, UNANNOTATED
from slatprep.store import StoredAsset

VIEWS = 3
"""Number of views: from the front (along +y), from the right (-x) and from above (-z)."""

PER_SHEET = 64
"""Number of pictures in one image file."""

COLUMNS = 8
"""Number of pictures side by side in an image file."""

SHADES = 8
"""Number of steps of brightness."""

CLASSES = 30
"""Number of classes with a colour of their own."""

SIDE = RESOLUTION + 6
"""Number of pixels along each edge of a view, margin included."""

_BRIGHTEST, _DARKEST = 1.12, 0.5
_LIGHT = (-0.35, -0.5, 0.79)  # from above left: columns, rows, towards the viewer
_SMOOTHING = 5

LEVELS = 64
"""Number of steps of a quantised property or distance, finer than a colour scale can show."""

FULL, COARSE = RESOLUTION, RESOLUTION // 2
"""Number of voxels per edge at the two levels of detail."""

BINS = 64
"""Number of bins of the histograms of normalised properties, over [-1, 1]."""


@dataclass(frozen=True)
class Drawn:
    """A drawn asset of the store: thumbnail, and voxels by level of detail.

    For merged labels, ``votes`` is the mean share of votes for a voxel's class. ``spreads`` has the
    mean spread of each normalised property, NaN if no voxel has a spread.
    """

    index: int
    thumbnail: NDArray[np.uint8]
    voxels: dict[int, bytes]
    votes: float = np.nan
    spreads: tuple[float, ...] = ()


def draw_asset(store: SourceStore, row: int) -> tuple[Drawn, Tally]:
    """Draw an asset of a store and tally its voxels, in a worker."""
    asset = store.asset(row)
    way = store.records.place_map(asset)
    voxels = {side: encode_asset(asset, way, side) for side in (FULL, COARSE)}
    field = asset.grid_material, asset.grid_properties
    slat = asset.material, asset.properties
    counts = tally(store, field, slat, BINS)
    return Drawn(row, thumbnail(asset), voxels, *_agreement(asset)), counts


def _agreement(asset: StoredAsset) -> tuple[float, tuple[float, ...]]:
    """Return the ``votes`` and ``spreads`` of `Drawn`; NaN and () if labels are not merged."""
    if not asset.merged or not asset.valid.any():
        return np.nan, ()
    spread = np.ma.masked_invalid(asset.spread.astype(np.float64)).mean(axis=0)
    votes = asset.votes[asset.valid].mean(dtype=np.float64)
    return float(votes), tuple(spread.filled(np.nan).tolist())


def thumbnail(asset: StoredAsset) -> NDArray[np.uint8]:
    """Draw the SLAT voxels of an asset from three directions, (SIDE, 3 * SIDE), in `palette`."""
    grid = np.zeros((RESOLUTION,) * 3, dtype=np.uint8)
    # A PNG's palette has 256 colours, so classes beyond `CLASSES` share colours.
    colour = np.where(asset.material == UNANNOTATED, CLASSES, asset.material % CLASSES)
    cells, row = asset.cells
    grid[tuple(cells.T.astype(np.intp))] = 1 + colour[row]
    views = (
        grid.transpose(1, 2, 0)[:, ::-1, :],  # depth y, rows from z = 63 down, columns x
        grid.transpose(0, 2, 1)[::-1, ::-1, :],  # depth from x = 63 down, columns y
        grid.transpose(2, 1, 0)[::-1, ::-1, :],  # depth from z = 63 down, rows from y = 63 down
    )
    return np.concatenate([_project(view) for view in views], axis=1)


def sheet(pictures: Sequence[NDArray[np.uint8]]) -> bytes:
    """Return up to `PER_SHEET` thumbnails as one PNG, `COLUMNS` side by side."""
    from PIL import Image

    rows = -(-len(pictures) // COLUMNS)
    cells = np.zeros((rows * COLUMNS, SIDE, SIDE * VIEWS), dtype=np.uint8)
    cells[: len(pictures)] = pictures
    canvas = cells.reshape(rows, COLUMNS, *cells.shape[1:]).swapaxes(1, 2)
    image = Image.fromarray(canvas.reshape(rows * SIDE, -1), mode="P")
    image.putpalette(palette().tobytes())
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True, transparency=0)
    return file.getvalue()


def palette() -> NDArray[np.uint8]:
    """Return the colours (249, 3): background, each class from dark to bright, not annotated."""
    rgb = COLOURS[[*range(CLASSES), UNANNOTATED]]
    shades = np.linspace(_DARKEST, _BRIGHTEST, SHADES)
    shaded = np.minimum(rgb[:, None, :] * shades[None, :, None], 255)
    return np.concatenate([np.zeros((1, 3)), shaded.reshape(-1, 3)]).round().astype(np.uint8)


def _project(view: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the nearest voxel's palette index for a view (depth, rows, columns)."""
    hit: NDArray[np.bool_] = np.any(view, axis=0)
    depth = np.argmax(view > 0, axis=0)
    nearest = np.take_along_axis(view, depth[None], axis=0)[0].astype(np.intp)
    shade = np.round(_brightness(depth, hit) * (SHADES - 1)).astype(np.intp)
    index = np.where(hit, 1 + (nearest - 1) * SHADES + shade, 0)
    return np.pad(index, (SIDE - RESOLUTION) // 2).astype(np.uint8)


def _brightness(depth: NDArray[np.intp], hit: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the brightness of each pixel by Lambert's law, 0..1."""
    from scipy.ndimage import uniform_filter

    # Slopes come from an averaged depth: steps of whole voxels would show as stripes.
    weight = uniform_filter(hit.astype(np.float64), _SMOOTHING)
    smooth = uniform_filter(np.where(hit, depth, 0).astype(np.float64), _SMOOTHING)
    smooth /= np.maximum(weight, 1e-9)
    down, right = np.gradient(np.where(hit, smooth, 0.0))
    # At the outline there is no neighbouring depth to compare with.
    inside = uniform_filter(hit.astype(np.float64), 3) > 1.0 - 1e-9
    down, right = np.where(inside, down, 0.0), np.where(inside, right, 0.0)
    light = _LIGHT[0] * right + _LIGHT[1] * down + _LIGHT[2]
    lambert: NDArray[np.float64] = light / np.sqrt(right**2 + down**2 + 1.0)
    return np.clip(lambert, 0.0, 1.0)


def encode_asset(asset: StoredAsset, way: PlaceMap, side: int) -> bytes:
    """Return an asset's voxels for the 3D view, in the format that this module describes.

    `way` maps between its frames. `side` is `FULL`, or `COARSE` for cells of 2 x 2 x 2 voxels.
    """
    cells, row = asset.cells
    first, occupied = _cells(cells, side)
    first = row[first]
    occupancy = asset.grid_material != asset.store.contents.background
    surface = boundary(filled(occupancy)) & occupancy  # outer surface alone
    grid, material = np.argwhere(surface), asset.grid_material[surface]
    chosen, grid_occupied = _cells(grid, side)
    farthest = asset.store.about.build.parameters.sample.max_distance
    distance = asset.distance[first] / farthest
    # Voxels that are not valid have NaN properties.
    scalars = np.column_stack([(asset.properties[first] + 1.0) / 2.0, distance])
    parts = [
        occupied,
        grid_occupied,
        asset.material[first].tobytes(),
        *(_quantised(column).tobytes() for column in scalars.T),
        material[chosen].tobytes(),
    ]
    if way.deformation is not None:
        centres = voxel_centres(grid[chosen])
        moved = apply_transform(invert_transform(way.transform), way.to_slat(centres)) - centres
        step = np.float32(max(np.abs(moved).max(), 1e-6) / 127)
        parts += [step.tobytes(), np.rint(moved / step).astype(np.int8).tobytes()]
    deflate = zlib.compressobj(6, zlib.DEFLATED, -zlib.MAX_WBITS)
    return deflate.compress(b"".join(parts)) + deflate.flush()


def _cells(voxels: NDArray[np.integer], side: int) -> tuple[NDArray[np.intp], bytes]:
    """Return the index of the first voxel in each occupied cell, and occupancy bits, in C order."""
    cells = voxels.astype(np.intp) // (RESOLUTION // side)
    flat, first = np.unique(np.ravel_multi_index(tuple(cells.T), (side,) * 3), return_index=True)
    occupancy = np.zeros(side**3, dtype=bool)
    occupancy[flat] = True
    return first, np.packbits(occupancy).tobytes()


def _quantised(share: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return shares in 0..1, quantised to `LEVELS` steps; NaN becomes `UNANNOTATED`."""
    known = np.isfinite(share)
    steps = np.round(np.clip(np.where(known, share, 0.0), 0.0, 1.0) * (LEVELS - 1))
    return np.where(known, steps, UNANNOTATED).astype(np.uint8)

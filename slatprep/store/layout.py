"""What lies where in the store: arrays, chunks, shards.

The tables of arrays are `ARRAYS` and `MERGED`; writer and reader take names, types and
shapes from them. Rows of ``voxel/*`` and ``grid/*`` are cut into shards by
`row_ranges`, and `overlaps` says which assets lie in one.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from slatprep.parameters import MAX_VOXEL_SHARD, StoreParameters
from slatprep.records import BACKGROUND, RESOLUTION, UNANNOTATED

FORMAT = "slatprep-store"
FORMAT_VERSION = 1
"""The format that is written and read."""

ASSET_CHUNK = 65_536
"""Assets in one chunk of the ``asset/*`` arrays."""

RECORD_ARRAY = "asset/record"
"""The record of each row, as JSON. It is replaced in one step with the arrays it belongs to, the
lines of ``assets.jsonl`` are made from it, and it is what the next build compares with."""

MAX_RECORD_BYTES = 2**20
"""No record is larger; most take some 10 kB."""

RECORDS_IN_CHUNK = 64
RECORDS_IN_SHARD = 1024
"""About 10 MB of text: what the parent holds at a time."""

NAN = float("nan")


@dataclass(frozen=True)
class ArrayLayout:
    """One array of the store: its type, its dimensions, what it means and how it is packed.

    `packing` is ``zstd``, the smallest, or what unpacks fastest: ``repeats``
    for values that recur, ``columns`` for rows of three bytes of which two
    recur, ``exponents`` for floats of which little else recurs. An `internal` array
    is kept for the next build, and describes no asset to a reader.
    """

    name: str
    dtype: str
    dimensions: tuple[str, ...]
    fill_value: float | bool | str
    description: str
    unit: str = ""
    packing: str = "zstd"
    internal: bool = False


_XYZ = ("x", "y", "z")

ARRAYS = (
    ArrayLayout("asset/id", "str", ("asset",), "", "id of the row, ascending within a segment"),
    ArrayLayout("asset/object_id", "str", ("asset",), "", "PixieVerse id of the object"),
    ArrayLayout("asset/view", "str", ("asset",), "", "image or seed the SLAT was made from"),
    ArrayLayout("asset/category", "str", ("asset",), "", "PixieVerse category, empty if unknown"),
    ArrayLayout(
        "asset/offset",
        "int64",
        ("asset_edge",),
        0,
        "asset a owns rows offset[a]:offset[a+1] of voxel/*",
    ),
    ArrayLayout(
        "asset/transform",
        "float64",
        ("asset", "row", "column"),
        NAN,
        "PixieVerse frame to SLAT frame, both the unit cube [-0.5, 0.5]^3",
    ),
    ArrayLayout("asset/engine", "str", ("asset",), "", "alignment engine"),
    ArrayLayout("asset/model", "str", ("asset",), "", "rigid, similarity, affine or deformable"),
    ArrayLayout("asset/search", "str", ("asset",), "", "starts that were needed"),
    ArrayLayout(
        "asset/fitness",
        "float64",
        ("asset",),
        NAN,
        "share of PixieVerse boundary voxels with a SLAT voxel within the radius",
    ),
    ArrayLayout("asset/inlier_rmse", "float64", ("asset",), NAN, "rms distance of those", "voxel"),
    ArrayLayout(
        "asset/fitness_backward",
        "float64",
        ("asset",),
        NAN,
        "share of SLAT voxels with a PixieVerse boundary voxel within the radius",
    ),
    ArrayLayout(
        "asset/inlier_rmse_backward", "float64", ("asset",), NAN, "rms distance of those", "voxel"
    ),
    ArrayLayout("asset/overlap", "float64", ("asset",), NAN, "overlap of the two voxel surfaces"),
    ArrayLayout(
        "asset/margin", "float64", ("asset",), NAN, "score above the next distinct placement"
    ),
    ArrayLayout(
        "asset/ambiguity",
        "float64",
        ("asset",),
        NAN,
        "share of SLAT voxels whose class differs between placements that fit about as well",
    ),
    ArrayLayout(
        "asset/property_ambiguity",
        "float64",
        ("asset", "property"),
        NAN,
        "mean change of each normalised property between placements that fit about as well",
    ),
    ArrayLayout("asset/valid_share", "float64", ("asset",), NAN, "share of valid SLAT voxels"),
    ArrayLayout(
        "asset/unphysical",
        "int64",
        ("asset",),
        0,
        "PixieVerse voxels left out, as no material has their properties",
    ),
    ArrayLayout("asset/verdict", "str", ("asset",), "", "good, doubtful or failed"),
    ArrayLayout(
        "asset/confidence",
        "float64",
        ("asset",),
        NAN,
        "same_object times right_placement",
    ),
    ArrayLayout(
        "asset/same_object",
        "float64",
        ("asset",),
        NAN,
        "calibrated probability that both sides show the same object",
    ),
    ArrayLayout(
        "asset/right_placement",
        "float64",
        ("asset",),
        NAN,
        "calibrated probability that the placement is right if the object is the same",
    ),
    ArrayLayout(
        "asset/expected_accuracy",
        "float64",
        ("asset",),
        NAN,
        "share of right classes to be expected among valid voxels",
    ),
    ArrayLayout(
        "asset/contradicted",
        "bool",
        ("asset",),
        False,
        "the latents contradict the labels, where latents were compared with them",
    ),
    ArrayLayout(
        "asset/merged",
        "bool",
        ("asset",),
        False,
        "labels are merged of several annotations",
        internal=True,
    ),
    ArrayLayout(
        "asset/key",
        "uint8",
        ("asset", "byte"),
        0,
        "what decides the row, as one hash: sources, parameters, libraries and code",
        internal=True,
    ),
    ArrayLayout(
        "asset/record_sha256",
        "uint8",
        ("asset", "byte"),
        0,
        "SHA-256 of asset/record",
        internal=True,
    ),
    ArrayLayout(
        "asset/extent",
        "float64",
        ("asset", "property", "bound"),
        NAN,
        "least and most of each property of its fields, log10 where the property is mapped so",
        internal=True,
    ),
    ArrayLayout(
        "asset/clipped",
        "int64",
        ("asset", "property"),
        0,
        "values of voxel/properties outside the range",
        internal=True,
    ),
    ArrayLayout(
        "asset/clipped_grid",
        "int64",
        ("asset", "property"),
        0,
        "values of grid/properties outside the range",
        internal=True,
    ),
    ArrayLayout(
        "asset/latent_mean",
        "float64",
        ("asset", "latent"),
        NAN,
        "mean of each channel of its latents",
        internal=True,
    ),
    ArrayLayout(
        "asset/latent_std",
        "float64",
        ("asset", "latent"),
        NAN,
        "standard deviation of each channel of its latents",
        internal=True,
    ),
    ArrayLayout(
        "voxel/coords",
        "uint8",
        ("voxel", "axis"),
        0,
        "SLAT coordinate, source order",
        packing="columns",
    ),
    ArrayLayout(
        "voxel/feats",
        "float32",
        ("voxel", "latent"),
        0.0,
        "SLAT latents, unchanged",
        packing="exponents",
    ),
    ArrayLayout(
        "voxel/properties",
        "float32",
        ("voxel", "property"),
        NAN,
        "normalised properties in [-1, 1], NaN where not valid",
        packing="repeats",
    ),
    ArrayLayout(
        "voxel/material",
        "uint8",
        ("voxel",),
        UNANNOTATED,
        "class, 255 where not valid",
        packing="repeats",
    ),
    ArrayLayout(
        "voxel/valid",
        "bool",
        ("voxel",),
        False,
        "an annotation was found near enough",
        packing="repeats",
    ),
    ArrayLayout(
        "voxel/distance",
        "float32",
        ("voxel",),
        NAN,
        "distance to the annotation used",
        "voxel",
        packing="exponents",
    ),
    ArrayLayout(
        "voxel/place",
        "float32",
        ("voxel", "axis"),
        NAN,
        "where it was looked up, in the PixieVerse frame's unit cube [-0.5, 0.5]^3",
        packing="exponents",
    ),
    ArrayLayout(
        "voxel/confidence",
        "float32",
        ("voxel",),
        NAN,
        "calibrated probability that the class is right, 0 where not valid",
        packing="exponents",
    ),
    ArrayLayout(
        "grid/properties",
        "float32",
        ("asset", "property", *_XYZ),
        NAN,
        "normalised PixieVerse field in [-1, 1], NaN where not annotated",
    ),
    ArrayLayout(
        "grid/material",
        "uint8",
        ("asset", *_XYZ),
        BACKGROUND,
        "class, 255 occupied but not annotated, background 7 or the store's attribute background",
    ),
)
"""Every array of any store."""

MERGED = (
    ArrayLayout(
        "voxel/spread",
        "float32",
        ("voxel", "property"),
        NAN,
        "standard deviation of normalised properties over the annotations, NaN where not several",
        packing="exponents",
    ),
    ArrayLayout(
        "voxel/votes",
        "float32",
        ("voxel",),
        NAN,
        "share of the annotations that give the class, 0 where not valid, NaN where not several",
        packing="repeats",
    ),
)
"""Further arrays of a store in which labels of any asset are merged of several annotations."""


MERGED_COLUMNS = tuple(layout.name.removeprefix("voxel/") for layout in MERGED)
"""Last names of the arrays of `MERGED`."""


def arrays_with(merged: bool) -> tuple[ArrayLayout, ...]:
    """Return every array of a store that is written, whether or not it has `MERGED`."""
    return (*ARRAYS, *MERGED) if merged else ARRAYS


FIXED_SIZES = {
    "row": 4,
    "column": 4,
    "axis": 3,
    "byte": 32,
    "bound": 2,
    **dict.fromkeys(_XYZ, RESOLUTION),
}
"""Dimensions that are the same in every store."""


MOST_SHARDS = 32
"""Shards of a voxel array of a store that is not very large. An update writes the last one anew,
and a reader keeps so many open."""

_CHUNKS_IN_SHARD = 64, 4_096
"""Least and most chunks of a shard where parameters name no number. Of the usual chunks these are
some 10 and 700 MB in all arrays together."""


def rows_per_shard(parameters: StoreParameters, n_voxels: int) -> int:
    """Return how many voxel rows one shard holds, in a store of so many.

    Where parameters do not say, it is a power of two of chunks, so that updates seldom change it.
    """
    chunks = parameters.voxel_chunks_per_shard
    if not chunks:
        least, most = _CHUNKS_IN_SHARD
        wanted = -(-n_voxels // (MOST_SHARDS * parameters.voxel_chunk))
        chunks = min(max(1 << (wanted - 1).bit_length(), least), most)
        chunks = min(chunks, MAX_VOXEL_SHARD // parameters.voxel_chunk)
    return parameters.voxel_chunk * chunks


def row_ranges(total: int, per_shard: int) -> Iterator[tuple[int, int]]:
    """Yield the rows ``(start, stop)`` of each shard, in order.

    >>> list(row_ranges(5, 2))
    [(0, 2), (2, 4), (4, 5)]
    """
    for start in range(0, total, per_shard):
        yield start, min(start + per_shard, total)


def overlaps(offsets: Sequence[int], start: int, stop: int) -> Iterator[tuple[int, slice]]:
    """Yield which assets own the rows ``start:stop``, and which of their own rows those are.

    Asset a owns rows ``offsets[a]:offsets[a+1]``.

    >>> list(overlaps([0, 3, 5], 2, 4))
    [(0, slice(2, 3, None)), (1, slice(0, 1, None))]
    """
    asset = max(bisect_right(offsets, start) - 1, 0)
    while asset + 1 < len(offsets) and offsets[asset] < stop:
        first, last = max(offsets[asset], start), min(offsets[asset + 1], stop)
        if first < last:
            yield asset, slice(first - offsets[asset], last - offsets[asset])
        asset += 1

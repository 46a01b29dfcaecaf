"""What lies where in the store: arrays, chunks, shards.

The tables of arrays are `ARRAYS` and `MERGED`; writer and reader take names, types and
shapes from them. Rows of ``voxel/*`` and ``grid/*`` are cut into shards by
`row_ranges`, and `overlaps` says which assets lie in one.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from slatprep.parameters import MAX_VOXEL_SHARD, StoreParameters
from slatprep.records import BACKGROUND, RESOLUTION, UNANNOTATED

FORMAT = "slatprep-store"
FORMAT_VERSION = 1
"""The format that is written and read."""

ASSET_CHUNK = 65_536
"""Assets in one chunk of the ``asset/*`` arrays."""

FILE = "file"
"""Group of the digests."""

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

_EMPTY: dict[str, float | bool | str] = {
    "str": "",
    "float64": NAN,
    "float32": NAN,
    "int64": 0,
    "uint8": 0,
    "bool": False,
}
"""What an array of a type has where nothing is written, if it does not say otherwise."""


def _asset(
    name: str, description: str, dtype: str = "float64", of: str = "", **more: Any
) -> ArrayLayout:
    """Return an array of ``asset/*``; `of` are its dimensions behind the first."""
    dimensions = ("asset", *of.split())
    return ArrayLayout(f"asset/{name}", dtype, dimensions, _EMPTY[dtype], description, **more)


def _voxel(
    name: str,
    packing: str,
    description: str,
    dtype: str = "float32",
    of: str = "",
    fill_value: float | None = None,
    unit: str = "",
) -> ArrayLayout:
    """Return an array of ``voxel/*``; `of` are its dimensions behind the first."""
    empty = _EMPTY[dtype] if fill_value is None else fill_value
    return ArrayLayout(
        f"voxel/{name}", dtype, ("voxel", *of.split()), empty, description, unit, packing
    )


ARRAYS = (
    _asset("id", "id of the row, ascending within a segment", dtype="str"),
    _asset("object_id", "PixieVerse id of the object", dtype="str"),
    _asset("view", "image or seed the SLAT was made from", dtype="str"),
    _asset("category", "PixieVerse category, empty if unknown", dtype="str"),
    ArrayLayout(
        "asset/offset",
        "int64",
        ("asset_edge",),
        0,
        "asset a owns rows offset[a]:offset[a+1] of voxel/*",
    ),
    _asset(
        "transform",
        "PixieVerse frame to SLAT frame, both the unit cube [-0.5, 0.5]^3",
        of="row column",
    ),
    _asset("engine", "alignment engine", dtype="str"),
    _asset("model", "rigid, similarity, affine or deformable", dtype="str"),
    _asset("search", "starts that were needed", dtype="str"),
    _asset("fitness", "share of PixieVerse boundary voxels with a SLAT voxel within the radius"),
    _asset("inlier_rmse", "rms distance of those", unit="voxel"),
    _asset(
        "fitness_backward",
        "share of SLAT voxels with a PixieVerse boundary voxel within the radius",
    ),
    _asset("inlier_rmse_backward", "rms distance of those", unit="voxel"),
    _asset("overlap", "overlap of the two voxel surfaces"),
    _asset("margin", "score above the next distinct placement"),
    _asset(
        "ambiguity",
        "share of SLAT voxels whose class differs between placements that fit about as well",
    ),
    _asset(
        "property_ambiguity",
        "mean change of each normalised property between placements that fit about as well",
        of="property",
    ),
    _asset("valid_share", "share of valid SLAT voxels"),
    _asset(
        "unphysical",
        "PixieVerse voxels left out, as no material has their properties",
        dtype="int64",
    ),
    _asset("verdict", "good, doubtful or failed", dtype="str"),
    _asset("confidence", "same_object times right_placement"),
    _asset("same_object", "calibrated probability that both sides show the same object"),
    _asset(
        "right_placement",
        "calibrated probability that the placement is right if the object is the same",
    ),
    _asset("expected_accuracy", "share of right classes to be expected among valid voxels"),
    _asset(
        "contradicted",
        "the latents contradict the labels, where latents were compared with them",
        dtype="bool",
    ),
    _asset("merged", "labels are merged of several annotations", dtype="bool", internal=True),
    _asset(
        "key",
        "what decides the row, as one hash: sources, parameters, libraries and code",
        dtype="uint8",
        of="byte",
        internal=True,
    ),
    _asset("record_sha256", "SHA-256 of asset/record", dtype="uint8", of="byte", internal=True),
    _asset(
        "extent",
        "least and most of each property of its fields, log10 where the property is mapped so",
        of="property bound",
        internal=True,
    ),
    _asset(
        "clipped",
        "values of voxel/properties outside the range",
        dtype="int64",
        of="property",
        internal=True,
    ),
    _asset(
        "clipped_grid",
        "values of grid/properties outside the range",
        dtype="int64",
        of="property",
        internal=True,
    ),
    _asset("latent_mean", "mean of each channel of its latents", of="latent", internal=True),
    _asset(
        "latent_std",
        "standard deviation of each channel of its latents",
        of="latent",
        internal=True,
    ),
    _voxel("coords", "columns", "SLAT coordinate, source order", dtype="uint8", of="axis"),
    _voxel("feats", "exponents", "SLAT latents, unchanged", of="latent", fill_value=0.0),
    _voxel(
        "properties",
        "repeats",
        "normalised properties in [-1, 1], NaN where not valid",
        of="property",
    ),
    _voxel(
        "material", "repeats", "class, 255 where not valid", dtype="uint8", fill_value=UNANNOTATED
    ),
    _voxel("valid", "repeats", "an annotation was found near enough", dtype="bool"),
    _voxel("distance", "exponents", "distance to the annotation used", unit="voxel"),
    _voxel(
        "place",
        "exponents",
        "where it was looked up, in the PixieVerse frame's unit cube [-0.5, 0.5]^3",
        of="axis",
    ),
    _voxel(
        "confidence",
        "exponents",
        "calibrated probability that the class is right, 0 where not valid",
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
    _voxel(
        "spread",
        "exponents",
        "standard deviation of normalised properties over the annotations, NaN where not several",
        of="property",
    ),
    _voxel(
        "votes",
        "repeats",
        "share of the annotations that give the class, 0 where not valid, NaN where not several",
    ),
)
"""Further arrays of a store in which labels of any asset are merged of several annotations."""


RECORDS = ArrayLayout(RECORD_ARRAY, "str", ("asset",), "", "provenance of the row, as JSON")

FILES = (
    ArrayLayout(f"{FILE}/name", "str", ("file",), "", "file below the store, with forward slashes"),
    ArrayLayout(f"{FILE}/size", "int64", ("file",), 0, "bytes"),
    ArrayLayout(f"{FILE}/sha256", "str", ("file",), "", "SHA-256 in hex"),
)
"""Digests of the store's files; see `slatprep.store.digests`."""

LAYOUTS = {layout.name: layout for layout in (*ARRAYS, *MERGED, RECORDS, *FILES)}
"""Every array that a store may have, by name, but for the coordinates of its dimensions."""

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

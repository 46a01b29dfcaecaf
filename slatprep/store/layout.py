"""Layout of the store: arrays, chunks, shards.

`ARRAYS` and `MERGED` list the arrays; writer and reader take names, types and
shapes from them. `row_ranges` cuts rows of ``voxel/*`` and ``grid/*`` into shards, and `overlaps`
finds the assets in a shard.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from slatprep.parameters import MAX_VOXEL_SHARD, StoreParameters
from slatprep.records import BACKGROUND, RESOLUTION, UNANNOTATED

FORMAT = "slatprep-store"
FORMAT_VERSION = 1
"""Version of the format that is written and read."""

ASSET_CHUNK = 65_536
"""Number of assets in one chunk of the ``asset/*`` arrays."""

FILE = "file"
"""Group of the arrays of digests."""

RECORD_ARRAY = "asset/record"
"""Array of each row's record, as JSON. It is replaced in one step with the arrays it belongs to.
The lines of ``assets.jsonl`` are made from it, and the next build compares with it."""

MAX_RECORD_BYTES = 2**20
"""Largest size of a record; most take some 10 kB."""

RECORDS_IN_CHUNK = 64
RECORDS_IN_SHARD = 1024
"""Number of records in a shard: about 10 MB of text, which the parent holds at a time."""

NAN = float("nan")


@dataclass(frozen=True)
class ArrayLayout:
    """One array of the store: its type, dimensions, meaning and packing.

    `packing` ``zstd`` takes the least space. The others unpack fastest: ``repeats`` values that
    recur, ``columns`` rows of three bytes of which two recur, ``exponents`` floats that share
    little but exponents. An `internal` array serves the next build and describes no asset to a
    reader.
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

_EMPTY: dict[str, Any] = {"str": "", "float64": NAN, "float32": NAN, "bool": False}
"""Fill value by type; other types have 0, unless an array has its own."""


def _asset(name: str, dtype: str, description: str, of: str = "", **more: Any) -> ArrayLayout:
    """Return an array of ``asset/*``; `of` names its dimensions after the first."""
    dimensions = ("asset", *of.split())
    return ArrayLayout(
        f"asset/{name}", dtype, dimensions, _EMPTY.get(dtype, 0), description, **more
    )


_kept = partial(_asset, internal=True)


def _voxel(
    name: str, packing: str, dtype: str, description: str, of: str = "", **more: Any
) -> ArrayLayout:
    """Return an array of ``voxel/*``; `of` names its dimensions after the first."""
    more = {"fill_value": _EMPTY.get(dtype, 0), "packing": packing, **more}
    dimensions = ("voxel", *of.split())
    return ArrayLayout(f"voxel/{name}", dtype, dimensions, description=description, **more)


ARRAYS = (
    _asset("id", "str", "id of the row, ascending within a segment"),
    _asset("object_id", "str", "PixieVerse id of the object"),
    _asset("view", "str", "image or seed the SLAT was made from"),
    _asset("category", "str", "PixieVerse category, empty if unknown"),
    ArrayLayout("asset/offset", "int64", ("asset_edge",), 0,
        "asset a owns rows offset[a]:offset[a+1] of voxel/*"),
    _asset("transform", "float64",
        "PixieVerse frame to SLAT frame, both the unit cube [-0.5, 0.5]^3", "row column"),
    _asset("engine", "str", "alignment engine"),
    _asset("model", "str", "rigid, similarity, affine or deformable"),
    _asset("search", "str", "starts that were needed"),
    _asset("fitness", "float64",
        "share of PixieVerse's outer boundary voxels with one of the SLAT's within the radius, "
        "before any deformation"),
    _asset("inlier_rmse", "float64", "rms distance of those", unit="voxel"),
    _asset("fitness_backward", "float64",
        "share of the SLAT's outer boundary voxels with one of PixieVerse's within the radius, "
        "before any deformation"),
    _asset("inlier_rmse_backward", "float64", "rms distance of those", unit="voxel"),
    _asset("overlap", "float64", "overlap of the two voxel surfaces, before any deformation"),
    _asset("margin", "float64",
        "score above the next distinct placement; below 0 where another beats a stated frame"),
    _asset("ambiguity", "float64",
        "share of SLAT voxels whose labels differ between placements that fit about as well"),
    _asset("property_ambiguity", "float64",
        "mean change of each normalised property between placements that fit about as well",
        "property"),
    _asset("valid_share", "float64", "share of valid SLAT voxels"),
    _asset("unphysical", "int64",
        "PixieVerse voxels left out, as no material has their properties"),
    _asset("verdict", "str", "good, doubtful or failed"),
    _asset("confidence", "float64", "same_object times right_placement"),
    _asset("same_object", "float64", "calibrated probability that both sides show the same object"),
    _asset("right_placement", "float64",
        "calibrated probability that the placement is right if the object is the same"),
    _asset("expected_accuracy", "float64",
        "share of right classes to be expected among valid voxels"),
    _asset("contradicted", "bool",
        "the latents contradict the labels, where latents were compared with them"),
    _asset("unusual", "str",
        "what is unusual of its values, masks, places or latents, a line each; else empty"),
    _kept("merged", "bool", "labels are merged of several annotations"),
    _kept("key", "uint8",
        "what decides the row, as one hash: sources, parameters, libraries and code", "byte"),
    _kept("record_sha256", "uint8", "SHA-256 of asset/record", "byte"),
    _kept("extent", "float64",
        "least and most of each property of its fields, log10 where the property is mapped so",
        "property bound"),
    _kept("clipped", "int64", "values of voxel/properties outside the range", "property"),
    _kept("clipped_grid", "int64", "values of grid/properties outside the range", "property"),
    _kept("latent_mean", "float64", "mean of each channel of its latents", "latent"),
    _kept("latent_std", "float64", "standard deviation of each channel of its latents", "latent"),
    _voxel("coords", "columns", "uint8", "SLAT coordinate, source order", "axis"),
    _voxel("feats", "exponents", "float32", "SLAT latents, unchanged", "latent", fill_value=0.0),
    _voxel("properties", "repeats", "float32",
        "normalised properties in [-1, 1], NaN where not valid", "property"),
    _voxel("material", "repeats", "uint8", "class, 255 where not valid", fill_value=UNANNOTATED),
    _voxel("valid", "repeats", "bool", "an annotation was found near enough"),
    _voxel("distance", "exponents", "float32", "distance to the annotation used", unit="voxel"),
    _voxel("place", "exponents", "float32",
        "where it was looked up, in the PixieVerse frame's unit cube [-0.5, 0.5]^3", "axis"),
    _voxel("confidence", "exponents", "float32",
        "calibrated probability that the class is right (without classes: the properties), "
        "0 where not valid"),
    ArrayLayout("grid/properties", "float32", ("asset", "property", *_XYZ), NAN,
        "normalised PixieVerse field in [-1, 1], NaN where not annotated"),
    ArrayLayout("grid/material", "uint8", ("asset", *_XYZ), BACKGROUND,
        "class, 255 occupied but not annotated, background 7 or the store's attribute background"),
)  # fmt: skip
"""Arrays that every store has, besides `RECORDS` and `FILES`."""

MERGED = (
    _voxel("spread", "exponents", "float32",
        "standard deviation of normalised properties over the annotations, NaN where not several",
        "property"),
    _voxel("votes", "repeats", "float32",
        "share of the annotations that give the class, 0 where not valid, NaN where not several"),
)  # fmt: skip
"""Further arrays of a store if labels of any asset are merged from several annotations."""

RECORDS = ArrayLayout(RECORD_ARRAY, "str", ("asset",), "", "provenance of the row, as JSON")

FILES = (
    ArrayLayout(f"{FILE}/name", "str", ("file",), "", "file below the store, with forward slashes"),
    ArrayLayout(f"{FILE}/size", "int64", ("file",), 0, "bytes"),
    ArrayLayout(f"{FILE}/sha256", "str", ("file",), "", "SHA-256 in hex"),
)
"""Digests of the store's files; see `slatprep.store.integrity`."""

LAYOUTS = {layout.name: layout for layout in (*ARRAYS, *MERGED, RECORDS, *FILES)}
"""Every array that a store may have, by name, except the coordinates of its dimensions."""


def last_names(group: str, arrays: Iterable[ArrayLayout]) -> tuple[str, ...]:
    """Return the last names of those of the arrays that are in a group."""
    names = (one.name for one in arrays if one.name.startswith(f"{group}/"))
    return tuple(name.removeprefix(f"{group}/") for name in names)


MERGED_COLUMNS = last_names("voxel", MERGED)
"""Last names of the arrays of `MERGED`."""


def arrays_with(merged: bool) -> tuple[ArrayLayout, ...]:
    """Return the arrays of a store; `merged` adds `MERGED`."""
    return (*ARRAYS, *MERGED) if merged else ARRAYS


COORDINATES = {"asset": ("property",), "voxel": ("axis", "property"), "grid": ("property", *_XYZ)}
"""Dimensions of each group that have coordinates, in an array of the same name, as for xarray."""

FIXED_SIZES = {
    "row": 4,
    "column": 4,
    "axis": 3,
    "byte": 32,
    "bound": 2,
    **dict.fromkeys(_XYZ, RESOLUTION),
}
"""Sizes of the dimensions that are the same in every store."""

MOST_SHARDS = 32
"""Largest number of shards of a voxel array, unless the store is very large. An update writes the
last shard anew, and readers keep all of them open."""

_CHUNKS_IN_SHARD = 64, 4_096
"""Least and largest number of chunks in a shard if parameters give none. With chunks of the usual
size these take some 10 and 700 MB in all arrays together."""


def rows_per_shard(parameters: StoreParameters, n_voxels: int) -> int:
    """Return the number of voxel rows per shard in a store of `n_voxels`.

    If parameters give none, it is a power of two of chunks, so that updates seldom change it.
    """
    if not (chunks := parameters.voxel_chunks_per_shard):
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


def edges_of(group: str, offsets: Sequence[int]) -> Sequence[int]:
    """Return the first row of each asset in arrays of a group, and the end of the last asset.

    In ``voxel/*`` these are `offsets`; in other arrays an asset has one row.
    """
    return offsets if group == "voxel" else range(len(offsets))


def overlaps(offsets: Sequence[int], start: int, stop: int) -> Iterator[tuple[int, slice]]:
    """Yield each asset with rows in ``start:stop``, and the slice of its own rows that these are.

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

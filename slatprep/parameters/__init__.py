"""The parameters of a build, in a handful of typed groups with defaults.

These are plain dataclasses. `slatprep.parameters.files` fills and checks them from a TOML file and
options. Each stage takes its own group, and the provenance records all of them with each result.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from annotated_types import Ge, Gt, Le, MaxLen

from slatprep.records import Engine, InJson, Place, Plausibility, Share, Units
from slatprep.storage.place import place_of

Length = Annotated[float, Gt(1e-4), Le(1e3)]
"""A length in voxels, above 0 and within reason: a frame has 64 a side."""

PositiveInt = Annotated[int, Gt(0)]
"""A whole number above 0."""

MAX_VOXEL_CHUNK, MAX_VOXEL_SHARD, MAX_GRID_SHARD = 2**20, 2**28, 2**16
"""Most rows of a chunk and of a shard of the voxel arrays, and most assets of a shard of the grids,
for a store that is built or read."""

MAX_ALSO = 15
"""Most further sources of a dataset."""

MAX_SHARD_CHUNKS = 2**20
"""Most chunks per shard; a reader keeps their index in memory."""

NAMED_SPLITS, CATEGORY = ("hash", "pixie"), "category:"
"""Named rules of `NormalizeParameters.split_by`, and the prefix of a rule by category."""


class _Group:
    """Base class of the groups, with the settings by which pydantic checks them."""

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "allow_inf_nan": False}

    def __post_init__(self) -> None:
        for name in ("root", "map", "categories"):
            if isinstance(text := getattr(self, name, None), str):
                object.__setattr__(self, name, place_of(text))


PlaceText = Annotated[Place, InJson({"type": "str"})]
"""A place, which may be given as a text."""

Samples = Literal["one", "first", "all", "merge"]
"""The treatment of several annotations of an object, see `PixieverseSource`."""


@dataclass(frozen=True)
class PixieverseSource(_Group):
    """Location of the PixieVerse side, and how to read it.

    Patterns are relative to `root` and name ``{id}`` (one path component) and optionally
    ``{sample}``. For each object, the first grid pattern with a match is used. `sample` names the
    sample to take. Otherwise `samples` decides how several are treated: an error (``one``), the
    lowest (``first``), an asset for each (``all``), or an asset with merged labels (``merge``).

    `adapter` reads the source; it is one of `slatprep.readers.adapters.SOURCES` or another
    package's. `transform` is for the engine ``known``: the file with the transform to the SLAT
    frame, or a pattern that names ``{id}``.

    `units` states the units of the files if they are not SI units. `plausibility` decides how
    values that no material has are treated: the asset is refused (``refuse``), or they are used
    unchanged, with a warning (``warn``) or without (``off``).
    """

    root: PlaceText
    grid: tuple[str, ...] = (
        "{id}/sample_{sample}/material_grid.npy",
        "{id}/sample_{sample}_pred.npy",
    )
    mask: tuple[str, ...] = ("{id}/clip_features_mask.npy", "{id}/sample_{sample}_mask.npy")
    bounds: tuple[str, ...] = ("{id}/clip_features.npz",)
    sample: str = ""
    samples: Samples = "one"
    adapter: str = "pixieverse"
    transform: str = ""
    units: Units = field(default_factory=Units)
    plausibility: Plausibility = "refuse"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sample and self.samples != "one":
            raise ValueError("samples = 'one' where `sample` names the one to take")


@dataclass(frozen=True)
class SlatSource(_Group):
    """Location of the SLAT side, and how to read it.

    Patterns are relative to `root` and name ``{id}`` and optionally ``{view}``. If `root` is an
    HDF5 file, or a pattern names no ``{id}``, the file has a group for each asset, named by
    `group`.

    `encoder` made the latents: a name of `slatprep.records.encoders.LATENTS`, or the path of a JSON
    file that describes another encoder. `standardised` says whether latents are standardised
    already; with ``auto``, their values decide.
    """

    root: PlaceText
    pattern: tuple[str, ...] = (
        "{id}.npz",
        "{id}.h5",
        "{id}.hdf5",
        "{id}/{view}.npz",
        "{id}/{view}.h5",
        "{id}/{view}.hdf5",
        "latents/*/{id}.npz",
        "shape_latents/*_1024/{id}.npz",
    )
    group: str = "{id}"
    encoder: str = "trellis"
    standardised: Literal["auto", "yes", "no"] = "auto"


@dataclass(frozen=True)
class PairingParameters(_Group):
    """How to join the names of the two sides if they differ.

    `map` is a CSV with columns ``object_id`` and ``slat_id`` (and optionally ``view``), or
    TRELLIS's ``metadata.csv`` (``sha256``, ``file_identifier``). `categories` is Pixie's
    ``obj_ids_metadata.json``.
    """

    map: PlaceText | None = None
    categories: PlaceText | None = None


@dataclass(frozen=True)
class AlignParameters(_Group):
    """How to find the transform between the frames.

    `model` is ``rigid`` (the paper's SE(3)), ``similarity`` (with a scale), ``affine``,
    ``deformable`` (a smooth free-form deformation) or ``auto`` (the simplest that the data
    support). Scale stays within `scale_bounds`. Neither the affine map nor its bending moves a
    point of the SLAT farther than `max_displacement` voxels. `radius` [voxel] is the correspondence
    radius of quality figures. No engine uses random numbers.
    """

    engine: Engine = Engine.FIELD
    model: Literal["auto", "rigid", "similarity", "affine", "deformable"] = "auto"
    scale_bounds: tuple[Annotated[float, Gt(0), Le(1)], Annotated[float, Ge(1)]] = (0.6, 1.6)
    max_displacement: Length = 16.0
    radius: Length = 1.0
    icp_radius: Length = 3.2
    icp_iterations: PositiveInt = 60

    def __post_init__(self) -> None:
        rigid = self.engine in (Engine.OPEN3D, Engine.SMALL_GICP)
        if rigid and self.model not in ("auto", "rigid"):
            raise ValueError(
                f"model = 'rigid' or 'auto' where engine = '{self.engine}', a rigid ICP"
            )


@dataclass(frozen=True)
class ConsensusParameters(_Group):
    """Whether the dataset's common rotation settles ties.

    With `settle`, a second pass treats assets whose geometry cannot decide between placements. Each
    gets the placement nearest to the rotation that most assets without a tie share. An asset
    without a tie that is turned otherwise gets it if shape and dataset together favour it.
    """

    settle: bool = False


@dataclass(frozen=True)
class WitnessParameters(_Group):
    """Whether to compare labels with latents.

    With `settle`, a pass after the consensus learns from sure assets what the latents of each class
    are like. Assets whose geometry cannot decide between placements get the one whose labels make
    their latents likelier, if that is decisive. Labels that latents contradict are reported.
    """

    settle: bool = False


@dataclass(frozen=True)
class SampleParameters(_Group):
    """How to look annotations up at SLAT voxels.

    `method` is ``nearest`` (the paper's: the nearest annotated voxel) or ``vote``. Annotated voxels
    around a point then vote for its class, weighted by a Gaussian of `vote_width` voxels. The
    nearest voxel of that class gives the properties. A SLAT voxel is valid up to `max_distance`
    (voxels of the PixieVerse frame) from the nearest annotated voxel.

    A voxel is not annotated if no material has its properties: a Poisson's ratio outside [0, 0.5],
    a modulus or density that is not finite and positive. An asset is refused if their share among
    the voxels with a class exceeds `max_unphysical`.
    """

    method: Literal["vote", "nearest"] = "vote"
    max_distance: Length = 3.0
    vote_width: Length = 0.5
    max_unphysical: Annotated[float, Ge(0), Le(1)] = 0.1


@dataclass(frozen=True)
class NormalizeParameters(_Group):
    """Origin of the ranges.

    `ranges` is ``dataset`` (its minimum and maximum), percentiles of it such as ``p1-p99``,
    ``pixie``, or the path of a TOML, JSON or YAML file. The dataset's ranges come from the objects
    that `objects` names: ``all``, or ``train``. `split_by` and `shares` define the training
    objects, see `slatprep.readers.splits.assign_splits`.
    """

    ranges: str = "dataset"
    objects: Literal["all", "train"] = "all"
    split_by: str = "hash"
    shares: tuple[Share, Share, Share] = (0.8, 0.1, 0.1)

    def __post_init__(self) -> None:
        percentiles = percentiles_of(self.ranges)
        if percentiles and not percentiles[0] < percentiles[1] <= 100:
            raise ValueError("percentiles such as p1-p99, from p0 to p100, the lower first")
        if abs(sum(self.shares) - 1) > 1e-9:
            raise ValueError("shares of train, val and test that add up to 1")
        own = NormalizeParameters.split_by, NormalizeParameters.shares
        if self.objects == "all" and (self.split_by, self.shares) != own:
            raise ValueError(
                "objects = 'train' (--ranges-of train) where split_by or shares say whom"
            )
        if self.objects == "train" and self.ranges != "dataset" and not percentiles:
            raise ValueError("ranges of the dataset or percentiles of it where objects = 'train'")


def percentiles_of(ranges: str) -> tuple[float, float] | None:
    """Return the two percentiles of ranges such as ``p1-p99``; None for other ranges."""
    match = re.fullmatch(r"p(\d+(?:\.\d+)?)-p(\d+(?:\.\d+)?)", ranges, re.ASCII)
    return (float(match[1]), float(match[2])) if match else None


def is_split_file(by: str) -> bool:
    """Return whether the rule of a split is a file of ids, and not a named rule."""
    return by not in NAMED_SPLITS and not by.startswith(CATEGORY)


@dataclass(frozen=True)
class StoreParameters(_Group):
    """Chunks and shards of the store, in rows (voxel arrays) and assets (grid arrays).

    With `voxel_chunks_per_shard` 0, the number of voxels decides, see
    `slatprep.store.layout.rows_per_shard`.
    """

    voxel_chunk: Annotated[int, Gt(0), Le(MAX_VOXEL_CHUNK)] = 4_096
    voxel_chunks_per_shard: Annotated[int, Ge(0), Le(MAX_SHARD_CHUNKS)] = 0
    grid_assets_per_shard: Annotated[int, Gt(0), Le(MAX_GRID_SHARD)] = 512
    compression_level: Annotated[int, Ge(0), Le(22)] = 1

    def __post_init__(self) -> None:
        if self.voxel_chunk * self.voxel_chunks_per_shard > MAX_VOXEL_SHARD:
            raise ValueError(
                f"voxel_chunk times voxel_chunks_per_shard of at most {MAX_VOXEL_SHARD} rows"
            )


@dataclass(frozen=True)
class BuildParameters(_Group):
    """Everything that decides the content of a store.

    `also` lists further sources of the same objects, whose annotations are merged with those of
    `pixieverse`.
    """

    pixieverse: PixieverseSource
    slat: SlatSource
    name: str = ""
    also: Annotated[tuple[PixieverseSource, ...], MaxLen(MAX_ALSO)] = ()
    pairing: PairingParameters = field(default_factory=PairingParameters)
    align: AlignParameters = field(default_factory=AlignParameters)
    consensus: ConsensusParameters = field(default_factory=ConsensusParameters)
    witness: WitnessParameters = field(default_factory=WitnessParameters)
    sample: SampleParameters = field(default_factory=SampleParameters)
    normalize: NormalizeParameters = field(default_factory=NormalizeParameters)
    store: StoreParameters = field(default_factory=StoreParameters)

    def __post_init__(self) -> None:
        sources = (self.pixieverse, *self.also)
        if any(one.transform for one in sources) and self.align.engine is not Engine.KNOWN:
            raise ValueError('align.engine = "known", as pixieverse.transform is given')
        if self.also and self.pixieverse.samples != "merge":
            raise ValueError("pixieverse.samples = 'merge', as [[also]] names further sources")
        if any(one.samples != "one" for one in self.also):
            raise ValueError("samples in [pixieverse] alone: all of [[also]] are merged")
        if self.pixieverse.samples == "merge" and (self.consensus.settle or self.witness.settle):
            raise ValueError(
                "pixieverse.samples of one, first or all with --consensus or --witness: these "
                "place an asset anew, and each of merged annotations has a placement of its own"
            )


@dataclass(frozen=True)
class Preset:
    """Named parameters of the stages that decide which annotation a SLAT voxel gets.

    If `normalize` is None, the file's ranges are kept.
    """

    align: AlignParameters = AlignParameters()
    sample: SampleParameters = SampleParameters()
    normalize: NormalizeParameters | None = None


PRESETS: dict[str, Preset] = {
    "default": Preset(),
    "paper": Preset(
        align=AlignParameters(engine=Engine.OPEN3D, model="rigid"),
        sample=SampleParameters(method="nearest"),
        normalize=NormalizeParameters(ranges="pixie"),
    ),
}
"""``paper`` is the protocol of SLAT-Phys, the reference for comparisons: its targets are
normalised by Pixie's published ranges."""

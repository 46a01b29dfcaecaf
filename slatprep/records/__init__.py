"""The typed records that travel between the stages.

Two source files become rows of the store through read, align, sample, judge, normalise and pack.
Each stage takes the records of the one before it and returns its own; no class here touches a disk.
Classes with arrays compare by identity.

Frames: the *PixieVerse frame* and the *SLAT frame* are both the unit cube [-0.5, 0.5]^3 with voxel
``i`` centred at ``(i + 0.5) / 64 - 0.5`` on each axis.
"""

from slatprep.records.alignment import (
    Agreement,
    Alignment,
    Ambiguity,
    Candidate,
    Consensus,
    Deformation,
    FitFigures,
    Ground,
    Judgement,
    LatentChoice,
    Placement,
    Quality,
)
from slatprep.records.json_types import (
    Count,
    Digest,
    InJson,
    Number,
    Share,
    one_of,
)
from slatprep.records.results import (
    Annotation,
    Contribution,
    Failed,
    Finished,
    Normalization,
    PropertyRange,
)
from slatprep.records.sources import (
    FACTORS,
    LATENT_ROLES,
    LOG10,
    AssetPair,
    MaterialField,
    Place,
    Plausibility,
    SourceFile,
    SourceRoots,
    StructuredLatents,
    Units,
    to_si,
)
from slatprep.records.tables import (
    BACKGROUND,
    CLASS_COLOURS,
    CLASS_NAME,
    FEATS_MEAN,
    FEATS_STD,
    MANY_BACKGROUND,
    MATERIAL_CLASSES,
    MATERIAL_COLOURS,
    MAX_CHANNELS,
    MAX_LATENT_RESOLUTION,
    MAX_NAME_BYTES,
    MAX_PROPERTIES,
    PIXIEVERSE,
    PROPERTIES,
    PROPERTY_COLUMNS,
    RESOLUTION,
    TRELLIS,
    UNANNOTATED,
    UNANNOTATED_COLOUR,
    USABLE,
    ClassName,
    Contents,
    Engine,
    LatentMoments,
    LatentSpace,
    Model,
    Property,
    PropertyName,
    Search,
    Status,
    Verdict,
    labels_of,
    words_of,
)

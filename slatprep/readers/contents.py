"""Contents of a dataset, as its sources describe them before any field is read.

The user states the encoder of the latents; whether they are standardised may be guessed later.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError
from slatprep.parameters import BuildParameters, SlatSource
from slatprep.readers.adapters import Holding, adapter_names, latent_adapter, source_adapter
from slatprep.readers.files import refusing
from slatprep.readers.plausible import ENOUGH
from slatprep.records import Contents, LatentMoments, LatentSpace, Place, Property
from slatprep.records.encoders import LATENTS
from slatprep.records.sources import table_of
from slatprep.records.tables import PROPERTIES
from slatprep.storage.documents import adapter_of, read_document
from slatprep.storage.place import place_of


def contents_of(parameters: BuildParameters) -> Contents:
    """Return what the sources of a dataset hold, as far as known before they are read.

    Parameters
    ----------
    parameters : BuildParameters
        The sources and their adapters.

    Returns
    -------
    Contents
        Properties, classes and latent space of the dataset.

    Raises
    ------
    ConfigError
        If a source has no usable description, describes one of `PROPERTIES` in another unit, or a
        further source has other properties or classes.
    """
    sources = (parameters.pixieverse, *parameters.also)
    units = {one.name: one.unit for one in PROPERTIES}
    held, *_ = holdings = [source_adapter(one.adapter).describe(one) for one in sources]
    for number, (source, other) in enumerate(zip(sources, holdings, strict=True)):
        table = table_of(number)
        for one in other.properties:
            if one.unit != (known := units.get(one.name, one.unit)):
                raise ConfigError(
                    f"{source.root}: has {one.name} in {one.unit}; expected {known}. If the values "
                    f"have another unit, say so by units in {table}"
                )
        if fault := _disagreement(other, held):
            raise ConfigError(
                f"{table} ({source.root}): {fault}; expected what [pixieverse] has, or "
                "a part of it: name the source that has most as [pixieverse]"
            )
    return Contents(held.properties, held.classes, latent_space(parameters.slat))


def _disagreement(other: Holding, held: Holding) -> str:
    """Say why a further source cannot be merged into the first; empty if it can."""
    if other.classes not in ((), held.classes):
        ours = ", ".join(held.classes) or "none"
        return f"has the classes {', '.join(other.classes)}, [pixieverse] has {ours}"
    known = {one.name: one for one in held.properties}
    for one in other.properties:
        if one.name not in known:
            return f"has the property {one.name}, which [pixieverse] has not"
        if one != known[one.name]:
            return f"has {_described(one)}, [pixieverse] has {_described(known[one.name])}"
    return ""


def _described(one: Property) -> str:
    return f"{one.name} in {one.unit}, {'log10' if one.log10 else 'linear'}"


_WIDE_ALONE = 1.2
"""Standard deviation of the median channel above which the latents of a single asset are raw.

A dataset's standardised channels have 1; the channels of three single real SLATs have 0.66 to 0.79.
"""

_MAX_BYTES = 2**20


def latent_space(source: SlatSource) -> LatentSpace:
    """Return the space of a source's latents, as far as known before they are read.

    ``source.encoder`` names an entry of `LATENTS`, a latent adapter, or a JSON file. The file has
    ``encoder`` (a name), ``channels``, ``resolution`` and optionally ``mean`` and ``std``.
    ConfigError if it is none of these.
    """
    own, adapter = LATENTS.get(source.encoder), latent_adapter(source.encoder)
    known = own or (adapter.space if adapter else _read_space(place_of(source.encoder)))
    return replace(known, standardised=source.standardised == "yes")


def _read_space(path: Place) -> LatentSpace:
    if path.suffix != ".json":
        known = ", ".join(adapter_names("slatprep.latents"))
        raise ConfigError(
            f"slat.encoder: there is no {str(path)!r}; expected {known}, or a JSON "
            "file that describes another"
        )
    expected = "encoder, channels, resolution, and mean and std of each channel if they are known"
    with refusing(path, "describes no encoder", expected, ConfigError):
        document = json.dumps(read_document(path, _MAX_BYTES))
        space: LatentSpace = adapter_of(LatentSpace).validate_json(document)
    return space


def resolve_latents(
    declared: LatentSpace,
    standardised: str,
    moments: Sequence[tuple[int, LatentMoments | None]],
    before: LatentSpace | None = None,
) -> LatentSpace:
    """Return the space of a dataset's latents after all assets have been read.

    `moments` holds the voxel count and moments of each SLAT, in the order of the assets' ids. If
    `standardised` is ``auto``, they decide whether latents are standardised. `before` is the space
    of the store that is updated, which decides if a single SLAT cannot.
    """
    known = [(count, one) for count, one in moments if one is not None and count]
    if not known:
        return declared
    pooled = pooled_moments(known)
    auto = standardised == "auto" and sum(count for count, _ in known) >= ENOUGH
    alone = auto and len(known) == 1 and not tell_alone(pooled, declared)
    if alone and before is None:
        raise ConfigError(
            "one SLAT alone does not tell whether its latents have been standardised "
            f'({in_words(pooled)}). Say standardised = "yes" or "no" in [slat] of a --config FILE'
        )
    if auto:
        look = before.standardised if alone and before else look_standardised(pooled, declared)
        declared = replace(declared, standardised=look)
    if not declared.mean and not declared.standardised:
        # A constant channel keeps its scale.
        std = tuple(s if s > 0 else 1.0 for s in pooled.std)
        declared = replace(declared, mean=pooled.mean, std=std)
    return declared


def look_standardised(moments: LatentMoments, space: LatentSpace) -> bool:
    """Return whether latents look standardised already.

    The standard deviation of the median channel must be between 0.5 and 1.5. A standard normal
    must also explain them better than normals with the encoder's mean and standard deviation.
    If the encoder's are unknown, the mean of each channel must be within 0.5 of 0 instead.
    """
    mean, std = np.array(moments.mean), np.array(moments.std)
    if not 0.5 <= np.median(std) <= 1.5:
        return False
    if not space.mean:
        return bool(np.abs(mean).max() <= 0.5)
    own_mean, own_std = np.array(space.mean), np.array(space.std)
    as_encoded = -0.5 * ((mean - own_mean) ** 2 + std**2) / own_std**2 - np.log(own_std)
    standard = -0.5 * (mean**2 + std**2)
    return bool((standard - as_encoded).sum() > 0)


def tell_alone(moments: LatentMoments, space: LatentSpace) -> bool:
    """Return whether the moments of one asset tell if its latents have been standardised.

    One asset's channels spread less than the dataset's, so its standardised latents may look raw.
    A spread above `_WIDE_ALONE` tells; a standardised look tells if the encoder's moments are
    known.
    """
    spread = float(np.median(moments.std))
    return spread > _WIDE_ALONE or (bool(space.mean) and look_standardised(moments, space))


def in_words(moments: LatentMoments) -> str:
    """Return the channels' means and standard deviations in a few words."""
    mean, std = np.abs(moments.mean).max(), moments.std
    return f"means within {mean:.2g} of 0, standard deviations {min(std):.2g} to {max(std):.2g}"


def pooled_moments(known: Sequence[tuple[int, LatentMoments]]) -> LatentMoments:
    """Return the moments of all voxels of several assets from each asset's count and moments."""
    counts = np.array([count for count, _ in known], dtype=np.float64)
    share: NDArray[np.float64] = (counts / counts.sum())[:, None]
    means, stds = (np.array([getattr(one, n) for _, one in known]) for n in ("mean", "std"))
    mean = (share * means).sum(axis=0)
    variance = (share * (stds**2 + (means - mean) ** 2)).sum(axis=0)
    return LatentMoments(tuple(mean.tolist()), tuple(np.sqrt(variance).tolist()))

"""What a dataset holds, as its sources describe it before any field is read."""

from __future__ import annotations

from slatprep.errors import ConfigError
from slatprep.parameters import BuildParameters
from slatprep.readers.adapters import Holding, source_adapter
from slatprep.readers.encoders import latent_space
from slatprep.records import Contents, Property, labels_of


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
        If a source cannot tell, or a further source holds something else than the first.
    """
    held = source_adapter(parameters.pixieverse.adapter).describe(parameters.pixieverse)
    for number, source in enumerate(parameters.also, 1):
        other = source_adapter(source.adapter).describe(source)
        fault = _disagreement(other, held)
        if fault:
            raise ConfigError(
                f"[[also]] {number} ({source.root}): {fault}; expected what [pixieverse] has, or "
                "a part of it: name the source that has most as [pixieverse]"
            )
    try:
        labels_of(held.classes)
    except ValueError as error:
        raise ConfigError(f"{parameters.pixieverse.root}: {error}") from None
    return Contents(held.properties, held.classes, latent_space(parameters.slat))


def _disagreement(other: Holding, held: Holding) -> str:
    """Say why annotations cannot be merged into others; empty where they can."""
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

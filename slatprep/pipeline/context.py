"""What every task of a build has in common."""

from __future__ import annotations

from dataclasses import dataclass

from slatprep.parameters import BuildParameters
from slatprep.pipeline.previous import PreviousBuild
from slatprep.pipeline.recipe import Recipe
from slatprep.pipeline.spool import Spool


@dataclass(frozen=True)
class BuildContext:
    """A build, as its tasks see it.

    Attributes
    ----------
    parameters : BuildParameters
        The build's.
    recipe : Recipe
        What they and the code come to.
    spool : Spool
        Where finished assets go.
    previous : PreviousBuild or None
        The store that is there.
    strict : bool
        Raise an asset's fault instead of noting it.
    """

    parameters: BuildParameters
    recipe: Recipe
    spool: Spool
    previous: PreviousBuild | None
    strict: bool

"""When an asset that was done before need not be done again.

Three things decide an asset's row: what its sources hold, the parameters that
touch it, and the code with the libraries it computes with. A `Recipe` is the
last two; with the first it gives the asset's key, which its record keeps.
Work under the same key is the same work. Ranges, chunks, names and the times
of files are no part of it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from slatprep.parameters import BuildParameters
from slatprep.pipeline.fingerprint import code_fingerprint
from slatprep.records import SourceFile


@dataclass(frozen=True)
class Recipe:
    """What an asset's numbers depend on besides its sources.

    Attributes
    ----------
    parameters : dict
        Groups ``align`` and ``sample``, JSON-ready.
    versions : dict of str to str
        Libraries that make the numbers.
    code : str
        Fingerprint of the code.
    """

    parameters: dict[str, Any]
    versions: dict[str, str]
    code: str

    def key(self, asset_id: str, digests: Mapping[str, str]) -> str:
        """Return the key of an asset, SHA-256 in hex, from the digests of its sources."""
        parts = [asset_id, digests, self.parameters, self.versions, self.code]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def difference(self, record: Mapping[str, Any], sources: Iterable[SourceFile]) -> str:
        """Say in one line why an asset with an older record has another key now."""
        for group, values in self.parameters.items():
            for name, value in values.items():
                before = record["parameters"].get(group, {}).get(name)
                if before != value:
                    return f"parameters changed: {group}.{name} was {before}, is {value}"
        for name, version in self.versions.items():
            before = record["versions"].get(name)
            if before != version:
                return f"libraries changed: {name} was {before}, is {version}"
        if record["code"] != self.code:
            return "code changed"
        before = {source["role"]: source["sha256"] for source in record["sources"]}
        after = {source.role: source.sha256 for source in sources}
        roles = sorted(r for r in before | after if before.get(r) != after.get(r))
        return f"sources changed: {', '.join(roles)}"


def recipe_of(parameters: BuildParameters) -> Recipe:
    """Return the recipe of a build."""
    from slatprep.provenance.record import content_parameters
    from slatprep.provenance.versions import numeric_versions

    return Recipe(
        parameters=content_parameters(parameters),
        versions=numeric_versions(parameters.align),
        code=code_fingerprint(),
    )

"""When an asset that was done before need not be done again.

Three things decide an asset's row: what its sources hold, the parameters that
touch it, and the code with the libraries it computes with. A `Recipe` is the
last two; with the first it gives the asset's key, which its record keeps.
Work under the same key is the same work. Ranges, chunks, names and the times
of files are no part of it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import orjson

from slatprep.parameters import BuildParameters
from slatprep.pipeline.fingerprint import code_fingerprint, packing_fingerprint
from slatprep.provenance.make import origin
from slatprep.provenance.record import AssetRecord, StageParameters
from slatprep.provenance.versions import numeric_versions
from slatprep.records import SourceFile


@dataclass(frozen=True)
class Recipe:
    """What an asset's numbers depend on besides its sources.

    Attributes
    ----------
    parameters : StageParameters
        Those that touch an asset.
    versions : dict of str to str
        Libraries that make the numbers.
    code : str
        Fingerprint of the code.
    """

    parameters: StageParameters
    versions: dict[str, str]
    code: str

    def key(self, asset_id: str, digests: Mapping[str, str]) -> str:
        """Return the key of an asset, SHA-256 in hex, from the digests of its sources."""
        parts = [asset_id, digests, self.parameters, self.versions, self.code]
        return hashlib.sha256(orjson.dumps(parts, option=orjson.OPT_SORT_KEYS)).hexdigest()

    def difference(self, record: AssetRecord, sources: Iterable[SourceFile]) -> str:
        """Say in one line why an asset with an older record has another key now."""
        before = asdict(record.parameters)
        for group, values in asdict(self.parameters).items():
            for name, value in values.items():
                if before[group][name] != value:
                    was = before[group][name]
                    return f"parameters changed: {group}.{name} was {was}, is {value}"
        for name, version in self.versions.items():
            if record.versions.get(name) != version:
                return f"libraries changed: {name} was {record.versions.get(name)}, is {version}"
        if record.code != self.code:
            return "code changed"
        old = {source.role: source.sha256 for source in record.sources}
        new = {source.role: source.sha256 for source in sources}
        roles = sorted(role for role in old | new if old.get(role) != new.get(role))
        return f"sources changed: {', '.join(roles)}"


def recipe_of(parameters: BuildParameters) -> Recipe:
    """Return the recipe of a build."""
    return Recipe(
        parameters=StageParameters(parameters.align, parameters.sample),
        versions=numeric_versions(parameters.align),
        code=code_fingerprint(),
    )


def build_of(parameters: BuildParameters) -> dict[str, Any]:
    """Return a store's attribute ``build``: its parameters, and what else decides its bytes."""
    build: dict[str, Any] = origin(parameters)
    return {**build, "versions": {**build["versions"], "packing": packing_fingerprint()}}

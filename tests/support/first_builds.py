"""What a build that knows of no other writes: made once for the same sources and parameters."""

import tempfile
from pathlib import Path

from slatprep.parameters import BuildParameters
from slatprep.pipeline.dataset import build_store
from support.trees import tree

_trees: dict[str, dict[str, str]] = {}


def tree_from_nothing(parameters: BuildParameters, patched: str = "") -> dict[str, str]:
    """Return the hashes of its files; `patched` says what else the caller changed about builds."""
    said = f"{patched} {parameters}"
    for path in (parameters.pixieverse.root, parameters.slat.root, parameters.pairing.categories):
        if path is not None:
            said = said.replace(str(path), repr(sorted(tree(Path(path)).items())))
    if said not in _trees:
        with tempfile.TemporaryDirectory() as folder:
            _trees[said] = tree(build_store(parameters, Path(folder, "s.zarr")).store)
    return _trees[said]

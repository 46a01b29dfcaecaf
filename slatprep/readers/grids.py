"""The grids of a source, object by object."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from slatprep.errors import InputError
from slatprep.parameters import PixieverseSource
from slatprep.readers.adapters import FoundField, source_adapter
from slatprep.readers.patterns import list_below, tried_names
from slatprep.records import Place
from slatprep.storage.listing import Listing


def find_grids(
    source: PixieverseSource, listing: Listing | None = None
) -> dict[str, list[FoundField]]:
    """Return the grids of each object, as the source's adapter finds them.

    Raises ConfigError if the folder cannot be listed or a pattern makes no sense.
    """
    grids: dict[str, list[FoundField]] = {}
    found = source_adapter(source.adapter).find(source, listing or list_below(source.root))
    for grid in found:
        grids.setdefault(grid.object_id, []).append(grid)
    return grids


def one_grid(
    root: Place, found: Sequence[FoundField], object_id: str, tried: Iterable[str]
) -> Place:
    """Return the only grid of an object from `find_grids`; InputError if it has none or several."""
    if not found:
        looked = tried_names(tried, {"id": object_id})
        raise InputError(root, f"no grid for id {object_id!r}", f"one of {looked}")
    if len(found) > 1:
        raise InputError(root, several_grids(object_id, list(found)), "one grid of every object")
    if found[0].problem:
        raise InputError(root, found[0].problem, "a grid")
    return root / found[0].path


def several_grids(object_id: str, grids: Sequence[FoundField]) -> str:
    """Say that an object has several grids, and what to do."""
    files = ", ".join(grid.path for grid in grids)
    if len({grid.sample for grid in grids}) > 1:
        return (
            f"id {object_id!r} has {len(grids)} samples ({files}); choose one with `sample` in the "
            "table [pixieverse] of the dataset definition, or say with --samples what becomes of "
            "them: first, all or merge"
        )
    return f"{len(grids)} grids for one id {object_id!r} ({files}); expected one"

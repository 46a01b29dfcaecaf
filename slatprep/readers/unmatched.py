"""Why names of the two sides do not meet."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from slatprep.parameters import BuildParameters
from slatprep.records import AssetPair


def explain_unmatched(pairs: Collection[AssetPair], parameters: BuildParameters) -> str:
    """Say in a line that the names of the two sides have nothing in common, or return "".

    `pairs` is what `discover` returned for `parameters`.
    """
    grids = [pair.object_id for pair in pairs if pair.slat is None and pair.grid is not None]
    slats = [pair.object_id for pair in pairs if pair.grid is None and pair.slat is not None]
    if not grids or not slats or any(pair.grid and pair.slat for pair in pairs):
        return ""
    table, root = parameters.pairing.map, parameters.slat.root
    folders = {pair.object_id for pair in pairs if pair.view and pair.slat is not None}
    if table is None and len(folders) == 1 and {*slats} == folders and len(slats) > 1:
        return (
            f"no id occurs on both sides: the SLATs lie one folder deeper; point at "
            f"{root / slats[0]}"
        )
    if table is not None:
        hint = f"the table {table} joins none of them"
    else:
        own = root / "metadata.csv"
        example = own if own.is_file() else "FILE.csv"
        hint = f"name a table that joins them: --map {example} (docs/configuration.md, [pairing])"
    return (
        f"no id occurs on both sides: {len(grids):,} grids such as {grids[0][:40]!r}, "
        f"{len(slats):,} SLATs such as {slats[0][:40]!r}; {hint}"
    )


def by_case(grids: Iterable[str], slats: Iterable[str]) -> dict[str, str]:
    """Return the ids that occur on one side only, by what the other side has but for case."""
    ours, theirs = set(grids), set(slats)
    folded = {name.casefold(): name for name in theirs - ours}
    pairs = [(name, folded.get(name.casefold())) for name in ours - theirs]
    both = {name: other for name, other in pairs if other}
    return both | {other: name for name, other in both.items()}

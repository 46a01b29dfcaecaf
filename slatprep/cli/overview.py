"""The tables about a store that `info` and `build-store` print."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slatprep.cli.output import Cell, Output

if TYPE_CHECKING:
    from slatprep.inspect.overview import GroupOverview, StoreOverview


def show_quality(output: Output, overview: StoreOverview) -> None:
    """Print how good the alignments of a store are, by category and in all.

    ``back`` is the fitness from SLAT to PixieVerse; ``tied`` counts assets
    whose tied placements differ in class somewhere.
    """
    verdicts = tuple(overview.total.verdicts)
    output.table(
        "Alignments (medians; rmse in voxels)",
        ("category", "assets", *verdicts, "fitness", "back", "rmse", "valid", "tied"),
        [_quality_row(group) for group in (*overview.categories, overview.total)],
    )


def show_normalization(output: Output, overview: StoreOverview) -> None:
    """Print the ranges that properties are normalised with."""
    output.table(
        f"Normalisation to [-1, 1] (ranges: {overview.normalization.source})",
        ("property", "scale", "lo", "hi"),
        [
            (entry.name, "log10" if entry.log10 else "linear", entry.lo, entry.hi)
            for entry in overview.normalization.ranges
        ],
    )


def _quality_row(group: GroupOverview) -> tuple[Cell, ...]:
    return (
        group.name,
        group.assets,
        *group.verdicts.values(),
        group.fitness,
        group.fitness_backward,
        group.inlier_rmse,
        group.valid_share,
        group.ambiguous,
    )

"""`slatprep list`: the assets of a store, one on each line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slatprep.cli.options import ChoiceOf, command, option, require_categories, store_argument
from slatprep.cli.output import Output, say

if TYPE_CHECKING:
    from slatprep.records import Place


@command("list")
@store_argument
@option("--verdict", ChoiceOf("slatprep.records:Verdict"), name="verdicts", multiple=True)
@option("--category", name="categories", multiple=True)
@option("--max-confidence", float)
@option("--ids", is_flag=True)
def list_assets(
    output: Output,
    store: Place,
    verdicts: tuple[str, ...],
    categories: tuple[str, ...],
    max_confidence: float | None,
    ids: bool,
) -> None:
    """List the assets of STORE, with the reasons of their verdicts.

    On a terminal ids are shortened to prefixes that no other id has; all commands accept
    such prefixes. Without STORE, the one that `make align` built last under data/ is taken.

    Options
    -------
    --verdict: Only assets with this verdict; may be repeated. [default: all]
    --category: Only assets of this category; may be repeated. [default: all]
    --max-confidence: Only assets with at most this confidence.
    --ids: Print only the full ids, one on each line.

    Example
    -------
    slatprep list data/demo.zarr --verdict doubtful --verdict failed
    slatprep list data/demo.zarr --category tree --ids
    """
    from slatprep.inspect.listing import list_assets as listed_of
    from slatprep.store import open_store

    opened = open_store(store)
    require_categories(opened, categories)
    listed = list(listed_of(opened, verdicts, categories, max_confidence))

    def show() -> None:
        if ids:
            for asset in listed:
                say(asset.asset_id)
            return
        length = output.id_length(opened.ids)
        output.table(
            f"{len(listed):,} of {len(opened):,} assets",
            ("id", "category", "verdict", "confidence", "fitness", "why"),
            [
                (
                    asset.asset_id[:length],
                    asset.category,
                    asset.verdict,
                    asset.confidence,
                    asset.fitness,
                    _in_short(asset.reasons) if length else "; ".join(asset.reasons),
                )
                for asset in listed
            ],
        )

    output.result({"store": store, "assets": listed}, show)


def _in_short(reasons: tuple[str, ...]) -> str:
    more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    return f"{reasons[0]}{more}" if reasons else ""

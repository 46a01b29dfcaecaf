"""`slatprep list`: the assets of a store, one on each line."""

from __future__ import annotations

from operator import attrgetter

from slatprep.cli.info import show_errors
from slatprep.cli.options import ChosenOptions, LastStore
from slatprep.cli.output import Output, say
from slatprep.cli.signature import command


@command("list")
def list_assets(
    output: Output,
    store: LastStore,
    *,
    chosen: ChosenOptions,
    max_confidence: float | None = None,
    ids: bool = False,
) -> None:
    """List the assets of STORE, with the reasons of their verdicts.

    On a terminal ids are shortened to prefixes that no other id has; all commands accept
    such prefixes. Without STORE, the one that `make align` built last under data/ is taken.

    Parameters
    ----------
    max_confidence
        Only assets with at most this confidence.
    ids
        Print only the full ids, one on each line.

    Example
    -------
    slatprep list data/demo.zarr --verdict doubtful --verdict failed
    slatprep list data/demo.zarr --category tree --ids
    """
    from slatprep.inspect.listing import list_assets as listed_of
    from slatprep.pipeline.decoys import measured_errors
    from slatprep.store import open_store

    opened = open_store(store)
    listed = list(listed_of(opened, *chosen.of(opened), max_confidence))

    def show() -> None:
        if ids:
            for asset in listed:
                say(asset.asset_id)
            return
        length = output.id_length(opened.ids)
        columns = ("category", "verdict", "confidence", "fitness")
        why = _in_short if length else "; ".join
        rows = ((a.asset_id[:length], *attrgetter(*columns)(a), why(a.reasons)) for a in listed)
        title = f"{len(listed):,} of {len(opened):,} assets"
        output.table(title, ("id", *columns, "why"), rows)
        if measured_errors(opened.path):
            show_errors(opened)

    output.result({"store": store, "assets": listed}, show)


def _in_short(reasons: tuple[str, ...]) -> str:
    more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    return f"{reasons[0]}{more}" if reasons else ""

"""`slatprep check-alignment`: whether the alignment of an asset is good."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slatprep.cli.options import chosen_store, store_option
from slatprep.cli.output import EXIT_INCOMPLETE, Cell, Output, output_options
from slatprep.errors import ConfigError, StoreError

if TYPE_CHECKING:
    from slatprep.check import AlignmentCheck


@click.command(
    name="check-alignment",
    epilog="""\b
Example:
  slatprep check-alignment --asset 0a1b2c --store data/demo.zarr
  slatprep check-alignment --asset 0a1b2c --asset 3d4e5f --json
""",
)
@click.option(
    "--asset",
    "asset_ids",
    multiple=True,
    required=True,
    metavar="ID",
    help="The asset; may be repeated.",
)
@store_option
@output_options
def check_alignment(output: Output, asset_ids: tuple[str, ...], store: Path | None) -> None:
    """Say whether the alignment of an asset is good.

    Its quality is computed anew from what the store holds, and compared with
    what the store says. Exit code 0: all assets are good and the store is
    consistent; 1: one is not.
    """
    path = chosen_store(store)
    from slatprep import check
    from slatprep.store import open_store

    opened = open_store(path)
    try:
        for asset_id in asset_ids:
            opened.find(asset_id)
    except StoreError as error:
        # A name that is not there is a wrong call, not a failed check.
        raise ConfigError(str(error)) from None
    checks = [check.check_alignment(opened, asset_id) for asset_id in asset_ids]
    ambiguity = opened.column("ambiguity")
    ambiguities = [float(ambiguity[opened.find(asset_id)]) for asset_id in asset_ids]

    def show() -> None:
        for one, ambiguous in zip(checks, ambiguities, strict=True):
            _show(output, one, ambiguous)
        output.note(f"store: {path}")

    documents = [
        {**_document(one), "ambiguity": ambiguous}
        for one, ambiguous in zip(checks, ambiguities, strict=True)
    ]
    output.result(documents, show)
    if not all(one.ok for one in checks):
        click.get_current_context().exit(EXIT_INCOMPLETE)


def _show(output: Output, check: AlignmentCheck, ambiguity: float) -> None:
    from slatprep.align.quality import THRESHOLDS

    good = {
        "fitness": f">= {THRESHOLDS.good_fitness:g}",
        "fitness_backward": f">= {THRESHOLDS.good_fitness:g}",
        "valid_share": f">= {THRESHOLDS.good_valid_share:g}",
    }
    rows: list[tuple[Cell, ...]] = [
        (
            figure.name,
            float(figure.value),
            good.get(figure.name, ""),
            float(figure.stored),
            f"{figure.limit:g}",
            figure.ok,
        )
        for figure in check.figures
    ]
    rows.append(("ambiguity", None, f"<= {THRESHOLDS.good_ambiguity:g}", ambiguity, "", None))
    output.table(
        f"{check.asset_id}: alignment {check.verdict}",
        ("figure", "computed", "good", "stored", "may differ by", "agrees"),
        rows,
    )
    for reason in check.reasons:
        click.echo(f"  {reason}")
    if not check.consistent:
        click.echo(f"  the store says {check.stored_verdict}, and its figures do not all agree")


def _document(check: AlignmentCheck) -> dict[str, object]:
    return {
        **dataclasses.asdict(check),
        "figures": [{**dataclasses.asdict(figure), "ok": figure.ok} for figure in check.figures],
        "consistent": check.consistent,
        "ok": check.ok,
    }

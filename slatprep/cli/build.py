"""`slatprep build-store` and `slatprep align`: the main job, and its alignment alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slatprep.cli.options import jobs_option, parameters_of, source_options
from slatprep.cli.output import EXIT_INCOMPLETE, Output, output_options
from slatprep.cli.overview import show_quality

if TYPE_CHECKING:
    from slatprep.build import BuildSummary

_MANIFESTS = click.option(
    "--manifests",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Folder for the records.  [default: beside the store]",
)
_STRICT = click.option("--strict", is_flag=True, help="Stop at the first asset that cannot go in.")


@click.command(
    name="build-store",
    epilog="""\b
Example:
  slatprep build-store --pixieverse demo/pixieverse --slat demo/slat --out demo.zarr --jobs 2
  slatprep build-store --config manifests/demo.toml --preset paper --out data/demo.zarr
""",
)
@source_options
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path),
    metavar="STORE.zarr",
    help="The store; one that is there is replaced when the new one is complete.",
)
@jobs_option
@_MANIFESTS
@_STRICT
@output_options
def build_store(
    output: Output, out: Path, jobs: int, manifests: Path | None, strict: bool, **sources: Any
) -> None:
    """Build one store of aligned, normalised supervision.

    Pairs the assets of both sides by id, aligns them, looks the material and
    its properties up at every SLAT voxel, normalises and writes. An asset that
    cannot go in never stops the others: it is named on standard error and in
    the records, and the exit code is 1.
    """
    parameters = parameters_of(**sources)
    from slatprep import build

    with output.progress("build") as progress:
        summary = build.build_store(
            parameters, out, manifests=manifests, jobs=jobs, strict=strict, progress=progress
        )
    _report(output, summary)


@click.command(
    epilog="""\b
Example:
  slatprep align --pixieverse demo/pixieverse --slat demo/slat --out demo.jsonl --jobs 2
"""
)
@source_options
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.jsonl",
    help="One JSON record an asset: transform, quality, candidates.",
)
@jobs_option
@_STRICT
@output_options
def align(output: Output, out: Path, jobs: int, strict: bool, **sources: Any) -> None:
    """Align without building a store.

    Writes one JSON record an asset: the transform, its quality, and the score
    of every candidate.
    """
    parameters = parameters_of(**sources)
    from slatprep import build

    with output.progress("align") as progress:
        summary = build.align_pairs(parameters, out, jobs=jobs, strict=strict, progress=progress)
    _report(output, summary)


def _report(output: Output, summary: BuildSummary) -> None:
    """Print what became of the assets, name those that did not go in, and set the exit code."""
    for asset_id, reason in summary.problems:
        output.problem(f"{asset_id}: {reason}")
    total, good = sum(summary.statuses.values()), summary.statuses["ok"]
    unlisted = total - good - len(summary.problems)
    if unlisted:
        output.problem(f"and {unlisted:,} more: see {summary.records}")

    def show() -> None:
        if summary.store is not None:
            from slatprep.overview import describe_store
            from slatprep.store import open_store

            show_quality(output, describe_store(open_store(summary.store)))
        others = ", ".join(f"{count:,} {status}" for status, count in summary.statuses.items())
        click.echo(f"assets:  {total:,} ({others}) in {summary.seconds:,.1f} s")
        if summary.store is not None:
            click.echo(f"store:   {summary.store}")
        click.echo(f"records: {summary.records}")

    output.result({**dataclasses.asdict(summary), "complete": summary.complete}, show)
    if not summary.complete:
        click.get_current_context().exit(EXIT_INCOMPLETE)

"""`slatprep info`: what is in a store."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from slatprep.cli.options import store_argument
from slatprep.cli.output import Output, output_options
from slatprep.cli.overview import show_normalization, show_quality

if TYPE_CHECKING:
    from slatprep.records import Place


@click.command(
    epilog="""\b
Example:
  slatprep info data/demo.zarr
"""
)
@store_argument
@output_options
def info(output: Output, store: Place) -> None:
    """Say what is in STORE, and how good its alignments are.

    Without STORE, the one that `make align` built last under data/ is taken.
    """
    from slatprep.inspect.overview import overview_of
    from slatprep.store import open_store

    overview = overview_of(open_store(store))

    def show() -> None:
        total = overview.total
        output.table(
            f"Store {overview.path}",
            ("assets", "voxels", "valid", "files", "MB", "format", "engine", "model"),
            [
                (
                    total.assets,
                    total.voxels,
                    total.valid_share,
                    overview.files,
                    overview.size / 1e6,
                    overview.format_version,
                    ", ".join(overview.engines),
                    ", ".join(overview.models),
                )
            ],
        )
        show_quality(output, overview)
        show_normalization(output, overview)

    output.result(overview, show)

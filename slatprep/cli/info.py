"""`slatprep info`: what is in a store."""

from __future__ import annotations

from pathlib import Path

import click

from slatprep.cli.options import chosen_store, store_argument
from slatprep.cli.output import Output, output_options
from slatprep.cli.overview import show_normalization, show_quality


@click.command(
    epilog="""\b
Example:
  slatprep info data/demo.zarr
"""
)
@store_argument
@output_options
def info(output: Output, store: Path | None) -> None:
    """Say what is in STORE, and how good its alignments are.

    Without STORE, the one that `make align` built last under data/ is taken.
    """
    path = chosen_store(store)
    from slatprep.inspect.overview import describe_store
    from slatprep.store import open_store

    overview = describe_store(open_store(path))

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

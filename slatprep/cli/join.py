"""`slatprep subset` and `concat`: new stores from existing ones."""

from __future__ import annotations

import click

from slatprep.cli.build import report
from slatprep.cli.options import AssetIds, ChosenOptions, FolderOrUrl, Jobs, NewStore, RecordsFolder
from slatprep.cli.output import Output
from slatprep.cli.signature import command


@command()
def subset(
    output: Output,
    store: FolderOrUrl,
    *,
    out: NewStore,
    assets: AssetIds = (),
    chosen: ChosenOptions,
    manifests: RecordsFolder | None = None,
    jobs: Jobs = 1,
) -> None:
    """Make a store of some assets of STORE, without aligning them again.

    Rows, records and ranges are copied unchanged. Assets must have one of the verdicts and
    one of the categories; assets named by --asset are taken as well.

    Parameters
    ----------
    assets
        An asset; may be repeated.

    Example
    -------
    slatprep subset data/demo.zarr --verdict good --out good.zarr
    slatprep subset data/demo.zarr --asset 5f61cc --asset 803c1a --out two.zarr
    """
    if not (assets or chosen.verdicts or chosen.categories):
        raise click.UsageError("say which assets: --asset ID, --verdict or --category")
    from slatprep.inspect.listing import list_assets
    from slatprep.pipeline.join import subset_store
    from slatprep.store import open_store

    wanted = list(assets)
    if chosen.verdicts or chosen.categories:
        opened = open_store(store)
        wanted += [asset.asset_id for asset in list_assets(opened, *chosen.of(opened))]
    with output.progress("subset", "shards") as progress:
        summary = subset_store(
            store, out, wanted, manifests=manifests, jobs=jobs, progress=progress
        )
    report(output, summary)


@command()
def concat(
    output: Output,
    stores: tuple[FolderOrUrl, ...],
    *,
    out: NewStore,
    manifests: RecordsFolder | None = None,
    jobs: Jobs = 1,
) -> None:
    """Make one store of the assets of all STORES, without aligning them again.

    The stores must have been built with the same parameters, and no id may be in two
    of them. If each has the ranges of its own dataset, properties are converted to the
    ranges of all.

    Example
    -------
    slatprep concat first.zarr second.zarr --out both.zarr
    """
    from slatprep.pipeline.join import concat_stores

    with output.progress("concat", "shards") as progress:
        summary = concat_stores(stores, out, manifests=manifests, jobs=jobs, progress=progress)
    report(output, summary)

"""`slatprep subset` and `concat`: new stores from existing ones."""

from __future__ import annotations

from typing import Annotated

import click

from slatprep.cli.build import report
from slatprep.cli.options import (
    AssetIds,
    Categories,
    FolderOrUrl,
    Jobs,
    PathOrUrl,
    RecordsFolder,
    Verdicts,
    require_categories,
)
from slatprep.cli.output import Output
from slatprep.cli.signature import Click, command


@command()
def subset(
    output: Output,
    store: FolderOrUrl,
    *,
    out: Annotated[
        PathOrUrl,
        "The new store, a path or URL; an existing store is replaced in one step.",
        Click(metavar="STORE.zarr"),
    ],
    assets: Annotated[AssetIds, "An asset; may be repeated."] = (),
    verdicts: Annotated[Verdicts, "Assets with this verdict; may be repeated."] = (),
    categories: Annotated[Categories, "Assets of this category; may be repeated."] = (),
    manifests: Annotated[
        RecordsFolder | None, "Folder for the records. [default: beside the new store]"
    ] = None,
    jobs: Jobs = 1,
) -> None:
    """Make a store of some assets of STORE, without aligning them again.

    Rows, records and ranges are copied unchanged. Assets must have one of the verdicts and
    one of the categories; assets named by --asset are taken as well.

    Example
    -------
    slatprep subset data/demo.zarr --verdict good --out good.zarr
    slatprep subset data/demo.zarr --asset 5f61cc --asset 803c1a --out two.zarr
    """
    if not (assets or verdicts or categories):
        raise click.UsageError("say which assets: --asset ID, --verdict or --category")
    from slatprep.inspect.listing import list_assets
    from slatprep.pipeline.join import subset_store
    from slatprep.store import open_store

    chosen = list(assets)
    if verdicts or categories:
        opened = open_store(store)
        require_categories(opened, categories)
        chosen += [asset.asset_id for asset in list_assets(opened, verdicts, categories)]
    with output.progress("subset", "shards") as progress:
        summary = subset_store(
            store, out, chosen, manifests=manifests, jobs=jobs, progress=progress
        )
    report(output, summary)


@command()
def concat(
    output: Output,
    stores: tuple[FolderOrUrl, ...],
    *,
    out: Annotated[
        PathOrUrl,
        "The new store, a path or URL; an existing store is replaced in one step.",
        Click(metavar="STORE.zarr"),
    ],
    manifests: Annotated[
        RecordsFolder | None, "Folder for the records. [default: beside the new store]"
    ] = None,
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

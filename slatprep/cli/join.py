"""`slatprep subset`, `concat` and `upgrade`: new stores from existing ones."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from slatprep.cli.build import report
from slatprep.cli.options import (
    EXISTING_FOLDER,
    PLACE,
    RECORDS_FOLDER,
    ChoiceOf,
    command,
    complete_asset,
    option,
    require_categories,
)
from slatprep.cli.output import Output, say

if TYPE_CHECKING:
    from slatprep.records import Place


@command()
@click.argument("store", type=EXISTING_FOLDER)
@option("--out", PLACE, required=True, metavar="STORE.zarr")
@option("--asset", name="assets", multiple=True, metavar="ID", shell_complete=complete_asset)
@option("--verdict", ChoiceOf("slatprep.records:Verdict"), name="verdicts", multiple=True)
@option("--category", name="categories", multiple=True)
@option("--manifests", RECORDS_FOLDER)
def subset(
    output: Output,
    store: Place,
    out: Place,
    assets: tuple[str, ...],
    verdicts: tuple[str, ...],
    categories: tuple[str, ...],
    manifests: Path | None,
) -> None:
    """Make a store of some assets of STORE, without aligning them again.

    Rows, records and ranges are copied unchanged. Assets must have one of the verdicts and
    one of the categories; assets named by --asset are taken as well.

    Options
    -------
    --out: The new store, a path or URL; an existing store is replaced in one step.
    --asset: An asset; may be repeated.
    --verdict: Assets with this verdict; may be repeated.
    --category: Assets of this category; may be repeated.
    --manifests: Folder for the records. [default: beside the new store]

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
        summary = subset_store(store, out, chosen, manifests=manifests, progress=progress)
    report(output, summary)


@command()
@click.argument("stores", type=EXISTING_FOLDER, nargs=-1, required=True)
@option("--out", PLACE, required=True, metavar="STORE.zarr")
@option("--manifests", RECORDS_FOLDER)
def concat(output: Output, stores: tuple[Place, ...], out: Place, manifests: Path | None) -> None:
    """Make one store of the assets of all STORES, without aligning them again.

    The stores must have been built with the same parameters, and no id may be in two
    of them. If each has the ranges of its own dataset, properties are converted to the
    ranges of all.

    Options
    -------
    --out: The new store, a path or URL; an existing store is replaced in one step.
    --manifests: Folder for the records. [default: beside the new store]

    Example
    -------
    slatprep concat first.zarr second.zarr --out both.zarr
    """
    from slatprep.pipeline.join import concat_stores

    with output.progress("concat", "shards") as progress:
        summary = concat_stores(stores, out, manifests=manifests, progress=progress)
    report(output, summary)


@command()
@click.argument("store", type=EXISTING_FOLDER)
@option("--out", PLACE, metavar="STORE.zarr")
@option("--manifests", RECORDS_FOLDER)
def upgrade(output: Output, store: Place, out: Place | None, manifests: Path | None) -> None:
    """Convert a STORE of an older format to today's, without aligning again.

    Its sources are not needed: places, confidences and verdicts are computed
    from the store, and all other rows are copied unchanged.

    Options
    -------
    --out: The new store, a path or URL. [default: STORE itself, replaced in one step]
    --manifests: Folder for the records. [default: beside the new store]

    Example
    -------
    slatprep upgrade old.zarr
    slatprep upgrade old.zarr --out new.zarr
    """
    from slatprep.pipeline.upgrade import upgrade_store

    with output.progress("upgrade", "shards") as progress:
        summary = upgrade_store(store, out, manifests=manifests, progress=progress)
    if summary is None:
        output.result({"store": store}, lambda: say(f"{store} has today's format already"))
    else:
        report(output, summary)

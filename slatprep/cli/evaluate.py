"""`slatprep evaluate`: predictions by Pixie's protocol."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slatprep.cli.options import (
    EXISTING_FOLDER,
    NEW_FILE,
    ChoiceOf,
    command,
    note_split,
    option,
    split_options,
    split_rule,
)
from slatprep.cli.output import Output, write_csv

if TYPE_CHECKING:
    from slatprep.learn.metrics import Evaluation, Measure
    from slatprep.learn.published import PublishedScore
    from slatprep.records import Place


@command()
@click.argument("predictions", type=click.Path(path_type=Path, exists=True))
@option("--store", EXISTING_FOLDER, required=True, metavar="STORE.zarr")
@option("--split", ChoiceOf("slatprep.learn.splits:SPLITS", "all"), "test")
@split_options
@option("--spread", ChoiceOf("slatprep.learn.metrics:Spread"), "se")
@option("--csv", NEW_FILE, name="csv_file")
@option("--beside", metavar="pixie|slat-phys|FILE.csv", multiple=True)
def evaluate(
    output: Output,
    predictions: Path,
    store: Place,
    split: Any,
    split_by: str | None,
    shares: str | None,
    spread: Any,
    csv_file: Path | None,
    beside: tuple[str, ...],
) -> None:
    """Measure PREDICTIONS by Pixie's protocol.

    PREDICTIONS is a directory of npz files, one an asset, or a Zarr or HDF5
    store with one group an asset; each has properties (N,3) in normalised
    space, and may have material (N,) or logits (N,8), coords (N,3), and
    ranges (3,2), where they are not the store's. Errors are means over
    valid voxels, then over objects. Exit code 1 says that an asset of the
    split has no prediction. Predictions beside the run.json of a training
    are of the objects that it says, unless --split-by or --shares are given.

    Options
    -------
    --store: Has the truth.
    --split: Objects to measure on.
    --spread: Standard error or standard deviation over objects.
    --csv: Also write the table to this file.
    --beside: Also print the published table of Pixie, which has NeRF2Physics too, those of
        SLAT-Phys, or one of your own: a name, then columns named as here; may be repeated.

    Example
    -------
    slatprep evaluate runs/small/predictions --store demo.zarr
    slatprep evaluate predictions.h5 --store demo.zarr --split all --spread sd --csv scores.csv
    slatprep evaluate predictions --store pixieverse.zarr --split-by test_set.json
    slatprep evaluate runs/large/predictions --store pixieverse.zarr --beside pixie
    """
    from slatprep.learn.metrics import evaluate_store
    from slatprep.learn.predictions import RUN_FILE, selection_of_run
    from slatprep.learn.published import TABLES, read_scores
    from slatprep.learn.splits import HASH, assign_store
    from slatprep.store import open_store

    others = {
        name: TABLES[name][1] if name in TABLES else read_scores(Path(name)) for name in beside
    }
    rule, how = split_rule(split_by, shares), f"by {split_by or HASH}"
    selection = None if split_by or shares else selection_of_run(predictions)
    if selection is not None:
        rule |= {name: selection.pop(name) for name in ("by", "shares") if name in selection}
        how = f"as {predictions.absolute().parent / RUN_FILE} says"
    elif not split_by and not shares:
        how += ", as no run lies beside the predictions (others: --split-by, --split all)"
    assignment = assign_store(open_store(store), **rule)
    note_split(output, assignment, f"{split}, {how}")
    result = evaluate_store(
        predictions,
        store,
        None if split == "all" else split,
        spread=spread,
        splits=assignment.splits,
        **(selection or {}),
    )
    rows = _rows(result)
    names = (name for mean in result.overall.means for name in (mean, f"{mean} {spread}"))
    header = ("category", "objects", *names)
    if csv_file is not None:
        write_csv(csv_file, header, rows)

    def show() -> None:
        what = "standard error" if spread == "se" else "standard deviation"
        output.table(
            f"Mean squared error in normalised space, class accuracy (± {what} over n objects)",
            ("category", "n", *result.overall.means),
            _in_short(result),
        )
        for name, scores in others.items():
            _show_beside(output, result, scores, name)

    if result.converted:
        output.note(
            f"note:    {result.converted} predictions were normalised by other ranges, and were "
            "brought to the store's"
        )
    document = dataclasses.asdict(result)
    for asset_id in result.missing:
        output.problem(f"{predictions}: no prediction of {asset_id}")
    if beside:
        document["beside"] = [score for scores in others.values() for score in scores]
    output.result(document, show, complete=not result.missing)


def _show_beside(
    output: Output, result: Evaluation, others: tuple[PublishedScore, ...], beside: str
) -> None:
    names = tuple(result.overall.means)
    rows: list[tuple[str | float | None, ...]] = [
        ("these predictions", *result.overall.means.values())
    ]
    rows += [(score.method, *(score.means.get(name) for name in names)) for score in others]
    from slatprep.learn.published import TABLES

    if beside in TABLES:
        title = f"Beside {TABLES[beside][0]}"
        output.note(
            "note: those were measured on PixieVerse's test objects; they compare only with "
            "predictions of the same objects, normalised by Pixie's ranges (--ranges pixie)"
        )
    else:
        title = f"Beside {beside}"
    output.table(title, ("method", *names), rows)


def _in_short(result: Evaluation) -> list[tuple[str | int, ...]]:
    """Return the rows for people: each mean with its spread, where there is one."""
    rows: list[tuple[str | int, ...]] = []
    for name, m in {**result.categories, "all": result.overall}.items():
        cells = (
            f"{mean:.3f}" if math.isnan(m.spreads[key]) else f"{mean:.3f}±{m.spreads[key]:.3f}"
            for key, mean in m.means.items()
        )
        rows.append((name or "(none)", m.objects, *cells))
    return rows


def _rows(result: Evaluation) -> list[tuple[str | int | float, ...]]:
    measures: dict[str, Measure] = {**result.categories, "all": result.overall}
    return [
        (name or "(none)", m.objects, *(s[key] for key in m.means for s in (m.means, m.spreads)))
        for name, m in measures.items()
    ]

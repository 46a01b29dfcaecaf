"""`slatprep evaluate`: measure the errors of predictions, beside those of other methods."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from slatprep.cli import options
from slatprep.cli.output import Output, write_csv
from slatprep.cli.signature import Click, command
from slatprep.errors import apart_from

if TYPE_CHECKING:
    from slatprep.learn.metrics import Measure
    from slatprep.learn.published import PublishedScore
    from slatprep.store import Store


@command()
def evaluate(
    output: Output,
    predictions: options.FileOrFolder | None = None,
    *,
    store: options.FolderOrUrl,
    grids: tuple[str, ...] = (),
    split: Annotated[Any, options.ChoiceOf("slatprep.readers.splits:SPLITS", "all")] = "test",
    splits: options.SplitOptions,
    spread: Annotated[Any, options.ChoiceOf("slatprep.learn.metrics:SPREADS")] = "se",
    csv_file: Annotated[options.NewFile | None, Click("--csv")] = None,
    picture: options.DrawnFile | None = None,
    beside: tuple[str, ...] = (),
) -> None:
    """Measure PREDICTIONS by Pixie's protocol.

    PREDICTIONS is a folder with an npz for each asset, the folder of a
    training, or a Zarr group or HDF5 file with a group for each asset. Each
    has properties (N,3) in normalised space, and may have material (N,) or
    logits (N,8), coords (N,3), valid (N,), and ranges (3,2) if they differ
    from the store's. Errors are means over valid voxels, then over objects.
    An asset of the split with a bad prediction, or without one, is named and
    omitted; the exit code is then 1. Predictions beside the run.json of a
    training take the split of the run, unless --split-by or --shares is given.

    Parameters
    ----------
    store : STORE.zarr
        The store with the labels.
    grids : [NAME=]DIR
        Grids predicted by Pixie or another method: DIR/ID/sample_0_pred.npy, with 11 or 4 channels;
        may be repeated. They are measured on their own voxels and at the SLAT's voxels, on the same
        objects as PREDICTIONS, which may be omitted.
    split
        Take only objects of this split.
    spread
        Standard error or standard deviation over objects, or the spread that Pixie prints.
    csv_file
        Also write the table to this file, without the reference models.
    picture
        With --grids, also draw the table.
    beside : pixie|slat-phys|FILE.csv
        Also print the published scores of Pixie (with NeRF2Physics) or of SLAT-Phys, or a CSV with
        names in the first column and this table's column names; may be repeated.

    Example
    -------
    slatprep evaluate runs/small/predictions --store data/demo.zarr
    slatprep evaluate predictions.h5 --store data/demo.zarr --split all --spread sd --csv scores.csv
    slatprep evaluate predictions --store pixieverse.zarr --split-by test_set.json
    slatprep evaluate runs/large/predictions --store pixieverse.zarr --beside pixie
    slatprep evaluate predictions --store data/demo.zarr --grids Pixie=results --picture m.png
    """
    from slatprep.errors import UNKNOWN
    from slatprep.learn.evaluate import draw_comparison, evaluate_store, require_pixieverse
    from slatprep.learn.metrics import OURS, SPREADS, metrics_of
    from slatprep.learn.predictions import predictions_of
    from slatprep.learn.published import TABLES, read_scores

    if predictions is None and not grids:
        raise click.UsageError("nothing to measure; give PREDICTIONS, --grids, or both")
    if picture is not None and not grids:
        raise click.UsageError("--picture draws methods side by side; give --grids as well")
    predictions = predictions and predictions_of(predictions)
    folders = _folders_of_grids(grids)
    opened = options.opened(store)
    metrics = metrics_of(opened.normalization)
    published = {
        name: TABLES[name][1] if name in TABLES else read_scores(Path(name), metrics)
        for name in beside
    }
    for name in TABLES.keys() & published:
        require_pixieverse(opened, f"the scores of --beside {name}")
    filters, left_out = _selected(output, predictions, opened, split, splits)
    result = evaluate_store(predictions, store, spread=spread, grids=folders, **filters)
    measures, what = result.methods, "method"
    if not grids:
        groups, others = result.categories.items(), {UNKNOWN, "all", *result.baselines}
        measures = {apart_from(name, others) or UNKNOWN: own[OURS] for name, own in groups}
        measures["all"], what = result.methods[OURS], "category"
    if grids and opened.merges:
        output.note(
            "note:    labels are merged from several annotations, and own grids are measured on "
            "the first of them"
        )
    if result.partly_annotated:
        output.note(
            "note:    objects with occupied voxels that have no annotation and are not scored: "
            f"{result.partly_annotated}; Pixie's loader leaves such objects out"
        )
    if result.converted:
        output.note(
            "note:    predictions normalised by other ranges, converted to the store's: "
            f"{result.converted}"
        )
    if result.classless:
        some = f"{', '.join(result.classless[:3])} ({len(result.classless)} in all; --json)"
        output.note(f"note:    predictions without a class, not in the accuracy: {some}")
    if csv_file is not None:
        _write_scores(output, csv_file, what, measures, spread)
    if picture is not None:
        options.draw_to(output, picture, partial(draw_comparison, measures, SPREADS[spread]))

    output.problems(result.problems, "--json lists them")
    document = vars(result) | {"store": store, "problems": result.problems + left_out}
    if beside:
        document["beside"] = [score for scores in published.values() for score in scores]

    def show() -> None:
        output.table(
            "Mean squared error in normalised space, class accuracy "
            f"(± {SPREADS[spread]} over n objects)",
            (what, "n", *metrics),
            [_row_of_scores(name, one) for name, one in (measures | result.baselines).items()],
        )
        if TABLES.keys() & published:
            output.note(
                "note: those beside were measured on PixieVerse's test objects; they compare only "
                "with predictions of the same objects, normalised by Pixie's ranges (--ranges "
                "pixie)"
            )
        means = {name: one.means for name, one in result.methods.items()}
        for name, scores in published.items():
            title = TABLES[name][0] if name in TABLES else name
            _show_beside(output, f"Beside {title}", means, scores)

    output.result(document, show, complete=not result.problems)


def _selected(
    output: Output,
    predictions: Path | None,
    store: Store,
    split: Any,
    splits: options.SplitOptions,
) -> tuple[dict[str, Any], list[str]]:
    """Return the selection of assets, by the options or by a run, and lines on omitted assets."""
    from slatprep.learn.predictions import selection_of_run
    from slatprep.learn.splits import select_assets
    from slatprep.records import Verdict

    filters: dict[str, Any] = {}
    rule, how = splits.rule, f"by {splits.rule['by']}"
    run = selection_of_run(predictions) if predictions and not splits.given else None
    if run is not None:
        file, rule, filters = run
        how = f"as {file} says"
    elif not splits.given and split != "all":
        how += ", as no run lies beside the predictions" if predictions else ""
        how += " (others: --split-by, --split all)"
    of_object = options.split_of_objects(output, store, rule, f"{split}, {how}")
    part = None if split == "all" else split
    without = set[int]()
    if filters:
        rows, kept = (select_assets(store, part, splits=of_object, **own) for own in ({}, filters))
        without = {*rows.tolist()} - {*kept.tolist()}
    verdicts = filters.get("verdicts") or tuple(Verdict)
    others = f"above the ambiguity {filters.get('max_ambiguity')}"
    left_out = options.note_left_out(output, store, without, verdicts, how, others)
    return {"split": part, "splits": of_object, **filters}, left_out


def _folders_of_grids(grids: tuple[str, ...]) -> dict[str, Path]:
    """Return the folders of ``--grids`` by the method's name, which defaults to the folder's."""
    folders: dict[str, Path] = {}
    for text in grids:
        name, _, rest = text.rpartition("=")
        folder = Path(text) if Path(text).is_dir() else Path(rest)
        if not rest or not folder.is_dir():
            raise click.BadParameter(f"{text!r} is no folder", param_hint="--grids")
        name = folder.resolve().name if folder == Path(text) else name.strip()
        if not name:
            raise click.BadParameter(f"{text!r} has no name before =", param_hint="--grids")
        if name in folders:
            raise click.BadParameter(
                f"two folders are called {name!r}; name them apart: NAME=DIR", param_hint="--grids"
            )
        folders[name] = folder
    return folders


def _write_scores(
    output: Output, file: Path, what: str, measures: Mapping[str, Measure], spread: str
) -> None:
    metrics = next(iter(measures.values())).means
    names = (name for mean in metrics for name in (mean, f"{mean} {spread}"))
    rows = (
        (name, m.objects, *(s[key] for key in metrics for s in (m.means, m.spreads)))
        for name, m in measures.items()
    )
    write_csv(output, file, (what, "objects", *names), rows)


def _show_beside(
    output: Output,
    title: str,
    ours: Mapping[str, Mapping[str, float]],
    others: tuple[PublishedScore, ...],
) -> None:
    names = tuple(next(iter(ours.values())))
    means = [*ours.items(), *((score.method, score.means) for score in others)]
    rows = [(name, *map(own.get, names)) for name, own in means]
    output.table(title, ("method", *names), rows)
    spreads = [
        (one.method, *map(one.spreads.get, names), one.spread) for one in others if one.spreads
    ]
    if spreads:
        output.table("Their spreads, as printed", ("method", *names, "kind"), spreads)


def _row_of_scores(name: str, scores: Measure) -> tuple[str | int, ...]:
    """Return a row of the printed table: each mean with its spread, if there is one."""
    cells = zip(scores.means.values(), scores.spreads.values(), strict=True)
    texts = (f"{mean:.3f}" + ("" if math.isnan(s) else f"±{s:.3f}") for mean, s in cells)
    return name, scores.objects, *("-" if text == "nan" else text for text in texts)

"""`slatprep measure-errors`: how many verdicts of a store are wrong."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated

from slatprep.cli.options import DrawnFile, Jobs, LastStore, Positive, draw_to
from slatprep.cli.output import Output
from slatprep.cli.signature import Click, command

if TYPE_CHECKING:
    from slatprep.inspect.errors import MeasuredErrors

_RATES = (0.001, 0.01, 0.05)


@command()
def measure_errors(
    output: Output,
    store: LastStore,
    *,
    decoys: Annotated[
        Positive, "Align at most N grids with other SLATs.", Click(metavar="N")
    ] = 200,
    seed: Annotated[int, "Seed of the draw of decoys."] = 0,
    picture: Annotated[
        DrawnFile | None, "Also draw alignments and decoys as two histograms."
    ] = None,
    jobs: Jobs = 1,
) -> None:
    """Measure on decoys how many alignments of STORE show another object.

    A decoy is an asset's grid aligned with the SLAT of another object of about its size.
    Decoys show how wrong pairs of this dataset score. No asset of the store is
    aligned again, and no verdict is changed. What decoys gave is kept beside the records
    of the build, and taken over after an update.

    Example
    -------
    slatprep measure-errors data/demo.zarr --jobs 2 --picture errors.png
    """
    from slatprep.inspect.errors import measure_errors as measure
    from slatprep.store import open_store

    opened = open_store(store)
    with output.progress("decoys") as progress:
        found = measure(opened, decoys, seed, jobs, progress)
    if picture is not None:
        from slatprep.inspect.pictures.errors import draw_errors

        draw_to(output, picture, partial(draw_errors, found, opened.name))
    output.result(_summary(found), lambda: _show(output, found))


def _summary(found: MeasuredErrors) -> dict[str, object]:
    rates = found.rates
    return {
        "assets": rates.targets,
        "decoys": rates.decoys,
        "aligned": found.aligned,
        "seed": found.seed,
        "refitted": rates.refitted,
        "wrong_share": rates.wrong_share,
        "wrong_share_range": list(rates.wrong_share_range),
        "sure": rates.good,
        "sure_wrong": rates.good_wrong,
        "sure_wrong_range": list(rates.good_wrong_range),
        "kept": {f"{rate:g}": rates.kept(rate) for rate in _RATES},
        "errors": dict(zip(found.ids, rates.errors.tolist(), strict=True)),
    }


def _show(output: Output, found: MeasuredErrors) -> None:
    rates = found.rates
    for sentence in found.sentences():
        output.note(sentence)
    output.table(
        "Assets that can be kept, by the share of wrong ones among them",
        ("wrong at most", "assets", "of all"),
        [(f"{rate:.1%}", kept, kept / rates.targets) for rate in _RATES
         for kept in (rates.kept(rate),)],
    )  # fmt: skip
    worst = sorted(zip(rates.errors.tolist(), found.ids, strict=True), reverse=True)[:10]
    likely = [(asset_id, error) for error, asset_id in worst if error >= 0.5]
    if likely:
        output.table("Most likely another object", ("id", "probability"), likely)

"""`slatprep measure-errors`: how many verdicts of a store are wrong."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from slatprep.cli.options import DrawnFile, Jobs, LastStore, Positive, draw_to
from slatprep.cli.output import Output
from slatprep.cli.signature import command

if TYPE_CHECKING:
    from slatprep.pipeline.decoys import MeasuredErrors


@command()
def measure_errors(
    output: Output,
    store: LastStore,
    *,
    decoys: Positive = 200,
    seed: int = 0,
    picture: DrawnFile | None = None,
    jobs: Jobs = 1,
) -> None:
    """Measure on decoys how many alignments of STORE show another object.

    A decoy is an asset's grid aligned with the SLAT of another object of about its size.
    Decoys show how wrong pairs of this dataset score. No asset of the store is
    aligned again, and no verdict is changed. What decoys gave is kept in decoys.json beside
    the store, and taken over after an update. A build does the same with fewer decoys.

    Parameters
    ----------
    decoys : N
        Align at most N grids with other SLATs.
    seed
        Seed of the draw of decoys.
    picture
        Also draw alignments and decoys as two histograms.

    Example
    -------
    slatprep measure-errors data/demo.zarr --jobs 2 --picture errors.png
    """
    from slatprep.pipeline.decoys import measure_errors as measure
    from slatprep.store import open_store

    opened = open_store(store)
    with output.progress("decoys") as progress:
        found = measure(opened, decoys, seed, jobs, progress)
    if picture is not None:
        from slatprep.inspect.pictures.errors import draw_errors

        draw_to(output, picture, partial(draw_errors, found, opened.name))
    output.result(_summary(found), lambda: _show(output, found))


def _summary(found: MeasuredErrors) -> dict[str, object]:
    names = ("assets", "seed", "refitted", "wrong_share", "wrong_share_range", "good",
             "good_wrong", "good_wrong_range", "errors")  # fmt: skip
    kept = {f"{kept.rate:g}": kept.assets for kept in found.kept}
    own = {name: getattr(found, name) for name in names}
    return own | {"decoys": len(found.decoys), "kept": kept}


def _show(output: Output, found: MeasuredErrors) -> None:
    for sentence in found.sentences():
        output.note(sentence)
    output.table(
        "Assets that can be kept, by the share of wrong ones among them",
        ("wrong at most", "assets", "of all"),
        [(f"{kept.rate:.1%}", kept.assets, kept.assets / found.assets) for kept in found.kept],
    )
    worst = sorted(found.errors.items(), key=lambda one: (-one[1], one[0]))[:10]
    likely = [(asset_id, error) for asset_id, error in worst if error >= 0.5]
    if likely:
        output.table("Most likely another object", ("id", "probability"), likely)

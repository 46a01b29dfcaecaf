"""`slatprep score`: a store against known truth."""

from __future__ import annotations

from operator import attrgetter

from slatprep.cli.options import Folder, FolderOrUrl
from slatprep.cli.output import Output
from slatprep.cli.signature import command


@command()
def score(output: Output, store: FolderOrUrl, truth_dir: Folder) -> None:
    """Score STORE against known truth.

    TRUTH_DIR holds an npz for each asset, as make-demo writes it. Figures of a
    level leave out symmetric assets. Success is a mean displacement less than
    1.5 voxels above that of the best similarity. Displacement is the median,
    p90 the 90th percentile. Labels is the share of right classes; without
    classes, of right properties. Beside it stands what the best similarity and
    the true places would give. The exit code is 1 if an asset with a truth is
    not in the store.

    Example
    -------
    slatprep score demo.zarr demo/truth
    """
    from slatprep.inspect.score import score_against_truth

    with output.progress("score") as progress:
        report = score_against_truth(store, truth_dir, progress)

    def show() -> None:
        if output.verbosity > 0:
            output.table(
                "Assets against truth",
                ("asset", "name", "level", "symmetric", "displacement", "best similarity",
                 "labels", "best similarity", "true places", "valid"),
                map(
                    attrgetter("asset_id", "name", "level", "symmetric", "displacement",
                               "similarity_displacement", *labels),
                    report.assets,
                ),
            )  # fmt: skip
        output.table(
            "Places against truth (non-symmetric assets; displacement in voxels)",
            ("level", "assets", "success", "displacement", "p90", "best similarity"),
            [
                (f"L{s.level}", s.assets, s.success, s.displacement_median, s.displacement_p90,
                 s.similarity_displacement)
                for s in report.levels
            ],
        )  # fmt: skip
        output.table(
            "Labels against truth (of the same assets; shares)",
            ("level", "labels", "best similarity", "true places", "valid"),
            [(f"L{s.level}", *attrgetter(*labels)(s)) for s in report.levels],
        )

    labels = ("label_accuracy", "similarity_accuracy", "truth_own", "valid_share")
    for asset_id in report.missing:
        output.problem(f"{truth_dir / asset_id}.npz: its asset is not in {store}")
    output.result(report, show, complete=not report.missing)

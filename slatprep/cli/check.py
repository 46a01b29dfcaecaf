"""`slatprep check-alignment`, `score` and `measure-errors`: check how good alignments are."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from itertools import zip_longest
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slatprep.cli import options
from slatprep.cli.output import Output, say
from slatprep.cli.signature import command

if TYPE_CHECKING:
    from slatprep.inspect.check import AlignmentCheck
    from slatprep.pipeline.measured import MeasuredErrors
    from slatprep.records import Place
    from slatprep.store import Store

_FIGURES = ("confidence", "expected_accuracy", "fitness", "fitness_backward", "valid_share",
            "ambiguity")  # fmt: skip
"""Figures in a line of the table, which has room for six."""


@command("check-alignment")
def check_alignment(
    output: Output,
    store: options.FolderOrUrl | None = None,
    *,
    asset_ids: options.AssetIds = (),
    worst: options.Positive | None = None,
    ambiguous: bool = False,
    named: options.StoreOption | None = None,
    picture: options.NewFileOrFolder | None = None,
    show: bool = False,
    jobs: options.Jobs = 1,
) -> None:
    """Check whether the alignment of an asset of STORE is good, and draw it.

    Quality and labels are computed again from the stored arrays. Each figure
    agrees with the stored figure if it differs by no more than the tolerance.
    Changes are from a voxel's stored label to its new label. A picture shows both
    sides before and after from three directions, the error of every voxel, the
    candidates and the verdict. --asset, --worst and --ambiguous may be combined.
    The exit code is 1 unless all alignments are good and the store is consistent.
    Without STORE, the store that `make align` built last under data/ is used.

    Parameters
    ----------
    worst
        Check the N worst assets: failed first, then doubtful, each sorted by confidence.
    ambiguous
        Check assets whose ties would change the labels of more than 5 % of the voxels.
    picture : PATH|none
        A .png, .svg or .pdf for one asset, else a folder. [default: NAME.pictures beside the store]
    show
        Open the alignment in Open3D's viewer, if there is a screen.

    Example
    -------
    slatprep check-alignment data/demo.zarr --asset 5f61cc
    slatprep check-alignment --worst 12 --ambiguous --picture pictures
    slatprep check-alignment --asset 5f61cc --asset 803c1a --json --picture none
    """
    if not (asset_ids or worst or ambiguous):
        raise click.UsageError("say which assets: --asset ID, --worst N or --ambiguous")
    if store is not None and named is not None:
        raise click.UsageError("STORE and --store both name the store; give one of them")
    path = options.chosen_store(store or named)
    from slatprep.inspect import check
    from slatprep.pipeline.measured import measured_errors
    from slatprep.pipeline.rows import SourceStore
    from slatprep.workers.local import run_in_order

    opened = options.opened(path)
    options.note_numbered(output, opened, asset_ids)
    chosen = check.choose_assets(opened, asset_ids, worst or 0, ambiguous)
    target = _target(path, picture, len(chosen))
    source = SourceStore(opened)
    tasks = ((source, asset_id) for asset_id in chosen)
    checks = list(run_in_order(check.check_alignment, tasks, jobs))
    pictures: list[Path] = []
    sheet = None
    if target is not None and checks:
        from slatprep.inspect.pictures.write import write_pictures

        with output.progress("pictures") as progress:
            pictures, sheet = write_pictures(opened, checks, target, jobs=jobs, progress=progress)

    measured = measured_errors(opened.path)
    if measured and not (measured.tells and measured.build == opened.about.manifest):
        measured = None  # It says nothing about single assets, or is older than an update.
    assets = []
    for one, file in zip_longest(checks, pictures):
        figures = [
            asdict(own) | {"ok": own.ok, "good": own.threshold_text, "passes": own.passes}
            for own in one.figures
        ]
        found = {"figures": figures, "consistent": one.consistent, "ok": one.ok, "picture": file}
        if measured:
            found["another_object"] = measured.errors.get(one.asset_id, 0.0)
        assets.append(asdict(one) | found)

    def print_all() -> None:
        _print(output, checks)
        for one in chosen:
            if measured and (len(chosen) == 1 or output.verbosity > 0):
                say(f"{one}: {measured.of_asset(one)}")
        if sheet is not None:
            say(f"pictures: {target} ({len(pictures)}), all in one: {sheet}")
        elif pictures:
            say(f"picture: {pictures[0]}")
        output.note(f"store: {path}")

    if show:
        _open_viewer(output, opened, chosen, sheet or (pictures[0] if pictures else None))
    document = {"store": path, "assets": assets, "sheet": sheet}
    output.result(document, print_all, complete=all(one.ok for one in checks))


def _target(store: Place, picture: Path | None, assets: int) -> Path | None:
    if picture is None:
        from slatprep.store.reader import require_beside

        require_beside(folder := options.beside(store, ".pictures"))
        return folder
    if picture == Path("none"):
        return None
    from slatprep.records import PICTURE_FORMATS

    allowed = "", ".pictures", *(f".{kind}" for kind in PICTURE_FORMATS)
    if picture.suffix.lower() not in allowed and not picture.is_dir():
        raise click.UsageError(
            f"--picture {picture}: expected a file that ends in .{', .'.join(PICTURE_FORMATS)}, a "
            "folder without a suffix or with .pictures, or the word none"
        )
    if assets > 1 and picture.suffix.lower()[1:] in PICTURE_FORMATS:
        raise click.UsageError(f"--picture {picture} is one file; {assets} assets need a folder")
    return picture


def _print(output: Output, checks: list[AlignmentCheck]) -> None:
    if not checks:
        say("no asset is ambiguous")
    if len(checks) > 1:
        length = output.id_length(one.asset_id for one in checks)
        output.table(
            "Alignments",
            ("asset", "verdict", *_FIGURES),
            [(one.asset_id[:length], one.verdict, *map(one.value, _FIGURES)) for one in checks],
        )
    for one in checks:
        if len(checks) == 1 or output.verbosity > 0:
            output.table(
                f"{one.asset_id}: alignment {one.verdict}",
                ("figure", "computed", "good if", "passes", "stored", "tolerance", "agrees"),
                [
                    (
                        figure.name,
                        float(figure.value),
                        figure.threshold_text,
                        "" if figure.passes is None else figure.passes,
                        float(figure.stored),
                        f"{figure.limit:g}",
                        figure.ok,
                    )
                    for figure in one.figures
                ],
            )
        for words in one.remarks if len(checks) > 1 else one.words:
            say(f"{one.asset_id}: {words}")
        for words in one.unusual:
            say(f"{one.asset_id}: unusual: {words}")
        if not one.consistent:
            say(
                f"{one.asset_id}: the store says {one.stored_verdict}, and its figures do not all "
                "agree: it was changed, or another version of slatprep built it"
            )


def _open_viewer(output: Output, store: Store, asset_ids: list[str], file: Path | None) -> None:
    """Open the viewer, or print why it cannot open and where the picture is."""
    from slatprep.inspect.pictures.scene import scene_of
    from slatprep.inspect.pictures.viewer import has_screen, show_alignment

    instead = f"look at {file}" if file else "draw a picture: leave out --picture none"
    if not has_screen():
        output.problem(f"there is no screen to show it on; {instead}")
        return
    for asset_id in asset_ids:
        if not show_alignment(scene_of(store.asset(asset_id)), asset_id):
            output.problem(f"Open3D could not open a window; {instead}")
            return


@command()
def score(output: Output, store: options.FolderOrUrl, truth_dir: options.Folder) -> None:
    """Score STORE against known truth.

    TRUTH_DIR holds an npz for each asset, as make-demo writes it. Figures of a
    level omit symmetric assets. Success is a mean displacement less than
    1.5 voxels above that of the best similarity. Displacement is the median,
    p90 the 90th percentile. Labels is the share of right classes; without
    classes, of right properties. Similarity displacement and similarity labels
    are the figures of the best similarity; true-place labels are those of the
    true places. The exit code is 1 if an asset with a truth is not in the store.

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
                ("asset", "name", "level", "symmetric", "displacement",
                 "similarity displacement", "labels", "similarity labels", "true-place labels",
                 "valid"),
                map(
                    attrgetter("asset_id", "name", "level", "symmetric", "displacement",
                               "similarity_displacement", *labels),
                    report.assets,
                ),
            )  # fmt: skip
        output.table(
            "Places against truth (non-symmetric assets; displacement in voxels)",
            ("level", "assets", "success", "displacement", "p90", "similarity displacement"),
            [
                (f"L{s.level}", s.assets, s.success, s.displacement_median, s.displacement_p90,
                 s.similarity_displacement)
                for s in report.levels
            ],
        )  # fmt: skip
        output.table(
            "Labels against truth (of the same assets; shares)",
            ("level", "labels", "similarity labels", "true-place labels", "valid"),
            [(f"L{s.level}", *attrgetter(*labels)(s)) for s in report.levels],
        )

    labels = ("label_accuracy", "similarity_accuracy", "truth_own", "valid_share")
    missing = [f"{truth_dir / name}.npz: its asset is not in {store}" for name in report.missing]
    output.problems(missing, "--json has all")
    output.result(report, show, complete=not report.missing)


@command()
def measure_errors(
    output: Output,
    store: options.LastStore,
    *,
    decoys: options.Positive = 200,
    seed: options.Seed = 0,
    picture: options.DrawnFile | None = None,
    jobs: options.Jobs = 1,
) -> None:
    """Measure with decoys how many alignments of STORE show another object.

    A decoy is an asset's grid aligned with the SLAT of another object of about its size.
    Decoys show how wrong pairs of this dataset score. No asset of the store is
    aligned again, and no verdict changes. The results are kept beside the store, in
    NAME.manifests/decoys.json, and reused after an update. A build does the same with
    fewer decoys.

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

    opened = options.opened(store)
    with output.progress("measure errors", "decoys") as progress:
        found = measure(opened, decoys, seed, jobs, progress)
    if picture is not None:
        from slatprep.inspect.pictures.statistics import draw_errors

        options.draw_to(output, picture, partial(draw_errors, found, opened.name))
    output.result(_document(found), lambda: _show_errors(output, found))


def _document(found: MeasuredErrors) -> dict[str, object]:
    names = ("assets", "seed", "refitted", "wrong_share", "wrong_share_range", "good",
             "good_wrong", "good_wrong_range", "errors")  # fmt: skip
    kept = {f"{kept.rate:g}": kept.assets for kept in found.kept}
    own = {name: getattr(found, name) for name in names}
    return own | {"tells": found.tells, "decoys": len(found.decoys), "kept": kept}


def _show_errors(output: Output, found: MeasuredErrors) -> None:
    for sentence in found.sentences():
        output.note(sentence)
    if not found.tells:
        return
    output.table(
        "Assets that can be kept, by the share of wrong ones among them",
        ("wrong at most", "assets", "of all"),
        [(f"{kept.rate:.1%}", kept.assets, kept.assets / found.assets) for kept in found.kept],
    )
    worst = sorted(found.errors.items(), key=lambda one: (-one[1], one[0]))[:10]
    likely = [(asset_id, error) for asset_id, error in worst if error >= 0.5]
    if likely:
        output.table("Most likely another object", ("id", "probability"), likely)

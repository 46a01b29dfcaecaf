"""Measure predictions of SLAT voxels and predicted grids, side by side on the same objects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, InputError, amount, require_one_of
from slatprep.learn.metrics import (
    METRICS,
    OURS,
    SPREADS,
    Measures,
    Spread,
    average_methods,
    fit_baselines,
    score_asset,
)
from slatprep.learn.predictions import (
    VoxelPrediction,
    check_prediction,
    open_predictions,
    require_normalised,
)
from slatprep.learn.splits import select_assets
from slatprep.parameters import PixieverseSource
from slatprep.readers.adapters import find_grids, one_grid
from slatprep.readers.pixieverse import read_prediction
from slatprep.readers.splits import Split
from slatprep.records import (
    BACKGROUND,
    INK,
    MATERIAL_CLASSES,
    MUTED,
    PICTURE_FORMATS,
    PROPERTY_COLUMNS,
    SVG_SALT,
    UNANNOTATED,
    Place,
)
from slatprep.sample import sample
from slatprep.store import Store, StoredAsset, open_store

_BARS = "#AFC3DC"

_TITLES = {
    "log10 E": "log10 of Young's modulus",
    "log10 density": "log10 of density",
    "nu": "Poisson's ratio",
    "mean": "mean of the errors",
    "accuracy": "share of right classes",
}
"""Metrics in plain English."""

_GRIDS = (*PixieverseSource.grid, "{id}.npy")


@dataclass(frozen=True)
class Evaluation:
    """Scores of predictions, of predicted grids and of the reference models, on the same objects.

    Attributes
    ----------
    spread : str
        The kind of `Measure.spreads`, one of `slatprep.learn.metrics.SPREADS`.
    methods : dict of str to Measure
        Scores over all objects by the method's name: `OURS`, and two of each folder of grids.
    baselines : dict of str to Measure
        The reference models on the same assets, see `fit_baselines`; empty if the split train has
        no object.
    categories : dict of str to dict of str to Measure
        Scores by category, then by the name of a method or reference model.
    missing : list of str
        Assets of the split without a prediction for SLAT voxels; they are not in the scores.
    problems : list of str
        Why assets of the split are not in the scores: a method has no prediction, or a bad one.
    classless : list of str
        Assets whose prediction for SLAT voxels has no class; they are not in its accuracy.
    converted : int
        Assets whose prediction was normalised by other ranges and was converted to the store's.
    partly_annotated : int
        If grids are measured, objects with occupied voxels that are not annotated and so not
        scored. Pixie's loader leaves such objects out.
    """

    spread: Spread
    methods: Measures
    baselines: Measures
    categories: dict[str, Measures]
    missing: list[str]
    problems: list[str]
    classless: list[str]
    converted: int
    partly_annotated: int


def evaluate_store(
    predictions: Path | None,
    store_path: Place,
    split: Split | None = "test",
    spread: Spread = "se",
    grids: Mapping[str, Path] | None = None,
    **filters: Any,
) -> Evaluation:
    """Measure predictions of SLAT voxels and predicted grids against a store.

    A grid is measured twice. Its own voxels are measured by Pixie's protocol (vlongle/pixie,
    ``inference_combined.py``): squared errors in normalised space and class accuracy, means over
    the object's annotated voxels, then over objects. A voxel predicted as background has the wrong
    class, but its properties count. Only a grid in SI units is clipped. At the SLAT's voxels, the
    grid's values are sampled as the store's labels were, at the stored places. The grid that the
    labels were made from therefore has no error there.

    `predictions` is read by `slatprep.learn.predictions.open_predictions`, a file of `grids` by
    `slatprep.readers.pixieverse.read_prediction`: ``<object id>/sample_<k>_pred.npy``, ``<object
    id>/sample_<k>/material_grid.npy`` or ``<object id>.npy``. Split and filters are those of
    `slatprep.learn.splits.select_assets`. An asset without a usable prediction of every method is
    left out of all and named. InputError if none is left; ConfigError if grids are given and the
    store holds other properties or classes, or nothing or no such spread is asked for.
    """
    require_one_of("spread", spread, tuple(SPREADS))
    if predictions is None and not grids:
        raise ConfigError("nothing to measure; give predictions, grids, or both")
    store, grids = open_store(store_path), grids or {}
    if grids:
        require_pixieverse(store, "grids of Pixie's form")
    object_ids = store.column("object_id")
    found = {name: find_grids(PixieverseSource(root, _GRIDS)) for name, root in grids.items()}
    trained = select_assets(store, "train", **filters).tolist()
    baselines = fit_baselines(store, trained) if trained else ()
    scored: dict[int, list[NDArray[np.float64]]] = {}
    partly: set[str] = set()
    missing: list[str] = []
    bad: list[str] = []
    classless: list[str] = []
    converted, held = 0, (store.normalization, store.contents)
    with open_predictions(predictions) if predictions else nullcontext() as read:
        for index in select_assets(store, split, **filters).tolist():
            asset_id, object_id = store.ids[index], str(object_ids[index])
            try:
                arrays = read(asset_id) if read else {}
                if arrays is None:
                    missing.append(asset_id)
                    continue
                asset = store.asset(index)
                ours = None
                if predictions:
                    where = f"{predictions}/{asset_id}"
                    ours = check_prediction(where, arrays, asset.coords, *held, asset.valid)
                rows = [_score(ours, asset)] if ours else []
                for name, root in grids.items():
                    path = one_grid(root, found[name].get(object_id, []), object_id, _GRIDS)
                    rows += _score_grid(path, root, asset)
            except InputError as error:
                bad.append(str(error))
                continue
            scored[index] = [*rows, *(_score(one.predict(vars(asset)), asset) for one in baselines)]
            if ours:
                converted += ours.converted
                if ours.material is None and store.contents.classes:
                    classless.append(asset_id)
            if grids and (asset.grid_material == UNANNOTATED).any():
                partly.add(object_id)
    problems = [*(f"{predictions}: no prediction of {name}" for name in missing), *bad]
    if not scored:
        place = predictions or next(iter(grids.values()))
        raise _nothing_scored(place, not grids, f"split {split or 'all'}", problems, missing)
    names = [OURS] if predictions else []
    names += [f"{name}, {where}" for name in grids for where in ("SLAT voxels", "own grid")]
    names += [one.name for one in baselines]
    methods, groups = average_methods(store, scored, names, spread)
    beside = {one.name: methods.pop(one.name) for one in baselines}
    return Evaluation(
        spread, methods, beside, groups, missing, problems, classless, converted, len(partly)
    )


def require_pixieverse(store: Store, others: str) -> None:
    """Raise ConfigError if a store holds other properties or classes than PixieVerse's."""
    held = tuple(one.name for one in store.contents.properties), store.contents.classes
    if held != (PROPERTY_COLUMNS, MATERIAL_CLASSES):
        raise ConfigError(
            f"{store.path} holds {', '.join(held[0])} and {len(held[1])} classes, which {others} "
            "do not; expected a store of PixieVerse's properties and classes"
        )


def _score(prediction: VoxelPrediction, asset: StoredAsset) -> NDArray[np.float64]:
    """Return the metrics of a prediction for an asset's SLAT voxels."""
    if not asset.store.contents.classes:
        prediction = replace(prediction, material=None)
    return score_asset(prediction, vars(asset))


def _score_grid(path: Place, root: Place, asset: StoredAsset) -> Iterator[NDArray[np.float64]]:
    """Yield the metrics of a predicted grid at an asset's SLAT voxels, and on the grid itself."""
    store, stored = asset.store, asset.normalised_field
    annotated = asset.grid_material < BACKGROUND
    properties, material = read_prediction(path, root, annotated, store.normalization)
    require_normalised(path, properties)
    own = VoxelPrediction(properties, material.astype(np.int64))
    # These values are normalised; the lookup copies them without regard to a unit.
    field = replace(stored, material=material, properties=properties.astype(np.float32))
    looked_up = sample(field, asset.place, store.about.build.parameters.sample)
    values = np.where(asset.valid[:, None], looked_up.properties, 0.0).astype(np.float64)
    yield _score(VoxelPrediction(values, looked_up.material.astype(np.int64)), asset)
    yield score_asset(own, vars(stored) | {"valid": np.ones(len(material), dtype=bool)})


def _nothing_scored(
    place: Place, alone: bool, split: str, problems: Sequence[str], missing: Sequence[str]
) -> InputError:
    """Return the error that no asset of a split can be scored; `alone` if there are no grids."""
    where = f"of an asset of {split}"
    if not alone:
        first = problems[0] if problems else "the split is empty"
        return InputError(
            place,
            f"no asset of {split} has a prediction of every method ({first})",
            "predictions of the same objects",
        )
    if bad := problems[len(missing) :]:
        return InputError(
            place,
            f"has {amount(len(bad), 'prediction')} {where}, and none can be used ({bad[0]})",
            "normalised properties of every voxel",
        )
    return InputError(
        place,
        f"has no prediction {where}",
        f"ids of that split, such as {', '.join(missing[:3]) or 'none: the split is empty'}",
    )


def draw_comparison(methods: Measures, what: str, form: str) -> bytes:
    """Draw a panel for each metric, with the mean and spread of each method.

    `what` names the kind of spread, `form` is png, svg or pdf.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    names, places = list(methods), range(len(methods))
    means = np.array([[m.means[metric] for metric in METRICS] for m in methods.values()])
    spreads = np.array([[m.spreads[metric] for metric in METRICS] for m in methods.values()])
    spreads[~np.isfinite(spreads)] = 0.0
    # All errors share one scale, for which infinite ones are left out; accuracy ends at 1.
    ends = (means + spreads)[:, :-1]
    most = max([1e-3, *ends[np.isfinite(ends)].tolist()])
    figure = Figure(figsize=(11.0, 1.3 + 0.38 * len(names)), layout="constrained")
    panels = figure.subplots(1, len(METRICS), sharey=True)
    for k, (axes, metric) in enumerate(zip(panels, METRICS, strict=True)):
        axes.barh(places, means[:, k], height=0.6, color=_BARS)
        axes.errorbar(
            means[:, k], places, xerr=spreads[:, k], fmt="none", ecolor=INK, capsize=3, lw=1
        )
        for place in places:
            mean = means[place, k]
            if np.isfinite(mean):
                axes.annotate(f"{mean:.3f}", (mean + spreads[place, k], place), (5, 0), va="center",
                              textcoords="offset points", fontsize=8, color=INK)  # fmt: skip
        axes.set_xlim(0, 1.35 * (1.0 if metric == "accuracy" else most))
        axes.set_title(_TITLES[metric], fontsize=9, color=INK)
        axes.tick_params(labelsize=8, colors=MUTED, length=0)
        axes.locator_params(axis="x", nbins=4)
        axes.spines[["top", "right", "left"]].set_visible(False)
    panels[0].set_yticks(places, names, color=INK, parse_math=False)  # Names may contain $.
    panels[0].invert_yaxis()
    count = methods[names[0]].objects
    figure.supxlabel(
        f"mean squared error in normalised space, and class accuracy; {count} objects, ± {what}",
        fontsize=8, color=MUTED,
    )  # fmt: skip
    drawn = BytesIO()
    with rc_context({"svg.hashsalt": SVG_SALT}):
        figure.savefig(drawn, dpi=120, format=form, metadata=PICTURE_FORMATS[form])
    return drawn.getvalue()

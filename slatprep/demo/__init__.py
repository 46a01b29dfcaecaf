"""Make demo data: procedural assets with exactly known truth, in the layouts of real data.

`shapes` and `model` define parts and materials; `catalogue` defines the objects. `voxelise`,
`difficulty`, `generated` and `nerf` make both sides of an object, and `asset` adds the truth.
`write` and `sources` write the files.
"""

from __future__ import annotations

import json
import operator
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from slatprep.demo import write
from slatprep.demo.asset import DemoAsset, make_asset
from slatprep.demo.difficulty import LEVELS, SAME_SHAPE_LEVELS
from slatprep.demo.latents import SPACES, Encoder, LatentKind
from slatprep.demo.sources import (
    ONE_FRAME,
    TABLE,
    Source,
    classes_of,
    write_description,
    write_json,
)
from slatprep.errors import ConfigError, require_one_of
from slatprep.storage.place import local_path_of
from slatprep.workers import Progress, counted
from slatprep.workers.local import require_workers, run_unordered

__all__ = ["DemoAsset", "DemoSummary", "make_asset", "make_demo"]


@dataclass(frozen=True)
class DemoSummary:
    """The folder of a demo, its number of assets and rows, and assets by category and level."""

    path: Path
    config: Path
    assets: int
    rows: int
    categories: dict[str, int]
    levels: dict[int, int]


@dataclass(frozen=True)
class _Recipe:
    """Everything that decides the content of a demo dataset."""

    assets: int
    seed: int
    levels: tuple[int, ...]
    views: int
    latents: LatentKind
    habitual_share: float
    source: Source
    encoder: Encoder
    slat_form: write.SlatForm
    slat_names: write.SlatNames
    results: bool
    samples: int

    @property
    def adapter(self) -> str:
        """The source's adapter, which is also the name of its folder."""
        kind = self.source.partition("-")[0]
        return "pixieverse" if kind == "pixie" else kind


def make_demo(
    directory: str | Path,
    assets: int,
    seed: int,
    *,
    levels: tuple[int, ...] | None = None,
    views: int = 1,
    latents: LatentKind = "placeholder",
    habitual_share: float = 0.0,
    source: Source = "pixieverse",
    encoder: Encoder = "trellis",
    slat_form: write.SlatForm = "npz",
    slat_names: write.SlatNames = "id",
    results: bool = False,
    samples: int = 1,
    jobs: int = 1,
    progress: Progress | None = None,
) -> DemoSummary:
    """Make a demo dataset.

    The same arguments give the same bytes for any `jobs`. Asset number i does not depend on
    the number of assets. Fourteen assets have every category once.

    Parameters
    ----------
    directory : str or Path
        Folder that receives ``pixieverse/`` (or the folder of another source), ``slat/``,
        ``truth/``, ``obj_ids_metadata.json``, ``dataset.toml`` (the dataset's definition
        for `slatprep build-store --config`) and ``demo.json`` (arguments and list of assets).
        It is created if missing; it must be empty or hold the same demo.
    assets, seed : int
        Number of objects, and the seed of all random choices.
    levels : tuple of int, optional
        Levels of difficulty, which assets take in turn; see `slatprep.demo.difficulty`. By
        default 0 to 4, or only 0 if `source` shares the frame of the SLAT.
    views : int
        Number of SLATs of each object; with several, rows are named ``<object id>.<view>``.
    latents : {"placeholder", "material"}
        Noise, or latents that depend on the material; see `slatprep.demo.latents`.
    habitual_share : float
        Share of assets, in 0..1, with the dataset's common quarter turn between the sides;
        each of the others has any of the 24 quarter turns.
    source : str
        The source of the annotated side, a `slatprep.demo.sources.Source`: PixieVerse's
        grids, predictions with 11 or 4 channels, VoMP's or PhysXNet's voxels, or plain voxels
        with ten properties (in HDF5 without classes).
    encoder : {"trellis", "sam3d", "trellis2", "trellis2-512", "plain", "plain-128"}
        The encoder of the latents; ``trellis2-512`` has a grid of 32^3. ``plain`` has 16 channels,
        described in ``encoder.json``; ``plain-128`` has the same on a grid of 128^3.
    slat_form : {"npz", "npz-batch", "hdf5", "hdf5-groups"}
        Form of the SLATs: an npz with coordinates (N, 3) uint8 or (N, 4) int32, or HDF5 with
        a file or a group per asset.
    slat_names : {"id", "sha256"}
        Name the SLATs by object id, or by sha256 with TRELLIS's ``metadata.csv``.
    results : bool
        Also write ``results/``: predictions of a method with errors, 12 MB for each asset.
    samples : int
        Number of annotations of each object; several have the errors that
        `slatprep.demo.write.sample_grids` adds.
    jobs : int
        Number of worker processes.
    progress : callable, optional
        Called with the number of assets done and the number of all assets.

    Returns
    -------
    DemoSummary
        The folder and its content.

    Raises
    ------
    ConfigError
        If an argument is not allowed, or the folder holds anything but the same demo.
    """
    usual = (0,) if source in ONE_FRAME else SAME_SHAPE_LEVELS
    # Numbers of numpy are as good, but JSON does not hold them.
    assets, seed, views, samples = map(operator.index, (assets, seed, views, samples))
    levels = usual if levels is None else tuple(map(operator.index, levels))
    recipe = _Recipe(
        assets, seed, levels, views, latents, float(habitual_share),
        source, encoder, slat_form, slat_names, results, samples,
    )  # fmt: skip
    _check(recipe)
    require_workers(jobs)
    root = local_path_of(directory)
    _claim(root, recipe)
    tasks = ((root, recipe, index) for index in range(assets))
    # A single file for all assets allows only one writer.
    writers = 1 if slat_form == "hdf5-groups" else jobs
    made = dict(counted(run_unordered(_make_one, tasks, writers), assets, progress))
    entries = [made[index] for index in range(assets)]
    _write_definition(root, recipe, entries)
    write_json(root / "demo.json", {"recipe": asdict(recipe), "assets": entries})
    return DemoSummary(
        path=root,
        config=root / "dataset.toml",
        assets=len(entries),
        rows=len(entries) * views,
        categories=dict(Counter(entry["category"] for entry in entries)),
        levels=dict(sorted(Counter(entry["level"] for entry in entries).items())),
    )


def _check(recipe: _Recipe) -> None:
    for name, words in {
        "latents": LatentKind,
        "source": Source,
        "encoder": Encoder,
        "slat_form": write.SlatForm,
        "slat_names": write.SlatNames,
    }.items():
        require_one_of(name, getattr(recipe, name), get_args(words))
    for name, allowed in {
        "assets": recipe.assets >= 1,
        "seed": recipe.seed >= 0,
        "views": recipe.views >= 1,
        "samples": recipe.samples >= 1,
        "habitual_share": 0.0 <= recipe.habitual_share <= 1.0,
        "levels": recipe.levels and set(recipe.levels) <= set(LEVELS),
    }.items():
        if not allowed:
            raise ConfigError(
                f"{name} = {getattr(recipe, name)!r} makes no demo: assets, views and samples are "
                "at least 1, seed at least 0, habitual_share in 0..1, levels some of "
                + ", ".join(map(str, LEVELS))
            )
    several, why = recipe.views > 1, ""
    if recipe.source in ONE_FRAME and (set(recipe.levels) != {0} or several):
        why = f"source {recipe.source!r} is made of the mesh that its SLAT was encoded from: level "
        why += "0 alone, and 1 view"
    elif recipe.encoder.startswith("trellis2") and (recipe.slat_form != "npz" or several):
        why = f"encoder {recipe.encoder!r} has an npz an object: slat_form 'npz', and 1 view"
    elif recipe.samples > 1 and recipe.source != "pixieverse":
        why = "several samples are grids: source 'pixieverse', or 1 sample"
    elif recipe.slat_form == "hdf5-groups" and several:
        why = "slat_form 'hdf5-groups' holds one view an object: use 'hdf5', or 1 view"
    if why:
        raise ConfigError(why)


def _claim(root: Path, recipe: _Recipe) -> None:
    """Take a directory that is new, empty, or holds the same demo, and mark it."""
    mark, found = root / "demo.json", None
    plain = json.loads(json.dumps(asdict(recipe)))
    if root.exists() and any(root.iterdir()):
        with suppress(OSError, ValueError, KeyError, TypeError):
            found = json.loads(mark.read_text("utf-8"))["recipe"]
        if found != plain:
            raise ConfigError(
                f"{root} holds something else than this demo: choose an empty directory"
            )
    else:
        root.mkdir(parents=True, exist_ok=True)
        write_json(mark, {"recipe": plain, "assets": []})
    (root / "slat" / "latents.h5").unlink(missing_ok=True)  # assets are appended to this file


def _make_one(root: Path, recipe: _Recipe, index: int) -> tuple[int, dict[str, Any]]:
    """Make and write an asset; return its number and its entry in the definition."""
    space = SPACES[recipe.encoder]
    asset = make_asset(
        recipe.seed, index, levels=recipe.levels, views=recipe.views, latents=recipe.latents,
        habitual_share=recipe.habitual_share, space=space, one_frame=recipe.source in ONE_FRAME,
    )  # fmt: skip
    several = recipe.samples > 1
    grids = write.sample_grids(recipe.seed, index, asset, recipe.samples) if several else None
    write.write_annotated(root / recipe.adapter, asset, recipe.source, space.resolution, grids)
    if recipe.results:
        write.write_results(root / "results", asset)
    write.write_slat(root / "slat", asset, recipe.slat_form, recipe.slat_names, space)
    write.write_truth(root / "truth", asset, recipe.source)
    return index, {
        "id": asset.object_id,
        **{name: getattr(asset, name) for name in ("name", "category", "level", "symmetric")},
        "slat": write.slat_name(asset, recipe.slat_names),
        "rows": [
            {
                "id": write.row_id(asset, view),
                "voxels": len(view.coords),
                "transform": view.transform.tolist(),
            }
            for view in asset.views
        ],
    }


def _write_definition(root: Path, recipe: _Recipe, entries: list[dict[str, Any]]) -> None:
    """Write the dataset's definition, and the files beside the sources that it names."""
    slat_root = "slat/latents.h5" if recipe.slat_form == "hdf5-groups" else "slat"
    fields, slat = {"root": recipe.adapter}, {"root": slat_root}
    pairing = {"categories": "obj_ids_metadata.json"}
    if recipe.samples > 1:
        fields["samples"] = "merge"
    if recipe.adapter != "pixieverse":
        fields["adapter"] = recipe.adapter
    if recipe.adapter == "voxels":
        write_description(root / "voxels", TABLE, classes_of(recipe.source))
    if recipe.encoder in ("plain", "plain-128"):
        space = asdict(SPACES[recipe.encoder])
        named = {name: space[name] for name in ("encoder", "channels", "resolution")}
        write_json(root / "encoder.json", named)
        slat["encoder"] = "encoder.json"
    elif recipe.encoder != "trellis":
        slat["encoder"] = recipe.encoder
    classes = {
        entry["id"]: {"obj_class": entry["category"], "vlm_filtering": {"is_appropriate": True}}
        for entry in entries
    }
    write_json(root / pairing["categories"], classes)
    if recipe.slat_names == "sha256":
        pairing["map"] = "metadata.csv"
        lines = ["sha256,file_identifier,aesthetic_score,num_voxels"]
        for entry in entries:
            url = f"https://sketchfab.com/3d-models/{entry['id']}"
            lines.append(f"{entry['slat']},{url},6.0,{entry['rows'][0]['voxels']}")
        _write_lines(root / pairing["map"], lines)
    align = {"engine": "known"} if recipe.source in ONE_FRAME else {}
    sections = {"pixieverse": fields, "slat": slat, "align": align, "pairing": pairing}
    lines = ["# A demo dataset; roots are relative to this file.", f'name = "demo-{recipe.seed}"']
    for name, values in sections.items():
        if values:
            lines += ["", f"[{name}]", *(f'{key} = "{value}"' for key, value in values.items())]
    _write_lines(root / "dataset.toml", lines)


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")

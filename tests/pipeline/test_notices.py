"""What a build tells of a dataset as a whole, and of itself at the end."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.commands import document, run
from support.synthetic import Dataset

from slatprep import ConfigError, build_store
from slatprep.normalize import PIXIE_RANGES, ranges_from_extents
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.pipeline.notices import moved_ranges, nothing_usable, wild_ranges
from slatprep.pipeline.publish import BuildSummary, counts_of, summarise
from slatprep.pipeline.recipe import recipe_of, record_of_failed
from slatprep.records import AssetPair, SourceRoots, Status
from slatprep.store.record import FailedRecord

USUAL = ((3.2, 10.8), (1.8, 3.8), (0.21, 0.45))


def told(*rows: tuple[tuple[float, float], ...], objects: str = "abcdefgh") -> list[str]:
    extents, ids = np.array(rows, dtype=float), "abcdefgh"[: len(rows)]
    return list(wild_ranges(ids, objects[: len(rows)], extents, ranges_from_extents(extents)))


def test_an_asset_that_alone_widens_a_range_is_named():
    (text,) = told(USUAL, (USUAL[0], (1.8, 9.7), USUAL[2]), USUAL)
    assert text.startswith("b alone makes the range of density 7.94e+05 times wider")
    (text,) = told(USUAL, USUAL, ((-3.7, 10.8), *USUAL[1:]))
    assert text.startswith("c alone makes the range of youngs_modulus")


def test_views_of_one_object_that_widen_a_range_together_are_named():
    wild = (USUAL[0], (1.8, 9.7), USUAL[2])
    (text,) = told(USUAL, wild, wild, USUAL, objects="abbc")
    assert text.startswith("b alone makes the range of density 7.94e+05 times wider")
    assert told(USUAL, wild, wild, USUAL, objects="abba") == []


def test_ranges_that_pixie_publishes_are_no_surprise():
    soft, steel = ((3.2, 4.0), (3.0, 3.0), (0.4, 0.4)), ((11.3, 11.3), (3.9, 3.9), (0.3, 0.3))
    assert told(soft, soft, soft, steel) == []
    assert told(USUAL, ((3.2, 10.8), (1.8, 9.7), (0.21, 0.45))) == []  # which of two?


def test_an_end_that_only_rounding_moved_is_not_told():
    def moved(by: float) -> list[str]:
        first, *rest = PIXIE_RANGES.ranges
        new = replace(PIXIE_RANGES, ranges=(replace(first, lo=first.lo + by), *rest))
        return list(moved_ranges(new, {"the other": PIXIE_RANGES}))

    assert moved(1e-9) == [] != moved(1e-3)


def test_a_build_that_only_takes_assets_away_tells_of_no_range_again(make_dataset, tmp_path):
    dataset = make_dataset(*"abcf")
    dataset.write_grid("f", dataset.assets["f"].grid * [1, 1e6, 1, 1])
    parameters = dataset.parameters(pixieverse={"plausibility": "off"})
    first = build_store(parameters, tmp_path / "s.zarr").warnings
    assert any("f alone makes the range of youngs_modulus" in text for text in first)
    dataset.remove("a")
    again = build_store(parameters, tmp_path / "s.zarr").warnings
    assert not any("alone" in text for text in again)


def still_channel(dataset: Dataset, name: str) -> None:
    """Give the latents of an asset a channel that is the same throughout."""
    asset = dataset.assets[name]
    asset.feats[:, 7] = 1
    dataset.write_slat(f"{name}.npz", asset.coords, asset.feats)


def test_objects_with_one_slat_or_one_grid_are_named(dataset, tmp_path):
    asset = dataset.assets["a"]
    dataset.write_slat("c.npz", asset.coords, asset.feats)
    told = build_store(dataset.parameters(), tmp_path / "s.zarr").warnings
    assert any("2 assets of different objects share the same SLAT (a = c)" in one for one in told)
    assert any("share the same grid (a = e" in one for one in told)


def test_a_scale_beyond_the_bounds_is_told(make_dataset, tmp_path):
    dataset = make_dataset(*"ab")
    for bounds in ((0.6, 1.6), (1.0, 1.0)):
        usual = dataset.parameters(align={"scale_bounds": bounds})
        assert "scale" not in str(build_store(usual, tmp_path / "usual.zarr").warnings)
    asset = dataset.assets["b"]
    half = np.unique((asset.coords.astype(int) - 32) // 2 + 32, axis=0)  # a true scale of 2
    dataset.write_slat("b.npz", half.astype(asset.coords.dtype), asset.feats[: len(half)])
    warnings = build_store(dataset.parameters(), tmp_path / "s.zarr").warnings
    (text,) = [text for text in warnings if "scale" in text]
    assert text.startswith("the scale of 1 of 2 assets (b) is at an end of align.scale_bounds, 0.6")


def test_unusual_values_are_told_once_and_recorded(dataset, tmp_path):
    warn = dataset.parameters(pixieverse={"plausibility": "warn"}, ranges="pixie")
    for name in "ab":
        dataset.write_grid(name, dataset.assets[name].grid / [1, 1e9, 1, 1])
    summary = build_store(dataset.parameters(), tmp_path / "refused.zarr")
    refused = [name for name, why in summary.problems if "the values look like" in why]
    assert sorted(refused) == ["a", "b"]
    summary = build_store(warn, tmp_path / "s.zarr")
    (text,) = [text for text in summary.warnings if "unusual" in text]
    assert text.startswith("values of 2 of 6 assets (a, b) are unusual: of a: the values look like")
    clipped = next(text for text in summary.warnings if "youngs_modulus are beyond" in text)
    assert "They are most values of 2 of 6 assets (a, b)" in clipped
    for command in ("info", "list"):
        assert f"unusual: {clipped}" in run(command, summary.store).stdout
    assert sum("unusual values: " in line for line in summary.records.open()) == 2


def test_unusual_values_are_told_with_what_refused_ones_look_like(dataset, tmp_path):
    for name in "abc":
        grid = dataset.assets[name].grid
        inside = np.argwhere(grid[..., 3] != 7)
        # Of the third asset less than half is implausible.
        some = tuple(inside[: int(len(inside) * (0.4 if name == "c" else 1))].T)
        grid[some] = (300, 0.5, 0.3, 5)
        dataset.write_grid(name, grid)
    still_channel(dataset, "d")
    summary = build_store(dataset.parameters(), tmp_path / "s.zarr")
    assert [name for name, _ in summary.problems] == ["a", "b"]
    latents, text = (text for text in summary.warnings if "unusual" in text)
    assert latents.startswith("latents of 1 of 4 assets (d) are unusual") and "MPa" not in latents
    assert text.startswith(
        "values of 1 of 4 assets (c) are unusual: class snow (40% of the voxels)"
    )
    assert "; 2 refused assets look like MPa, and this probably too" in text


def test_odd_sources_are_told_by_the_build_and_of_its_store(dataset, tmp_path):
    occupied = {name: dataset.assets[name].grid[..., 3] != 7 for name in "bd"}
    for name, mask in occupied.items():
        path = dataset.root / "pixieverse" / name / "clip_features_mask.npy"
        np.save(path, np.roll(mask, 3, axis=0))
    still_channel(dataset, "c")
    out = tmp_path / "s.zarr"
    words = ("build-store", *dataset.sides, "--out", out, "--decoys", "0")
    masks = "masks of 2 of 6 assets (b, d) are unusual: of b: clip_features_mask.npy leaves out "
    latents = "latents of 1 of 6 assets (c) are unusual: channel 7 of feats is the same in all rows"
    built = run(*words).stderr
    assert masks in built and latents in built
    assert "unusual" not in run(*words).stderr  # Nothing is new.
    for command in ("info", "list"):
        shown = run(command, out).stdout
        assert f"unusual: {masks}" in shown and f"unusual: {latents}" in shown
        assert [text[:6] for text in document(command, out)["unusual"]] == ["latent", "masks "]
    shown = run("check-alignment", out, "--asset", "c", "--picture", "none", code=None).stdout
    assert "c: unusual: latents: channel 7 of feats is the same" in shown


def test_one_asset_alone_does_not_tell_whether_it_is_standardised(make_dataset, tmp_path):
    dataset = make_dataset("a")
    coords = dataset.assets["a"].coords
    narrow = np.random.default_rng(0).normal(size=(len(coords), 8)) * 0.4  # as of one asset
    dataset.write_slat("a.npz", coords, narrow.astype(np.float32))
    with pytest.raises(ConfigError, match=r'or "no" in \[slat\] of a --config FILE'):
        build_store(dataset.parameters(), tmp_path / "s.zarr")
    said = dataset.parameters(slat={"standardised": "yes"})
    assert build_store(said, tmp_path / "s.zarr").statuses["ok"] == 1


PARAMETERS = BuildParameters(PixieverseSource(Path("/grids")), SlatSource(Path("/slats")))


def failed(number: int, status: Status = Status.FAILED) -> FailedRecord:
    pair = AssetPair(f"a{number:03d}", "", "", "", SourceRoots(Path(), Path()), *[None] * 4)
    return record_of_failed(pair, recipe_of(PARAMETERS), f"reason {number}", status=status)


def summed_up(without: list[FailedRecord], **verdicts: str) -> BuildSummary:
    columns = {
        "verdict": list(verdicts.values()),
        "unphysical": np.full(len(verdicts), 4),
        "contradicted": np.array([name == "y" for name in verdicts]),
        "valid_share": np.full(len(verdicts), 0.7),
    }
    counts = counts_of(list(verdicts), np.full(len(verdicts), 10), columns.__getitem__)
    return summarise(counts, without, 0.0, records=Path("r"), build_id="id")


def test_assets_are_counted_and_the_first_hundred_problems_listed():
    without = [*map(failed, range(120)), failed(120, Status.SKIPPED)]
    summary = summed_up(without, x="good", y="doubtful", z="good")
    assert summary.statuses == {"ok": 3, "failed": 120, "skipped": 1}
    assert summary.verdicts == {"doubtful": 1, "good": 2}
    assert (summary.n_voxels, summary.n_valid) == (30, 21)
    assert summary.n_unphysical == 12
    assert summary.contradicted == ("y",)
    assert summary.problems[0] == ("a000", "reason 0")
    assert len(summary.problems) == 100
    assert not summary.complete
    assert summed_up([], z="good").complete


def test_nothing_usable_names_a_hundred_and_counts_the_rest():
    hundred = nothing_usable([failed(n) for n in range(100)], PARAMETERS)
    assert hundred.startswith("none of 100 assets can be used, so there is no store:")
    assert hundred.splitlines()[1:] == [f"  a0{n:02}: reason {n}" for n in range(100)]
    more = nothing_usable([failed(n) for n in range(102)], PARAMETERS, replaces=True)
    assert more.startswith("none of 102 assets can be used, so the store stays as it was:")
    assert more.splitlines()[-1] == "  and 2 more"
    assert "no asset found in /grids and /slats" in nothing_usable([], PARAMETERS)

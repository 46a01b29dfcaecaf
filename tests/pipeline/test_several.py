"""Several annotations of one object, of one source or of several: merged, one taken, or each."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.commands import run
from support.faults import inject
from support.synthetic import Dataset, make_asset
from support.trees import copied, records_of, tree

from slatprep.demo import make_demo
from slatprep.errors import ConfigError, StoreError
from slatprep.export import export_store
from slatprep.inspect.check import check_alignment
from slatprep.inspect.compare import compare_stores
from slatprep.inspect.verify import verify_store
from slatprep.parameters import BuildParameters, ConsensusParameters, PixieverseSource, Samples
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import BuildSummary, build_store, plan_build
from slatprep.pipeline.join import concat_stores, subset_store
from slatprep.records import SourceRoots, Units
from slatprep.store import open_store
from slatprep.store.records import StoredRecords

FACTORS = (1.0, 3.0, 0.7)
"""What the samples of object ``a`` make of Young's modulus."""

DENSER, STIFFER = 4.0, 3.0
"""What the second source makes of the density, the third of Young's modulus."""

DENSITY = {"name": "density", "unit": "kg/m^3", "scale": "log10"}
MODULUS = {"name": "youngs_modulus", "unit": "Pa", "scale": "log10"}


def asked(dataset: Dataset, samples: Samples = "merge", ranges: str = "dataset") -> BuildParameters:
    """Return the parameters of a build: of all three sources where they are merged."""
    second = PixieverseSource(dataset.root / "second", adapter="voxels")
    also = (second, PixieverseSource(dataset.root / "third"))
    parameters = dataset.parameters(ranges, pixieverse={"samples": samples})
    merges = second.root.exists() and samples == "merge"
    return replace(parameters, also=also) if merges else parameters


def sample_grid(seed: int, factor: float, metal: int = 1) -> np.ndarray:
    """Return the grid of an asset, with another modulus and another word for its metal."""
    grid = make_asset(seed).grid.copy()
    grid[grid[..., 3] == 1, 3] = metal
    grid[grid[..., 3] != 7, 1] *= factor
    return grid


def describe(root: Path, **changes: object) -> None:
    about = {"properties": [DENSITY], "classes": False} | changes
    (root / "second" / "source.json").write_text(json.dumps(about))


def write_second(root: Path, name: str, seed: int, factor: float = DENSER) -> None:
    """Write density alone, without classes, in a frame of its own: x, y, z become y, z, x."""
    grid = make_asset(seed).grid
    voxels = np.argwhere(grid[..., 3] != 7)
    density = factor * grid[tuple(voxels.T)][:, 0]
    np.savez(root / "second" / f"{name}.npz", voxels=voxels[:, [1, 2, 0]], density=density)


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Make three objects, of which ``a`` has three samples, and ``b`` one in each of three sources.

    The last of each calls the metal sand. Nobody may change them.
    """
    dataset = Dataset(tmp_path_factory.mktemp("several")).having(*"abc")
    for sample, factor in enumerate(FACTORS):
        dataset.write_grid("a", sample_grid(0, factor, metal=2 if sample == 2 else 1), sample)
    (dataset.root / "second").mkdir()
    describe(dataset.root)
    write_second(dataset.root, "b", 1)
    dataset.write_grid("b", sample_grid(1, STIFFER, metal=2), source="third")
    return dataset


@pytest.fixture(scope="module")
def merged(several: Dataset) -> BuildSummary:
    """Build all of them; nobody may change the store."""
    return build_store(asked(several), several.root / "merged.zarr")


@pytest.fixture(scope="module")
def plain(several: Dataset) -> BuildSummary:
    """Build the first annotation of each; nobody may change the store."""
    return build_store(asked(several, "first"), several.root / "first.zarr")


@pytest.fixture
def own(several: Dataset, tmp_path: Path) -> Dataset:
    """Return the dataset of a test that changes it."""
    for side in ("pixieverse", "slat", "second", "third"):
        shutil.copytree(several.root / side, tmp_path / "own" / side)
    return Dataset(tmp_path / "own", several.assets)


def test_what_own_grids_of_merged_assets_are_measured_on_is_told(several, merged, plain, tmp_path):
    for name in "abc":
        grid = several.root / f"pixieverse/{name}/sample_0/material_grid.npy"
        shutil.copy(grid, tmp_path / f"{name}.npy")
    words, note = ("--split", "all", "--grids", f"m={tmp_path}", "--store"), "on the first of them"
    assert note in run("evaluate", *words, merged.store).stderr
    assert note not in run("evaluate", *words, plain.store).stderr


def test_labels_are_the_mean_and_the_vote_of_all(merged, plain):
    store = open_store(merged.store)
    asset, other = store.asset("a"), store.asset("c")
    alone = open_store(plain.store).asset("a")
    assert np.array_equal(alone.place, asset.place)
    assert asset.valid.all()
    powers = np.log10(FACTORS)
    expected = np.log10(alone.properties_si[:, 0].astype(float)) + powers.mean()
    np.testing.assert_allclose(np.log10(asset.properties_si[:, 0]), expected, atol=2e-6)
    np.testing.assert_allclose(asset.properties_si[:, 1:], alone.properties_si[:, 1:], rtol=1e-5)
    modulus = store.normalization.ranges[0]
    width = 0.5 * (modulus.hi - modulus.lo)
    np.testing.assert_allclose(asset.spread[:, 0] * width, np.std(powers), rtol=1e-5)
    assert not asset.spread[:, 1:].any()
    metal = alone.material == 1
    assert np.array_equal(asset.material, alone.material)
    np.testing.assert_allclose(asset.votes, np.where(metal, 2 / 3, 1.0), rtol=1e-6)
    assert asset.merged and not other.merged
    assert np.isnan(other.spread).all() and np.isnan(other.votes).all()


def test_each_source_says_what_it_knows(merged, plain):
    store = open_store(merged.store)
    asset, alone = store.asset("b"), open_store(plain.store).asset("b")
    assert asset.valid.all()
    modulus, density, ratio = asset.properties_si.T.astype(float)
    # Of E there are two values, of density three: geometric means.
    own = alone.properties_si.T.astype(float)
    np.testing.assert_allclose(modulus, own[0] * STIFFER ** (1 / 2), rtol=1e-4)
    np.testing.assert_allclose(density, own[1] * DENSER ** (1 / 3), rtol=1e-4)
    np.testing.assert_allclose(ratio, own[2], rtol=1e-4)
    widths = [0.5 * (one.hi - one.lo) for one in store.normalization.ranges]
    expected = [np.std(np.log10([1, STIFFER])), np.std(np.log10([1, DENSER, 1])), 0.0]
    for column, value in enumerate(expected):
        np.testing.assert_allclose(asset.spread[:, column] * widths[column], value, atol=1e-6)
    # The second has no classes, and no vote.
    assert np.array_equal(asset.material, alone.material)
    np.testing.assert_allclose(asset.votes, np.where(alone.material == 1, 1 / 2, 1.0))
    # Ranges span all sources.
    assert store.normalization.ranges[1].hi == pytest.approx(np.log10(8.0e3 * DENSER))


def test_the_record_has_every_annotation_with_its_files_and_its_source(merged):
    records = records_of(merged.records)

    def of(record: dict[str, Any]) -> dict[str, list[tuple[int, str]]]:
        files = [(file["source"], file["path"]) for file in record["sources"]]
        return {one["sample"]: [files[k] for k in one["sources"]] for one in record["merged"]}

    assert of(records["a"]) == {str(k): [(0, f"a/sample_{k}/material_grid.npy")] for k in range(3)}
    assert of(records["b"]) == {
        "0": [(0, "b/sample_0/material_grid.npy")],
        "also_1": [(1, "b.npz"), (1, "source.json")],
        "also_2.0": [(2, "b/sample_0/material_grid.npy")],
    }
    assert all(len(file["sha256"]) == 64 for file in records["a"]["sources"])
    entries = records["a"]["merged"]
    for entry in entries:
        assert entry["judgement"]["verdict"] == "good"
        assert entry["alignment"] is None, "it is the record's"
        assert not entry["left_out"]
    first, second, _ = records["b"]["merged"]
    assert first["alignment"] is None
    assert second["alignment"]["transform"] != records["b"]["alignment"]["transform"]
    assert "merged" not in records["c"]
    assert all("source" not in file for file in records["c"]["sources"])
    assert records["a"]["judgement"]["verdict"] == "doubtful"
    assert "its annotations differ" in records["a"]["judgement"]["reasons"][0]
    said = "sample also_1 has no youngs_modulus, poissons_ratio, classes"
    assert said in records["b"]["warnings"]


def test_bent_objects_have_their_one_alignment_once_in_the_record(tmp_path):
    """Five times the numbers of its deformation would be more than a record may hold."""
    folder = tmp_path / "demo"
    make_demo(folder, assets=1, seed=7, samples=5, levels=(5,))
    parameters = load_parameters(folder / "dataset.toml")
    source = replace(parameters.pixieverse, plausibility="warn")
    summary = build_store(replace(parameters, pixieverse=source), tmp_path / "s.zarr")
    store = open_store(summary.store)
    record = StoredRecords(store).of(store.ids[0])
    assert record.alignment.deformation is not None
    assert [one.alignment for one in record.merged] == [None] * 5
    assert all(one.alignment is record.alignment for one in record.contributions)
    assert verify_store(summary.store, sources=True).findings == ()


def test_a_store_of_merged_labels_is_sound(merged):
    assert verify_store(merged.store, sources=True).findings == ()
    store = open_store(merged.store)
    check = check_alignment(store, "a")
    assert check.consistent
    asset = store.asset("a")
    np.testing.assert_allclose(check.value("mean votes for its class"), asset.votes.mean())
    spread = check.value("mean spread of youngs_modulus")
    np.testing.assert_allclose(spread, asset.spread[:, 0].mean(), rtol=1e-6)


def test_labels_are_made_again_in_the_units_that_were_stated(own, tmp_path):
    parameters, out = asked(own), tmp_path / "s.zarr"
    stated = {"units": Units(density="g/cm^3"), "plausibility": "warn"}
    build_store(replace(parameters, pixieverse=replace(parameters.pixieverse, **stated)), out)
    assert open_store(out).asset("a").merged
    assert verify_store(out, sources=True).findings == ()


def test_labels_are_made_again_of_sources_that_moved(own, tmp_path):
    out = tmp_path / "s.zarr"
    build_store(asked(own), out)
    subset_store(out, tmp_path / "b.zarr", ["b"])
    assert verify_store(tmp_path / "b.zarr", sources=True).findings == ()
    now = own.root.rename(tmp_path / "now")
    roots = [
        SourceRoots(now / name, now / "slat", number=k)
        for k, name in enumerate(("pixieverse", "second", "third"))
    ]
    assert verify_store(out, sources=True, roots=roots).findings == ()
    (finding,) = verify_store(out, sources=True, roots=roots[:2]).findings
    assert "[[also]] 2, whose root is not known" in finding.what


def test_without_several_a_merge_is_the_build_it_was(undisturbed, tmp_path):
    dataset, out = undisturbed
    for samples in ("first", "all", "merge"):
        made = build_store(asked(dataset, samples, "pixie"), tmp_path / f"{samples}.zarr")
        assert tree(made.store) == tree(out)
    assert not (out / "voxel/spread").exists()


def test_each_sample_may_be_an_asset(several, tmp_path):
    store = open_store(str(build_store(asked(several, "all"), tmp_path / "all.zarr").store))
    assert store.ids == ["a.sample_0", "a.sample_1", "a.sample_2", "b", "c"]
    assert set(store.column("object_id")) == {"a", "b", "c"}
    first, *_ = moduli = [store.asset(f"a.sample_{k}").properties_si[:, 0] for k in range(3)]
    for factor, modulus in zip(FACTORS, moduli, strict=True):
        np.testing.assert_allclose(modulus, first * factor, rtol=1e-4)
    assert not store.merges


def test_a_further_source_without_use_is_named(own, tmp_path):
    third = own.root / "third"
    third.rename(own.root / "away")
    third.mkdir()
    (third / "torn.tar").write_bytes(b"<html>" * 1000)
    problems = dict(build_store(asked(own), tmp_path / "s.zarr").problems)
    assert f"{third}: torn.tar: cannot be listed (is no intact tar archive" in problems["torn.tar"]
    (third / "torn.tar").unlink()
    (own.root / "away" / "b").rename(third / "x")
    with pytest.raises(ConfigError, match=r"third: has none of the objects .* 'a', found 'x'"):
        build_store(asked(own), tmp_path / "s.zarr")
    # Nothing is said against a further source while the first one is damaged.
    shutil.rmtree(own.root / "pixieverse")
    (own.root / "pixieverse").mkdir()
    (own.root / "pixieverse/torn.tar").write_bytes(b"<html>" * 1000)
    with pytest.raises(StoreError, match=r"torn\.tar: cannot be listed \(is no intact tar"):
        build_store(asked(own), tmp_path / "t.zarr")


def test_what_fails_is_left_out_and_named_and_an_asset_fails_when_none_is_left(own, tmp_path):
    for name in "ab":
        path = own.root / f"pixieverse/{name}/sample_0/material_grid.npy"
        path.write_bytes(path.read_bytes()[:1000])
    out = tmp_path / "s.zarr"
    summary = build_store(asked(own), out)
    assert summary.statuses["ok"] == 3
    record = records_of(summary.records)["a"]
    first, *others = record["merged"]
    # A dataset may move, and its records stay.
    assert first["left_out"].startswith("a/sample_0/material_grid.npy: ")
    assert first["alignment"] is None
    assert [other["left_out"] for other in others] == ["", ""]
    assert any("sample 0 is left out" in warning for warning in record["warnings"])
    store = open_store(out)
    np.testing.assert_allclose(np.unique(store.asset("a").votes), [0.5, 1.0])
    assert set(np.unique(store.asset("b").material)) == {0, 2}  # as the third source has it
    assert verify_store(out, sources=True).findings == ()
    # The same again: what cannot be read is no reason to do it anew.
    assert {str(a.action) for a in plan_build(asked(own), out).assets} == {"reuse"}

    for sample in range(len(FACTORS)):
        own.write_grid("a", np.zeros((64, 64, 63, 4), np.float32), sample)
    (own.root / "third/b/sample_0/material_grid.npy").write_bytes(b"torn")
    summary = build_store(asked(own), out)
    assert summary.statuses == {"ok": 1, "failed": 2, "skipped": 0}
    problems = dict(summary.problems)
    assert "none of its 3 annotations can be used" in problems["a"]
    assert "sample 2:" in problems["a"]
    # What is left must have all that the store holds.
    assert "sample also_1 has no youngs_modulus, poissons_ratio, classes" in problems["b"]
    assert "sample also_2.0: " in problems["b"]


def test_columns_are_the_store_s_in_whatever_order_the_first_source_has_them(own, plain, tmp_path):
    """The file of the source whose order the store has is torn."""
    (own.root / "pixieverse/b/sample_0/material_grid.npy").write_bytes(b"torn")
    turned = [DENSITY, MODULUS, {"name": "poissons_ratio", "unit": "1", "scale": "linear"}]
    describe(own.root, properties=turned, classes=True)
    grid = make_asset(1).grid
    voxels = np.argwhere(grid[..., 3] != 7)
    density, modulus, ratio, material = grid[tuple(voxels.T)].T
    arrays = {"density": density, "youngs_modulus": modulus, "poissons_ratio": ratio}
    np.savez(own.root / "second/b.npz", voxels=voxels, material=material.astype(int), **arrays)
    out = build_store(replace(asked(own), also=asked(own).also[:1]), tmp_path / "s.zarr").store
    asset, alone = open_store(out).asset("b"), open_store(plain.store).asset("b")
    np.testing.assert_allclose(asset.properties_si, alone.properties_si, rtol=1e-5)
    np.testing.assert_allclose(asset.field.properties, alone.field.properties, rtol=1e-5)
    assert verify_store(out).findings == ()


def test_a_change_in_any_annotation_redoes_that_object_alone(own, merged, tmp_path, aligned):
    out = copied(Path(str(merged.store)), tmp_path / "s.zarr")
    for name in "cb":
        assert {one.action for one in plan_build(asked(own), out).assets} == {"reuse"}
        if name == "c":
            own.write_grid("c", sample_grid(2, 2.0), 1)
        else:
            write_second(own.root, "b", 1, factor=2.0)
        aligned.clear()
        again = build_store(asked(own), out)
        assert set(aligned) == {name}
        assert tree(again.store) == tree(build_store(asked(own), tmp_path / f"{name}.zarr").store)
    assert open_store(again.store).asset("c").merged


@pytest.mark.parametrize(("sample", "ok"), [(0, 3), (1, 2)])
def test_a_grid_replaced_meanwhile_gets_no_key_of_others(own, tmp_path, monkeypatch, sample, ok):
    """Sample 0 has been read when it is replaced, sample 1 has been hashed alone."""

    def replace_grid(step: str, name: str) -> None:
        if (step, name) == ("asset aligned", "a"):
            own.write_grid("a", sample_grid(0, 20.0), sample)

    with monkeypatch.context() as during:
        inject(during, replace_grid)
        first = build_store(asked(own), tmp_path / "s.zarr")
    assert first.statuses["ok"] == ok
    if ok == 2:
        assert "sample 1 was replaced while the build read it" in first.problems[0][1]
    again = build_store(asked(own), tmp_path / "s.zarr")
    assert tree(again.store) == tree(build_store(asked(own), tmp_path / "fresh.zarr").store)


def test_a_store_gains_and_loses_its_spread_whatever_the_jobs(several, merged, plain, tmp_path):
    out = tmp_path / "s.zarr"
    for samples, expected in (("first", plain), ("merge", merged), ("first", plain)):
        build_store(asked(several, samples), out, jobs=2 if samples == "merge" else 1)
        assert tree(out) == tree(expected.store)
    assert [open_store(one.store).merges for one in (plain, merged)] == [False, True]


def test_passes_that_place_anew_are_refused(several):
    with pytest.raises(ValueError, match="--consensus or --witness"):
        replace(asked(several), consensus=ConsensusParameters(settle=True))


def test_by_default_several_are_a_fault(own, tmp_path):
    summary = build_store(own.parameters(), tmp_path / "s.zarr")
    assert dict(summary.problems)["a"].endswith("expected one grid and one SLAT per id")
    assert "--samples" in dict(summary.problems)["a"]
    own.remove("b", "c")
    with pytest.raises(StoreError, match="3 samples"):
        build_store(own.parameters(), tmp_path / "t.zarr")


def test_labels_that_the_sources_do_not_give_are_found(several, tmp_path, monkeypatch):
    """The files are written with their digests, as a faulty build would have done."""
    from slatprep.pipeline import annotate as stage

    right, names = stage.merge, ("spread", "votes", "confidence", "properties", "material")

    def wrong(*args: object) -> object:
        made = right(*args)
        if len(made.votes) != len(several.assets["a"].coords):
            return made
        # Where samples differ the grid alone cannot tell; each array is wrong at another voxel.
        rows = np.flatnonzero(made.votes < 1)[: len(names)].tolist()
        changed = {name: getattr(made, name).copy() for name in names}
        for row, (name, values) in zip(rows, changed.items(), strict=True):
            values[row] = {"material": 2, "votes": 0.5}.get(name, values[row] * 0.9)
        return replace(made, **changed)

    monkeypatch.setattr(stage, "merge", wrong)
    out = tmp_path / "s.zarr"
    build_store(asked(several), out)
    assert verify_store(out).findings == ()
    found = verify_store(out, sources=True).findings
    assert [finding.file for finding in found] == sorted(f"voxel/{name}" for name in names)
    assert all(finding.what.startswith("1 of") for finding in found)


def test_exports_carry_spread_and_votes(merged, tmp_path):
    asset = open_store(merged.store).asset("a")
    export_store(merged.store, tmp_path / "npz", "npz")
    export_store(merged.store, tmp_path / "all.h5", "hdf5")
    (path,) = (tmp_path / "npz").rglob("a.npz")
    with np.load(path) as npz, h5py.File(tmp_path / "all.h5") as file:
        for name in ("spread", "votes"):
            np.testing.assert_array_equal(npz[name], getattr(asset, name))
            np.testing.assert_array_equal(file["a"][name][:], getattr(asset, name))


def test_joined_and_chosen_stores_keep_their_spread(merged, tmp_path):
    """Ranges of the joined store are wider, so that spreads in its units are smaller."""
    subset_store(merged.store, tmp_path / "c.zarr", ["c"])
    assert not open_store(tmp_path / "c.zarr").merges
    subset_store(merged.store, tmp_path / "a.zarr", ["a"])
    assert open_store(tmp_path / "a.zarr").asset("a").merged
    other = Dataset(tmp_path / "other").having("d", seed=2)
    other.write_grid("d", sample_grid(2, 100.0))
    build_store(other.parameters(), tmp_path / "d.zarr")
    concat_stores([tmp_path / "a.zarr", tmp_path / "d.zarr"], tmp_path / "joined.zarr")
    joined = open_store(tmp_path / "joined.zarr")
    before = open_store(merged.store)
    width = [s.normalization.ranges[0].hi - s.normalization.ranges[0].lo for s in (before, joined)]
    assert width[1] > width[0]
    np.testing.assert_allclose(
        joined.asset("a").spread[:, 0] * width[1],
        before.asset("a").spread[:, 0] * width[0],
        rtol=1e-5,
    )
    assert not joined.asset("d").merged
    assert compare_stores(tmp_path / "a.zarr", joined).changed == 0
    assert verify_store(tmp_path / "joined.zarr").findings == ()


@pytest.mark.parametrize(("changes", "words"), [
    ({"properties": [DENSITY | {"unit": "g/cm^3"}]}, "density in g/cm^3; expected kg/m^3"),
    ({"properties": [DENSITY | {"scale": "linear"}]}, "density in kg/m^3, linear"),
    ({"properties": [DENSITY | {"name": "damping"}]}, "the property damping, which"),
    ({"classes": ["wood", "steel"]}, "the classes wood, steel"),
])  # fmt: skip
def test_tables_that_disagree_are_refused(own, tmp_path, changes, words):
    describe(own.root, **changes)
    with pytest.raises(ConfigError, match=r"\[\[also\]\] 1") as error:
        build_store(asked(own), tmp_path / "s.zarr")
    assert words in str(error.value)


def test_a_dataset_definition_names_further_sources(own):
    path = own.root / "dataset.toml"
    text = (
        '[pixieverse]\nroot = "pixieverse"\nsamples = "merge"\n[slat]\nroot = "slat"\n'
        '[[also]]\nroot = "second"\nadapter = "voxels"\n'
    )
    path.write_text(text)
    assert load_parameters(path).also == (PixieverseSource(own.root / "second", adapter="voxels"),)
    for wrong, words in (
        (text.replace("second", "fourth"), "also.root"),
        (text.replace("adapter", "adaptor"), "did you mean 'adapter'"),
        (text.replace('samples = "merge"', ""), "samples = 'merge'"),
        (text + 'samples = "first"\n', "all of [[also]] are merged"),
        (text.replace("[[also]]", "[also]"), "also"),
    ):
        path.write_text(wrong)
        with pytest.raises(ConfigError) as error:
            load_parameters(path)
        assert words in str(error.value)

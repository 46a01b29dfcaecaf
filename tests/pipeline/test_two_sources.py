"""Two sources of one object, merged: each in its own form and frame, with what it knows."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import Dataset, make_asset
from support.trees import records_of, tree

from slatprep.errors import ConfigError
from slatprep.inspect.verify import verify_store
from slatprep.parameters import BuildParameters, PixieverseSource
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import BuildSummary, build_store, plan_build
from slatprep.pipeline.join import subset_store
from slatprep.records import SourceRoots
from slatprep.store import open_store

DENSER, STIFFER = 4.0, 3.0
"""What the second source makes of the density, the third of Young's modulus."""

DENSITY = {"name": "density", "unit": "kg/m^3", "scale": "log10"}


def describe(root: Path, **changes: object) -> None:
    about = {"properties": [DENSITY], "classes": False} | changes
    (root / "second" / "source.json").write_text(json.dumps(about))


def write_second(root: Path, name: str, seed: int, factor: float = DENSER) -> None:
    """Write density alone, without classes, in a frame of its own: x, y, z become y, z, x."""
    grid = make_asset(seed).grid
    voxels = np.argwhere(grid[..., 3] != 7)
    density = factor * grid[tuple(voxels.T)][:, 0]
    np.savez(root / "second" / f"{name}.npz", voxels=voxels[:, [1, 2, 0]], density=density)


def write_third(root: Path, name: str, seed: int) -> None:
    """Write a stiffer grid that calls the metal sand."""
    grid = make_asset(seed).grid.copy()
    grid[grid[..., 3] == 1, 3] = 2
    grid[grid[..., 3] != 7, 1] *= STIFFER
    path = root / "third" / name / "sample_0" / "material_grid.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, grid)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Objects ``a`` and ``b``; two further sources of ``a``; nobody may change them."""
    dataset = Dataset(tmp_path_factory.mktemp("sources")).having("a", "b")
    for name in ("second", "third"):
        (dataset.root / name).mkdir()
    describe(dataset.root)
    write_second(dataset.root, "a", 0)
    write_third(dataset.root, "a", 0)
    return dataset


@pytest.fixture(scope="module")
def made(first: Dataset, tmp_path_factory: pytest.TempPathFactory) -> BuildSummary:
    """Build all three; nobody may change the store."""
    return build_store(asked(first), tmp_path_factory.mktemp("made") / "s.zarr")


@pytest.fixture
def sources(first: Dataset, tmp_path: Path) -> Dataset:
    """Return the dataset of a test that changes it."""
    return Dataset(shutil.copytree(first.root, tmp_path / "sources"), first.assets)


def asked(dataset: Dataset) -> BuildParameters:
    second = PixieverseSource(dataset.root / "second", adapter="voxels")
    also = (second, PixieverseSource(dataset.root / "third"))
    return replace(dataset.parameters(pixieverse={"samples": "merge"}), also=also)


def test_each_says_what_it_knows(first, made, tmp_path):
    plain = build_store(first.parameters(), tmp_path / "plain.zarr")
    alone = open_store(plain.store).asset("a")
    store = open_store(made.store)
    asset = store.asset("a")
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
    metal = alone.material == 1
    assert np.array_equal(asset.material, alone.material)
    np.testing.assert_allclose(asset.votes, np.where(metal, 1 / 2, 1.0))
    # Ranges span all sources.
    assert store.normalization.ranges[1].hi == pytest.approx(np.log10(8.0e3 * DENSER))
    assert not store.asset("b").merged


def test_the_record_names_each_file_and_its_source(made):
    record = records_of(made.records)["a"]
    files = record["sources"]
    named = {
        one["sample"]: [(files[k]["source"], files[k]["path"]) for k in one["sources"]]
        for one in record["merged"]
    }
    assert named == {
        "0": [(0, "a/sample_0/material_grid.npy")],
        "also_1": [(1, "a.npz"), (1, "source.json")],
        "also_2.0": [(2, "a/sample_0/material_grid.npy")],
    }
    said = "sample also_1 has no youngs_modulus, poissons_ratio, classes"
    assert said in record["warnings"]
    first, second, _ = record["merged"]
    assert first["alignment"]["transform"] != second["alignment"]["transform"]
    assert all("source" not in file for file in records_of(made.records)["b"]["sources"])


def test_the_labels_are_made_again_of_the_sources(sources, tmp_path):
    out = tmp_path / "s.zarr"
    build_store(asked(sources), out)
    assert verify_store(out, sources=True).findings == ()
    subset_store(out, tmp_path / "a.zarr", ["a"])
    assert verify_store(tmp_path / "a.zarr", sources=True).findings == ()
    now = sources.root.rename(tmp_path / "now")
    also = [
        SourceRoots(now / name, now / "slat", number=k)
        for k, name in enumerate(("second", "third"), 1)
    ]
    roots = SourceRoots(now / "pixieverse", now / "slat", also=tuple(also))
    assert verify_store(out, sources=True, roots=roots).findings == ()
    fewer = replace(roots, also=(also[0],))
    (finding,) = verify_store(out, sources=True, roots=fewer).findings
    assert "[[also]] 2, whose root is not known" in finding.what


def test_a_change_in_a_further_source_redoes_that_object_alone(sources, tmp_path, aligned):
    write_third(sources.root, "b", 1)
    out = tmp_path / "s.zarr"
    build_store(asked(sources), out)
    assert {one.action for one in plan_build(asked(sources), out).assets} == {"reuse"}
    write_second(sources.root, "a", 0, factor=2.0)
    aligned.clear()
    build_store(asked(sources), out)
    assert set(aligned) == {"a"}
    assert tree(out) == tree(build_store(asked(sources), tmp_path / "fresh.zarr").store)


def test_what_is_left_must_have_all_that_the_store_holds(sources, tmp_path):
    (sources.root / "pixieverse/a/sample_0/material_grid.npy").write_bytes(b"torn")
    made = build_store(asked(sources), tmp_path / "s.zarr")
    asset = open_store(made.store).asset("a")
    assert set(np.unique(asset.material)) == {0, 2}  # as the third has it
    (sources.root / "third/a/sample_0/material_grid.npy").write_bytes(b"torn")
    made = build_store(asked(sources), tmp_path / "s.zarr")
    ((name, reason),) = made.problems
    assert name == "a"
    assert "sample also_1 has no youngs_modulus, poissons_ratio, classes" in reason
    assert "sample also_2.0: " in reason


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"properties": [DENSITY | {"unit": "g/cm^3"}]}, "density in g/cm^3, log10"),
        ({"properties": [DENSITY | {"scale": "linear"}]}, "density in kg/m^3, linear"),
        ({"properties": [DENSITY | {"name": "damping"}]}, "the property damping, which"),
        ({"classes": ["wood", "steel"]}, "the classes wood, steel"),
    ],
)
def test_tables_that_disagree_are_refused(sources, tmp_path, changes, words):
    describe(sources.root, **changes)
    with pytest.raises(ConfigError, match=r"\[\[also\]\] 1") as error:
        build_store(asked(sources), tmp_path / "s.zarr")
    assert words in str(error.value)


def test_a_dataset_definition_names_further_sources(sources):
    path = sources.root / "dataset.toml"
    text = """
        [pixieverse]
        root = "pixieverse"
        samples = "merge"
        [slat]
        root = "slat"
        [[also]]
        root = "second"
        adapter = "voxels"
    """
    path.write_text(text)
    parameters = load_parameters(path)
    assert parameters.also == (PixieverseSource(sources.root / "second", adapter="voxels"),)
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

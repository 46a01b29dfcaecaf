"""Several annotations of one object: merged, one taken, or an asset each."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.faults import inject
from support.synthetic import Dataset, make_asset
from support.trees import records_of, tree

from slatprep.errors import StoreError
from slatprep.export import export_store
from slatprep.inspect.check import check_alignment
from slatprep.inspect.verify import verify_store
from slatprep.parameters import BuildParameters, ConsensusParameters, Samples
from slatprep.pipeline.dataset import BuildSummary, build_store, plan_build
from slatprep.pipeline.join import concat_stores, subset_store
from slatprep.store import open_store

FACTORS = (1.0, 3.0, 0.7)
"""What the samples of object ``a`` make of Young's modulus."""


def asked(dataset: Dataset, samples: Samples, ranges: str = "dataset") -> BuildParameters:
    return dataset.parameters(ranges, pixieverse={"samples": samples})


def write_sample(dataset: Dataset, object_id: str, sample: int, grid: np.ndarray) -> None:
    path = dataset.root / "pixieverse" / object_id / f"sample_{sample}" / "material_grid.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, grid)


def sample_grid(seed: int, factor: float, metal: int = 1) -> np.ndarray:
    """Return the grid of an asset, with another modulus and another word for its metal."""
    grid = make_asset(seed).grid.copy()
    grid[grid[..., 3] == 1, 3] = metal
    grid[grid[..., 3] != 7, 1] *= factor
    return grid


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Object ``a`` with three samples, of which the last calls the metal sand; ``b`` with one."""
    dataset = Dataset(tmp_path_factory.mktemp("several")).having(*"ab")
    for sample, factor in enumerate(FACTORS):
        write_sample(dataset, "a", sample, sample_grid(0, factor, metal=2 if sample == 2 else 1))
    return dataset


@pytest.fixture(scope="module")
def merged(several: Dataset) -> BuildSummary:
    """Build it; nobody may change the store."""
    return build_store(asked(several, "merge"), several.root / "merged.zarr")


@pytest.fixture
def own(several: Dataset, tmp_path: Path) -> Dataset:
    """Return the dataset of a test that changes it."""
    for side in ("pixieverse", "slat"):
        shutil.copytree(several.root / side, tmp_path / "own" / side)
    return Dataset(tmp_path / "own", several.assets)


def test_labels_are_the_mean_and_the_vote_of_all(several, merged, tmp_path):
    store = open_store(merged.store)
    asset, other = store.asset("a"), store.asset("b")
    one = build_store(asked(several, "first"), tmp_path / "first.zarr")
    alone = open_store(one.store).asset("a")
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
    # The mean of the factors is 1.28: only 3 is off by a factor of more than two.
    counted = np.where(metal, (1.0 + 0.5) / 3, (1.0 + 0.5 + 1.0) / 3)
    np.testing.assert_allclose(asset.confidence, alone.confidence * counted, rtol=2e-2)
    assert asset.merged
    assert not other.merged
    assert np.isnan(other.spread).all()
    assert np.isnan(other.votes).all()


def test_the_record_has_every_annotation(merged):
    records = records_of(merged.records)
    entries = records["a"]["merged"]
    sources = records["a"]["sources"]
    assert [entry["sample"] for entry in entries] == ["0", "1", "2"]
    for number, entry in enumerate(entries):
        (position,) = entry["sources"]
        assert sources[position]["path"] == f"a/sample_{number}/material_grid.npy"
        assert len(sources[position]["sha256"]) == 64
        assert entry["judgement"]["verdict"] == "good"
        assert entry["alignment"]["transform"] == entries[0]["alignment"]["transform"]
        assert not entry["left_out"]
    assert "merged" not in records["b"]
    assert records["a"]["judgement"]["verdict"] == "doubtful"
    assert "its annotations differ" in records["a"]["judgement"]["reasons"][0]


def test_a_store_of_merged_labels_is_sound(merged):
    assert verify_store(merged.store, sources=True).findings == ()
    store = open_store(merged.store)
    check = check_alignment(store, "a")
    assert check.consistent
    asset = store.asset("a")
    np.testing.assert_allclose(check.value("mean votes for its class"), asset.votes.mean())
    np.testing.assert_allclose(
        check.value("mean spread of youngs_modulus"), asset.spread[:, 0].mean(), rtol=1e-6
    )


def test_without_several_a_merge_is_the_build_it_was(undisturbed, tmp_path):
    dataset, plain = undisturbed
    for samples in ("first", "all", "merge"):
        made = build_store(asked(dataset, samples, "pixie"), tmp_path / f"{samples}.zarr")
        assert tree(made.store) == tree(plain)
    assert not (plain / "voxel/spread").exists()


def test_each_sample_may_be_an_asset(several, tmp_path):
    store = open_store(str(build_store(asked(several, "all"), tmp_path / "all.zarr").store))
    assert store.ids == ["a.sample_0", "a.sample_1", "a.sample_2", "b"]
    assert set(store.column("object_id")) == {"a", "b"}
    moduli = [
        store.asset(f"a.sample_{k}").properties_si[:, 0].astype(float) for k in range(len(FACTORS))
    ]
    for factor, modulus in zip(FACTORS, moduli, strict=True):
        np.testing.assert_allclose(modulus, moduli[0] * factor, rtol=1e-4)
    assert not store.merges


def test_what_fails_is_left_out_and_named(own, tmp_path):
    path = own.root / "pixieverse/a/sample_0/material_grid.npy"
    path.write_bytes(path.read_bytes()[:1000])
    summary = build_store(asked(own, "merge"), tmp_path / "s.zarr")
    assert summary.statuses["ok"] == 2
    record = records_of(summary.records)["a"]
    first, *others = record["merged"]
    assert "material_grid.npy" in first["left_out"]
    assert first["alignment"] is None
    assert [other["left_out"] for other in others] == ["", ""]
    assert any("sample 0 is left out" in warning for warning in record["warnings"])
    asset = open_store(summary.store).asset("a")
    np.testing.assert_allclose(np.unique(asset.votes), [0.5, 1.0])
    assert verify_store(summary.store, sources=True).findings == ()
    # The same again: what cannot be read is no reason to do it anew.
    assert {str(a.action) for a in plan_build(asked(own, "merge"), summary.store).assets} == {
        "reuse"
    }


def test_an_asset_fails_when_none_is_left(own, tmp_path):
    for sample in range(len(FACTORS)):
        write_sample(own, "a", sample, np.zeros((64, 64, 63, 4), np.float32))
    summary = build_store(asked(own, "merge"), tmp_path / "s.zarr")
    assert summary.statuses == {"ok": 1, "failed": 1, "skipped": 0}
    (problem,) = summary.problems
    assert "none of its 3 annotations can be used" in problem[1]
    assert "sample 2:" in problem[1]


def test_a_sample_more_redoes_that_object_alone(own, merged, tmp_path, aligned):
    out = Path(shutil.copytree(str(merged.store), tmp_path / "s.zarr"))
    shutil.copytree(merged.records.parent, tmp_path / "s.manifests")
    write_sample(own, "b", 1, sample_grid(1, 2.0))
    again = build_store(asked(own, "merge"), out)
    assert set(aligned) == {"b"}
    fresh = build_store(asked(own, "merge"), tmp_path / "fresh.zarr")
    assert tree(again.store) == tree(fresh.store)
    assert open_store(again.store).asset("b").merged


@pytest.mark.parametrize(("sample", "ok"), [(0, 2), (1, 1)])
def test_a_grid_replaced_during_the_build_never_gets_the_key_of_other_labels(
    own, tmp_path, monkeypatch, sample, ok
):
    """Sample 0 has been read when it is replaced, sample 1 has been hashed alone."""
    new = sample_grid(0, 20.0)

    def replace_grid(step: str, name: str) -> None:
        if (step, name) == ("asset aligned", "a"):
            write_sample(own, "a", sample, new)

    with monkeypatch.context() as during:
        inject(during, replace_grid)
        first = build_store(asked(own, "merge"), tmp_path / "s.zarr")
    assert first.statuses["ok"] == ok
    if ok == 1:
        assert "sample 1 was replaced while the build read it" in first.problems[0][1]
    again = build_store(asked(own, "merge"), tmp_path / "s.zarr")
    fresh = build_store(asked(own, "merge"), tmp_path / "fresh.zarr")
    assert tree(again.store) == tree(fresh.store)


def test_a_store_gains_and_loses_its_spread_and_any_number_of_jobs_writes_the_same(
    several, merged, tmp_path
):
    out = tmp_path / "s.zarr"
    build_store(asked(several, "first"), out)
    first = tree(out)
    build_store(asked(several, "merge"), out, jobs=2)
    assert tree(out) == tree(merged.store)
    build_store(asked(several, "first"), out)
    assert tree(out) == first
    assert [open_store(one).merges for one in (out, merged.store)] == [False, True]


def test_passes_that_place_anew_are_refused(several):
    with pytest.raises(ValueError, match="--consensus or --witness"):
        replace(asked(several, "merge"), consensus=ConsensusParameters(settle=True))


def test_by_default_several_are_a_fault(own, tmp_path):
    summary = build_store(own.parameters(), tmp_path / "s.zarr")
    assert dict(summary.problems)["a"].endswith("expected one grid and one SLAT per id")
    assert "--samples" in dict(summary.problems)["a"]
    (own.root / "slat/b.npz").unlink()
    with pytest.raises(StoreError, match="3 samples"):
        build_store(own.parameters(), tmp_path / "t.zarr")


def test_labels_that_the_sources_do_not_give_are_found(several, tmp_path, monkeypatch):
    """The files are written with their digests, as a faulty build would have done."""
    from slatprep.pipeline import annotate as stage

    right, names = stage.merge, ("spread", "votes", "confidence", "properties", "material")

    def wrong(*args: object) -> object:
        made = right(*args)
        # Where samples differ the grid alone cannot tell; each array is wrong at another voxel.
        rows = np.flatnonzero(made.votes < 1)[: len(names)].tolist()
        changed = {name: getattr(made, name).copy() for name in names}
        for row, (name, values) in zip(rows, changed.items(), strict=True):
            values[row] = {"material": 2, "votes": 0.5}.get(name, values[row] * 0.9)
        return replace(made, **changed)

    monkeypatch.setattr(stage, "merge", wrong)
    out = tmp_path / "s.zarr"
    build_store(asked(several, "merge"), out)
    assert verify_store(out).findings == ()
    found = verify_store(out, sources=True).findings
    assert [finding.file for finding in found] == sorted(f"voxel/{name}" for name in names)
    assert all(finding.what.startswith("1 of") for finding in found)


def test_exports_carry_spread_and_votes(merged, tmp_path):
    import h5py

    asset = open_store(merged.store).asset("a")
    export_store(merged.store, tmp_path / "npz", "npz")
    export_store(merged.store, tmp_path / "all.h5", "hdf5")
    (path,) = (tmp_path / "npz").rglob("a.npz")
    with np.load(path) as npz, h5py.File(tmp_path / "all.h5") as file:
        for name in ("spread", "votes"):
            np.testing.assert_array_equal(npz[name], getattr(asset, name))
            np.testing.assert_array_equal(file["a"][name][:], getattr(asset, name))


def test_joined_and_chosen_stores_keep_their_spread(several, merged, tmp_path):
    """Ranges of the joined store are wider, so that spreads in its units are smaller."""
    subset_store(merged.store, tmp_path / "b.zarr", ["b"])
    assert not open_store(tmp_path / "b.zarr").merges
    subset_store(merged.store, tmp_path / "a.zarr", ["a"])
    assert open_store(tmp_path / "a.zarr").asset("a").merged
    other = Dataset(tmp_path / "other")
    other.add("c", 2)
    other.write_grid("c", sample_grid(2, 100.0))
    build_store(other.parameters(), tmp_path / "c.zarr")
    concat_stores([tmp_path / "a.zarr", tmp_path / "c.zarr"], tmp_path / "joined.zarr")
    joined = open_store(tmp_path / "joined.zarr")
    before = open_store(merged.store)
    width = [s.normalization.ranges[0].hi - s.normalization.ranges[0].lo for s in (before, joined)]
    assert width[1] > width[0]
    np.testing.assert_allclose(
        joined.asset("a").spread[:, 0] * width[1],
        before.asset("a").spread[:, 0] * width[0],
        rtol=1e-5,
    )
    assert not joined.asset("c").merged
    assert verify_store(tmp_path / "joined.zarr").findings == ()

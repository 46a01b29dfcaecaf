"""Ranges by percentiles and of the objects to train on, against numpy over the raw grids."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import Dataset
from support.trees import tree

from slatprep import PROPERTY_COLUMNS, ConfigError, InputError, build_store, open_store
from slatprep.inspect.verify import verify_store
from slatprep.parameters import NormalizeParameters
from slatprep.pipeline.rows import Row
from slatprep.pipeline.settle import _chosen
from slatprep.store.record import BuildRecord
from slatprep.store.record_json import read_record


def noisy(dataset: Dataset) -> Dataset:
    """Give every voxel properties of its own, over decades, with ties and zeros among them."""
    rng = np.random.default_rng(7)
    for number, name in enumerate(dataset.assets):
        grid = dataset.assets[name].grid
        inside = grid[..., 3] != 7
        count = int(inside.sum())
        grid[inside, 0] = 10 ** rng.uniform(1, 3 + number, count)
        grid[inside, 1] = 10 ** rng.normal(6, 2, count)
        grid[inside, 2] = np.round(rng.uniform(0, 0.5, count), 3)
        grid[(*np.argwhere(inside)[0], 2)] = -0.0
        dataset.write_grid(name, grid)
    return dataset


def expected(dataset: Dataset, names: str, lo: float, hi: float) -> np.ndarray:
    """Take percentiles as numpy does, over all voxels that are not background."""
    grids = [dataset.assets[name].grid for name in names]
    voxels = np.concatenate([grid[grid[..., 3] != 7] for grid in grids]).astype(np.float64)
    mapped = np.stack([np.log10(voxels[:, 1]), np.log10(voxels[:, 0]), voxels[:, 2]])
    return np.asarray(np.percentile(mapped, [lo, hi], axis=1).T)


def ranges_of(out: Path) -> np.ndarray:
    return np.array([[one.lo, one.hi] for one in open_store(out).normalization.ranges])


def test_percentiles_are_numpy_s_whatever_the_jobs_and_what_was_there(make_dataset, tmp_path):
    dataset, out = noisy(make_dataset(*"abc")), tmp_path / "s.zarr"
    for lo, hi in ((0, 100), (0.5, 97.25), (1, 99)):
        build_store(dataset.parameters(f"p{lo}-p{hi}"), out)
        np.testing.assert_allclose(ranges_of(out), expected(dataset, "abc", lo, hi), rtol=1e-12)
        assert open_store(out).normalization.source == f"p{lo}-p{hi}"
    build_store(dataset.parameters("p1-p99"), tmp_path / "two.zarr", jobs=2)
    assert tree(out) == tree(tmp_path / "two.zarr")


def test_an_object_of_several_views_counts_once(make_dataset, tmp_path):
    dataset, out = noisy(make_dataset(*"ab")), tmp_path / "s.zarr"
    shape = dataset.assets["b"]
    for view in ("front", "side"):
        dataset.write_slat(f"b/{view}.npz", shape.coords, shape.feats)
    (dataset.root / "slat" / "b.npz").unlink()
    build_store(dataset.parameters("p1-p99"), out)
    assert open_store(out).ids == ["a", "b.front", "b.side"]
    np.testing.assert_allclose(ranges_of(out), expected(dataset, "ab", 1, 99), rtol=1e-12)


@pytest.mark.parametrize(("ranges", "bounds"), [("p1-p99", (1, 99)), ("dataset", (0, 100))])
def test_ranges_of_the_objects_to_train_on(make_dataset, tmp_path, ranges, bounds):
    dataset, out = noisy(make_dataset(*"abc")), tmp_path / "s.zarr"
    lists = tmp_path / "lists.json"
    lists.write_text(json.dumps({"train": ["a", "b"], "test": ["c"]}))
    chosen = dataset.parameters(ranges, normalize={"objects": "train", "split_by": str(lists)})
    summary = build_store(chosen, out)
    np.testing.assert_allclose(ranges_of(out), expected(dataset, "ab", *bounds), rtol=1e-12)
    source = open_store(out).normalization.source
    assert source.startswith(f"{ranges} of train by lists.json, sha256 ")
    record = summary.records.parent / "build.json"
    told = read_record(BuildRecord, record.read_bytes(), str(record))
    assert told.parameters.normalize == chosen.normalize and told.normalization.source == source

    # Nothing changed: nothing is written; another list in the file: other ranges.
    before = out.stat().st_ino
    build_store(chosen, out)
    assert out.stat().st_ino == before
    lists.write_text(json.dumps({"train": ["a", "c"], "test": ["b"]}))
    build_store(chosen, out)
    np.testing.assert_allclose(ranges_of(out), expected(dataset, "ac", *bounds), rtol=1e-12)


def test_files_that_moved_leave_the_store_as_it_is(make_dataset, tmp_path):
    dataset, out = noisy(make_dataset(*"abc")), tmp_path / "s.zarr"
    lists, spans = '{"train": ["a", "b"], "test": ["c"]}', "lo = 0.0\nhi = 9.0\n"
    tables = "".join(f"[{name}]\n{spans}" for name in PROPERTY_COLUMNS)
    for name, text, chosen in (
        ("lists.json", lists, {"ranges": "p1-p99", "objects": "train", "split_by": "{}"}),
        ("spans.toml", tables, {"ranges": "{}"}),
    ):
        builds = []
        for place in ("here", "there"):
            file = tmp_path / place / name
            file.parent.mkdir(exist_ok=True)
            file.write_text(text)
            said = {key: value.format(file) for key, value in chosen.items()}
            summary = build_store(dataset.parameters(normalize=said), out)
            builds.append((summary.build_id, out.stat().st_ino))
            assert verify_store(out).ok
        assert builds[0] == builds[1]
        build = open_store(out).attributes["build"]
        assert name in str(build) and str(tmp_path) not in str(build)


def test_objects_without_labels_take_no_part_in_the_split():
    columns = [{"object_id": one, "category": "", "n_valid": n} for one, n in (("a", 5), ("b", 0))]
    rows = [Row(each["object_id"], 5, columns=each) for each in columns]
    with pytest.raises(ConfigError, match="no object is trained on"):
        _chosen(rows, NormalizeParameters(objects="train", split_by="pixie"))


def test_by_hash_the_training_s_own_objects_count(make_dataset, tmp_path):
    from slatprep.learn.splits import assign_store
    from slatprep.readers.splits import Shares

    names = "abcdef"
    dataset, out = noisy(make_dataset(*names)), tmp_path / "s.zarr"
    shares = (0.5, 0.25, 0.25)
    build_store(dataset.parameters("p1-p99", normalize={"objects": "train", "shares": shares}), out)
    trained = "".join(assign_store(open_store(out), "hash", Shares(*shares)).lists()["train"])
    assert 0 < len(trained) < len(names)
    np.testing.assert_allclose(ranges_of(out), expected(dataset, trained, 1, 99), rtol=1e-12)
    assert open_store(out).normalization.source == "p1-p99 of train by hash"


def test_a_single_value_gets_a_width(make_dataset, tmp_path):
    dataset, out = make_dataset("a"), tmp_path / "s.zarr"
    grid = dataset.assets["a"].grid
    grid[grid[..., 3] != 7, :3] = (1000, 1e6, 0.25)
    dataset.write_grid("a", grid)
    build_store(dataset.parameters("p1-p99"), out)
    np.testing.assert_allclose(ranges_of(out), [[5.5, 6.5], [2.5, 3.5], [-0.25, 0.75]])


def test_lists_and_ranges_of_no_use_are_told_before_any_work(make_dataset, tmp_path, steps):
    dataset, lists = make_dataset("a", "b"), tmp_path / "lists.json"
    chosen = dataset.parameters("p1-p99", normalize={"objects": "train", "split_by": str(lists)})
    for text, parameters, error, told in (
        ('{"train": ["a"]', chosen, InputError, "cannot be read"),
        ('{"train": ["nobody"]}', chosen, InputError, "none of the dataset's"),
        ('{"test": ["a"], "val": ["b"]}', chosen, ConfigError, "no object is trained on"),
        ("", dataset.parameters(f"{tmp_path}/none.toml"), ConfigError, "cannot read ranges"),
    ):
        lists.write_text(text)
        with pytest.raises(error, match=told):
            build_store(parameters, tmp_path / "s.zarr")
    assert not steps and not (tmp_path / "s.zarr").exists()


def test_a_range_that_cuts_off_most_values_is_told(make_dataset, tmp_path):
    dataset, file = make_dataset("a"), tmp_path / "high.toml"
    file.write_text(
        "[youngs_modulus]\nlo = 20.0\nhi = 40.0\n[density]\nlo = 0.0\nhi = 9.0\n"
        "[poissons_ratio]\nlo = 0.0\nhi = 0.5\n"
    )
    summary = build_store(dataset.parameters(str(file)), tmp_path / "s.zarr")
    (told,) = [one for one in summary.warnings if "beyond its range" in one]
    assert open_store(summary.store).normalization.source == "high.toml"
    assert told == (
        "100% of the values of youngs_modulus are beyond its range, in log10 of the SI value, "
        "20 to 40, and were set to the end of it: see normalize.ranges"
    )

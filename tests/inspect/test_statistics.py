"""What `slatprep stats` counts, against numpy over the arrays themselves."""

import csv
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from support.commands import document, run
from support.made_store import rewrite

from slatprep import MATERIAL_CLASSES, ConfigError, StoreError, open_store
from slatprep.cli.output import as_json
from slatprep.inspect import statistics
from slatprep.inspect.check import check_alignment
from slatprep.inspect.overview import overview_of
from slatprep.inspect.pictures.statistics import draw_statistics
from slatprep.pipeline.dataset import BuildSummary
from slatprep.pipeline.rows import SourceStore
from slatprep.workers.local import run_in_order

CATEGORIES = ["b", "", "a", "=b", "b"]
VERDICTS = ["good", "good", "failed", "doubtful", "good"]


@pytest.fixture(scope="module")
def store(mixed_build: BuildSummary, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy `mixed` with labels drawn at random, so that no two voxels need agree."""
    path = tmp_path_factory.mktemp("statistics") / "s.zarr"
    shutil.copytree(str(mixed_build.store), path)
    group, rng = zarr.open_group(path, mode="r+"), np.random.default_rng(7)
    group["asset/category"][:] = np.array(CATEGORIES, dtype=object)
    group["asset/verdict"][:] = np.array(VERDICTS, dtype=object)
    for side, axis in (("voxel", -1), ("grid", 1)):
        material = group[f"{side}/material"][:]
        drawn = rng.choice([0, 1, 4, 255], material.shape, p=[0.5, 0.2, 0.2, 0.1])
        material[material != 7] = drawn[material != 7]
        values = rng.uniform(-1, 1, group[f"{side}/properties"].shape).astype(np.float32)
        values = np.where(np.expand_dims(material < 7, axis), values, np.float32(np.nan))
        group[f"{side}/material"][:] = material
        group[f"{side}/properties"][:] = values
    return path


def arrays(path: Path, side: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the asset, class and normalised properties of every occupied voxel of a side."""
    group = zarr.open_group(path, mode="r")
    if side == "slat":
        counts = np.diff(group["asset/offset"][:])
        owner = np.repeat(np.arange(len(counts)), counts)
        return owner, group["voxel/material"][:], group["voxel/properties"][:]
    material = group["grid/material"][:]
    owner = np.nonzero(material != 7)[0]
    values = np.moveaxis(group["grid/properties"][:], 1, -1)[material != 7]
    return owner, material[material != 7], values


def expect(
    found: statistics.PropertyStatistics, mapped: np.ndarray, weights: np.ndarray, error: float
):
    """Hold a property's figures against numpy's, of mapped values that are in no doubt."""
    linear = 10.0**mapped if found.log10 else mapped
    for own, values in ((found.log10, mapped), (found.si, linear)):
        if own is None:
            continue
        mean = np.average(values, weights=weights)
        assert own.mean == pytest.approx(mean, rel=1e-6)
        std = math.sqrt(np.average((values - mean) ** 2, weights=weights))
        assert own.std == pytest.approx(std, rel=1e-6)
        assert (own.least, own.most) == pytest.approx((values.min(), values.max()), rel=1e-6)
    scale = found.log10 or found.si
    names = dict(zip(statistics.QUANTILES, scale.quantiles.values(), strict=True))
    assert list(scale.quantiles) == ["1%", "5%", "25%", "50%", "75%", "95%", "99%"]
    exact = np.quantile(mapped, statistics.QUANTILES, method="inverted_cdf", weights=weights)
    np.testing.assert_allclose(list(names.values()), exact, rtol=0, atol=1.001 * error)
    if found.log10:
        raised = 10.0 ** np.array([*found.log10.quantiles.values()])
        np.testing.assert_allclose([*found.si.quantiles.values()], raised)


def hold(path: Path, found: statistics.StoreStatistics, weight: str) -> None:
    """Hold every group of some statistics against the arrays."""
    ranges = open_store(path).normalization.ranges
    categories = np.array(CATEGORIES)
    for side in ("field", "slat"):
        owner, material, values = arrays(path, side)
        weights = np.ones(len(owner))
        if weight == "asset":
            weights = 1.0 / np.bincount(owner)[owner]
        for group in (found.total, *found.classes, *found.categories):
            chosen = np.ones(len(owner), bool)
            if group.by == "class":
                chosen = material == MATERIAL_CLASSES.index(group.name)
            elif group.by == "category":
                name = "" if group.name == "(unknown)" else group.name
                chosen = categories[owner] == name
            own: statistics.SideStatistics = getattr(group, side)
            annotated = chosen & (material < 7)
            assert own.voxels == chosen.sum()
            assert own.assets == len(np.unique(owner[chosen]))
            assert own.share == pytest.approx(weights[chosen].sum() / weights.sum())
            share = 1 - weights[annotated].sum() / weights[chosen].sum()
            assert own.unannotated == pytest.approx(share, abs=1e-12)
            for index, name in ((0, "jelly"), (1, "metal"), (4, "fluid")):
                of_class = weights[annotated & (material == index)].sum()
                if group.by != "class" or name == group.name:
                    share = of_class / weights[annotated].sum()
                    assert own.classes[name] == pytest.approx(share)
            for k, span in enumerate(ranges):
                wide = span.hi - span.lo
                mapped = (values[annotated, k].astype(float) + 1) / 2 * wide + span.lo
                error = found.quantile_error[span.name]
                assert error == pytest.approx(wide / 4096)
                expect(own.properties[span.name], mapped, weights[annotated], error)


def only_present(found: statistics.StoreStatistics) -> statistics.StoreStatistics:
    """Leave classes out that no voxel has, as they have no figures."""
    empty = [group for group in found.classes if not group.slat.voxels]
    assert {group.name for group in empty} == {"sand", "visplas", "snow", "stationary"}
    for group in empty:
        assert math.isnan(group.slat.properties["density"].si.mean)
    return replace(found, classes=tuple(one for one in found.classes if one.slat.voxels))


@pytest.mark.parametrize("weight", ["voxel", "asset"])
def test_every_group_is_as_numpy_has_it(store, weight):
    found = statistics.store_statistics(open_store(store), weight=weight)
    hold(store, only_present(found), weight)
    assert found.total.verdicts == {"good": 3, "doubtful": 1, "failed": 1}
    good = {one.name: one.verdicts["good"] for one in found.categories}
    assert list(good.items()) == [("(unknown)", 1), ("=b", 0), ("a", 0), ("b", 2)]


def test_histograms_add_up_and_the_joint_has_every_pair(store):
    found = statistics.store_statistics(open_store(store))
    for side in ("field", "slat"):
        _, material, values = arrays(store, side)
        for k, histogram in enumerate(found.histograms):
            for kind in range(7):
                expected, _ = np.histogram(values[material == kind, k], 64, (-1, 1))
                np.testing.assert_array_equal(getattr(histogram, side)[kind], expected)
        pairs = values[material < 7, :2]
        expected, *_ = np.histogram2d(*pairs.T, bins=64, range=((-1, 1), (-1, 1)))
        np.testing.assert_array_equal(getattr(found.joint, side), expected)
    span = open_store(store).normalization.ranges[0]
    assert found.joint is not None and found.joint.names == ("youngs_modulus", "density")
    assert (found.joint.edges[0][0], found.joint.edges[0][-1]) == (span.lo, span.hi)


def test_values_that_recur_have_exact_quantiles(mixed_build):
    """Two materials, by hand: most voxels are jelly, of 1e5 Pa, the others metal, of 2e11."""
    found = statistics.store_statistics(open_store(mixed_build.store)).total.slat
    assert 0.05 < found.classes["metal"] < 0.45
    modulus = found.properties["youngs_modulus"].si
    assert modulus.quantiles["50%"] == pytest.approx(1.0e5, rel=1e-5)
    assert modulus.quantiles["99%"] == pytest.approx(2.0e11, rel=1e-5)
    mean = 1.0e5 * found.classes["jelly"] + 2.0e11 * found.classes["metal"]
    assert modulus.mean == pytest.approx(mean, rel=1e-5)


def test_filters_choose_assets_and_jobs_change_nothing(store):
    opened = open_store(store)
    found = statistics.store_statistics(opened, verdicts=("good",), categories=("b",))
    assert (found.assets, found.assets_chosen) == (5, 2)
    (only,) = found.categories
    assert only.slat == found.total.slat and only.name == "b"
    assert as_json(statistics.store_statistics(store, "good", "b")) == as_json(found)
    with pytest.raises(StoreError, match="x is not a slatprep store"):
        statistics.store_statistics("x")
    one, two = (as_json(statistics.store_statistics(opened, jobs=jobs)) for jobs in (1, 2))
    assert one == two


def test_the_command_prints_and_writes_the_same(store, tmp_path):
    table = tmp_path / "t.csv"
    printed = document("stats", store, "--csv", table)
    assert printed["total"]["slat"]["voxels"] == len(arrays(store, "slat")[0])
    assert np.shape(printed["joint"]["slat"]) == (64, 64)
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    wanted = {"by": "all", "side": "slat", "property": "density", "scale": "log10"}
    (row,) = (row for row in rows if wanted.items() <= row.items())
    told = printed["total"]["slat"]["properties"]["density"]["log10"]
    assert float(row["50%"]) == told["quantiles"]["50%"] and float(row["mean"]) == told["mean"]
    named = {row["name"] for row in rows if row["by"] == "category"}
    assert named == {"a", "b", "'=b", "(unknown)"}
    lines = run("stats", store).stdout.splitlines()
    assert lines[0] == "5 of 5 assets, weighted by voxel"
    assert max(map(len, lines)) <= 80


def axes_of(picture: bytes) -> set[str]:
    """Return the names of the axes of properties: in an SVG every text is told in a comment."""
    told = re.findall(r"<!-- (.*?) -->", picture.decode())
    return {one for one in told if one.endswith(("]", "ratio"))}


@pytest.mark.filterwarnings("error")
def test_a_picture_is_the_same_each_time_and_takes_any_name_and_unit(store, tmp_path):
    copy = Path(shutil.copytree(store, tmp_path / "s.zarr"))
    names = np.array(["$\\frac", "$$", "中\n\x07", "x" * 60, "b"], dtype=object)
    rewrite(copy, "asset/category", slice(None), names)
    opened = open_store(copy)
    found = statistics.store_statistics(opened)
    for kind, start in (("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")):
        file = tmp_path / f"p.{kind}"
        run("stats", copy, "--picture", file)
        assert file.read_bytes().startswith(start)
    assert draw_statistics(opened, found, "svg") == file.read_bytes()
    assert axes_of(file.read_bytes()) == {
        "log10 of Young's modulus [Pa]", "log10 of density [kg/m³]", "Poisson's ratio",
    }  # fmt: skip
    units = zip(found.histograms, ("GPa", "g/cm^3", "$1$"), strict=True)
    other = replace(found, histograms=tuple(replace(one, unit=unit) for one, unit in units))
    assert axes_of(draw_statistics(opened, other, "svg")) == {
        "log10 of Young's modulus [GPa]", "log10 of density [g/cm³]", "Poisson's ratio [$1$]",
    }  # fmt: skip


def test_categories_that_share_a_name_with_other_rows_have_rows_of_their_own(store, tmp_path):
    copy = Path(shutil.copytree(store, tmp_path / "s.zarr"))
    names = np.array(["", "(unknown)", "all", "b", "b"], dtype=object)
    rewrite(copy, "asset/category", slice(None), names)
    opened = open_store(copy)
    expected = [("(unknown)", 1), ('"(unknown)"', 1), ('"all"', 1), ("b", 2)]
    found = statistics.store_statistics(opened).categories
    assert [(one.name, one.slat.assets) for one in found] == expected
    assert [(one.name, one.assets) for one in overview_of(opened).categories] == expected
    assert "the category of 1" in run("info", copy).stdout


def test_the_legend_of_many_classes_names_the_commonest(store):
    found = statistics.store_statistics(open_store(store))
    first, sizes = found.classes[0], [0, 5, 2, 9, *range(10, 40)]
    made = [
        replace(first, name=f"class {k}", field=replace(first.field, voxels=n))
        for k, n in enumerate(sizes)
    ]
    picture = draw_statistics(open_store(store), replace(found, classes=tuple(made)), "svg")
    named = re.findall(r"<!-- class (\d+) -->", picture.decode())
    assert len(named) < len(sizes) and named[:3] == ["33", "32", "31"]


def test_nothing_chosen_is_nothing_counted(store, tmp_path):
    words = ("stats", store, "--verdict", "failed", "--category", "b")
    assert run(*words, "--picture", tmp_path / "p.png").stdout.startswith("0 of 5 assets")
    printed = document(*words)
    assert printed["total"]["slat"]["properties"]["density"]["si"]["mean"] is None
    assert printed["categories"] == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_two_stores_are_not_mixed(store, tmp_path, jobs):
    """An update replaced the store after its columns were read; rows are in another order."""
    path = Path(shutil.copytree(store, tmp_path / "s.zarr"))
    opened = open_store(path)
    assert len(overview_of(opened).categories) == 4
    path.rename(tmp_path / "old.zarr")
    shutil.copytree(store, path)
    rewrite(path, "asset/id", slice(2), opened.ids[1::-1])
    shutil.rmtree(tmp_path / "old.zarr")
    for read in (
        lambda: statistics.store_statistics(opened, jobs=jobs),
        lambda: overview_of(opened),
        lambda: list(run_in_order(check_alignment, [(SourceStore(opened), "ant")] * 2, jobs)),
    ):
        with pytest.raises(StoreError, match="was the store replaced"):
            read()


def test_wrong_use_is_refused(store):
    with pytest.raises(ConfigError, match="weight is 'zz'; expected one of voxel, asset"):
        statistics.store_statistics(store, weight="zz")  # type: ignore[arg-type]
    for filters, told in (
        ({"verdicts": "nope"}, "verdict is 'nope'; expected one of good"),
        ({"categories": ("a", "boat")}, "no asset has the category 'boat'; expected =b, a, b"),
    ):
        with pytest.raises(ConfigError, match=told):
            statistics.store_statistics(store, **filters)

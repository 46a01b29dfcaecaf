import json
import signal

import numpy as np
import pytest
from support.faults import inject
from support.synthetic import METAL, Dataset, MakeDataset, make_asset
from support.trees import records_of, tree

from slatprep.errors import ConfigError, InputError, MissingPartnerError, StoreError
from slatprep.inspect.verify import verify_store
from slatprep.pipeline.dataset import align_pairs, build_store, plan_build
from slatprep.store import open_store
from slatprep.store.records import build_in, manifests_of


def test_bad_assets_are_told_and_the_others_go_in(mixed_build):
    assert mixed_build.statuses == {"ok": 5, "failed": 1, "skipped": 1}
    assert mixed_build.verdicts == {"good": 5}
    assert not mixed_build.complete
    problems = dict(mixed_build.problems)
    assert set(problems) == {"lone", "torn"}
    assert "no SLAT for id 'lone'" in problems["lone"]
    assert "torn.npz" in problems["torn"] and "expected" in problems["torn"]
    assert all("\n" not in reason for reason in problems.values())
    lines = [json.loads(line) for line in mixed_build.records.read_text().splitlines()]
    assert [line["asset_id"] for line in lines] == open_store(mixed_build.store).ids


def test_two_jobs_write_the_same_bytes_as_one(mixed, mixed_build, tmp_path):
    again = build_store(mixed.parameters(), tmp_path / "two.zarr", jobs=2)
    assert again.build_id == mixed_build.build_id
    assert tree(again.store) == tree(mixed_build.store)
    assert records_of(mixed_build.records) == records_of(again.records)


def test_strict_stops_at_the_first(make_dataset, tmp_path):
    dataset = make_dataset("a", "c")
    dataset.write_grid("b", np.zeros((64, 64, 63, 4), np.float32))
    with pytest.raises(MissingPartnerError, match="no SLAT for id 'b'"):
        build_store(dataset.parameters(), tmp_path / "s.zarr", strict=True)
    dataset.write_slat("b.npz", np.zeros((1, 3), np.uint8), np.zeros((1, 8), np.float32))
    with pytest.raises(InputError, match=r"material_grid\.npy"):
        align_pairs(dataset.parameters(), tmp_path / "a.jsonl", strict=True)
    # What was finished stays for the next build, and nothing else.
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"sources", ".s.zarr.work", ".a.jsonl.work"}


def test_an_error_of_our_own_is_marked_and_costs_one_asset(make_dataset, tmp_path, monkeypatch):
    def fails_for_b(step: str, name: str) -> None:
        if (step, name) == ("asset read", "b"):
            raise ZeroDivisionError("division\nby zero in \udcff")

    inject(monkeypatch, fails_for_b)
    summary = build_store(make_dataset("a", "b").parameters(), tmp_path / "s.zarr")
    assert summary.statuses == {"ok": 1, "failed": 1, "skipped": 0}
    reason = "internal error, please report: ZeroDivisionError: division by zero in \\udcff"
    assert summary.problems == (("b", reason),)
    assert "fails_for_b" in records_of(summary.records)["b"]["traceback"]


def test_no_usable_asset_is_an_error_and_keeps_the_old_store(make_dataset, tmp_path):
    dataset, out = make_dataset("a"), tmp_path / "s.zarr"
    build_store(dataset.parameters(), out)
    before = tree(out), tree(tmp_path / "s.manifests")
    dataset.write_slat("a.npz", np.zeros((1, 3), np.uint8), np.zeros((1, 7), np.float32))
    for fresh in (False, True):
        with pytest.raises(StoreError, match=r"1 assets can .* as it was:\n  a: .*a\.npz"):
            build_store(dataset.parameters(), out, fresh=fresh)
    with pytest.raises(ConfigError, match="rehash is 2; expected a share from 0 to 1"):
        build_store(dataset.parameters(), out, rehash=2)
    assert (tree(out), tree(tmp_path / "s.manifests")) == before
    assert len(open_store(out)) == 1


@pytest.mark.parametrize("step", ["work folder made", "work folder locked"])
def test_a_build_stopped_as_it_begins_leaves_nothing(make_dataset, tmp_path, monkeypatch, step):
    dataset = make_dataset("a")
    before = sorted(tmp_path.iterdir())
    inject(monkeypatch, lambda at, name: at == step and signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        build_store(dataset.parameters(), tmp_path / "s.zarr")
    assert sorted(tmp_path.iterdir()) == before


def test_folders_instead_of_parameters_are_answered_with_what_to_give(tmp_path):
    with pytest.raises(ConfigError, match="parameters are 'grids'; expected those of load_param"):
        build_store("grids", tmp_path / "s.zarr")  # type: ignore[arg-type]


@pytest.mark.parametrize(("group", "wrong", "said"), [
    ("align", {"engine": "zz"}, r"align\.engine: got 'zz'; expected 'field'"),
    ("store", {"voxel_chunk": 0}, r"store\.voxel_chunk: got 0; expected greater than 0"),
    ("sample", {"max_distance": np.nan}, r"sample\.max_distance: got nan"),
    ("pixieverse", {"samples": "some"}, r"pixieverse\.samples: got 'some'"),
    ("slat", {"root": None}, r"slat\.root: got None"),
])  # fmt: skip
def test_senseless_parameters_are_refused_at_each_door(make_dataset, tmp_path, group, wrong, said):
    parameters = make_dataset().parameters(**{group: wrong})
    for door in (build_store, plan_build, align_pairs):
        with pytest.raises(ConfigError, match=f"^BuildParameters: {said}"):
            door(parameters, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_what_is_not_a_store_is_never_replaced(make_dataset, tmp_path):
    parameters, thesis = make_dataset("a").parameters(), tmp_path / "thesis"
    thesis.mkdir()
    (thesis / "chapter.tex").write_text("years of work")
    with pytest.raises(ConfigError, match="is not a slatprep store"):
        build_store(parameters, thesis)
    (thesis / "chapter.tex").unlink()  # It was not touched, and an empty folder may be replaced.
    assert build_store(parameters, thesis).complete


def test_an_asset_without_a_partner_costs_no_file(make_dataset, tmp_path, monkeypatch):
    """Of 200,000 unmatched grids each would take the time of a file that is written and read."""
    dataset, spooled = make_dataset("a"), list[str]()
    for k in range(30):
        dataset.write_grid(f"lone{k}", make_asset(0).grid)
    inject(monkeypatch, lambda step, name: step == "asset spooled" and spooled.append(name))
    summary = build_store(dataset.parameters(), tmp_path / "s.zarr")
    assert summary.statuses == {"ok": 1, "failed": 0, "skipped": 30}
    assert spooled == ["a"]
    records = records_of(tmp_path / "s.manifests" / "assets.jsonl")
    assert list(records) == ["a", *sorted(f"lone{k}" for k in range(30))]


def test_a_link_stays_a_link_and_the_records_lie_where_the_store_does(make_dataset, tmp_path):
    dataset, disk = make_dataset("a"), tmp_path / "disk"
    disk.mkdir()
    for seed, name in enumerate(("link", "link", "other")):
        link = tmp_path / f"{name}.zarr"
        if not link.is_symlink():
            link.symlink_to(disk / "real.zarr")
        dataset.add("b", seed)
        summary = build_store(dataset.parameters(), link)
        assert link.is_symlink() and verify_store(link).ok
        assert sorted(path.name for path in disk.iterdir()) == ["real.manifests", "real.zarr"]
        assert summary.records.parent == manifests_of(link) == disk / "real.manifests"
        assert build_in(disk / "real.manifests").store == "real.zarr"
        assert not list(tmp_path.glob("*.manifests"))


def test_ranges_by_name_clip_and_count(make_dataset, tmp_path):
    dataset = make_dataset("a")
    summary = build_store(dataset.parameters("pixie"), tmp_path / "s.zarr")
    # Pixie's ranges: log10 E to 10.88 (metal has 11.3), log10 density to 3.87 (metal has 3.90).
    store, asset = open_store(summary.store), open_store(summary.store).asset("a")
    metal = asset.material == METAL[0]
    assert 0 < metal.sum() < len(metal)
    assert (asset.properties[metal, :2] == 1.0).all()
    lo, hi = 3.0183002948760986, 10.881680488586426
    assert asset.properties[~metal, 0] == pytest.approx(2 * (5 - lo) / (hi - lo) - 1, abs=1e-6)
    in_voxels, in_grid = metal.sum(), (dataset.assets["a"].grid[..., 3] == METAL[0]).sum()
    assert list(summary.clipped.values()) == [in_voxels, in_voxels, 0]
    assert store.column("clipped").tolist() == [[in_voxels, in_voxels, 0]]
    assert store.column("clipped_grid").tolist() == [[in_grid, in_grid, 0]]


def test_names_without_anything_in_common_are_told_in_one_line(make_dataset, tmp_path):
    dataset = make_dataset("uid1", "uid2")
    for number, path in enumerate(sorted((dataset.root / "slat").iterdir())):
        path.rename(path.with_name(f"chair_{number}.npz"))
    with pytest.raises(StoreError) as caught:
        build_store(dataset.parameters(), tmp_path / "s.zarr")
    assert str(caught.value) == (
        "no id occurs on both sides: 2 grids such as 'uid1', 2 SLATs such as 'chair_0'; name "
        "a table that joins them: --map FILE.csv (docs/configuration.md, [pairing]). "
        "There is no store"
    )
    table = dataset.root / "slat/metadata.csv"
    table.write_text("sha256,num_voxels\nchair_0,9\n")  # As an export to npz has it.
    with pytest.raises(StoreError, match=r"--map FILE\.csv "):
        build_store(dataset.parameters(), tmp_path / "s.zarr")
    table.write_text("object_id,slat_id\nother,thing\n")
    with pytest.raises(StoreError, match=rf"--map {table} "):
        build_store(dataset.parameters(), tmp_path / "s.zarr")
    parameters = dataset.parameters(pairing={"map": table})
    with pytest.raises(StoreError) as caught:
        build_store(parameters, tmp_path / "s.zarr")
    assert "\n" not in str(caught.value)
    assert f"{table} joins none of them" in str(caught.value)
    table.write_text("object_id,slat_id\nuid1,chair_0\n")
    assert build_store(parameters, tmp_path / "s.zarr").statuses["ok"] == 1


FAR = np.array([[1, 1, 1], [2, 1, 1]], np.uint8)


@pytest.fixture
def odd(make_dataset: MakeDataset) -> Dataset:
    """Three voxels of ``a`` are unphysical, three of ``b`` are islands, two of ``c`` far off."""
    dataset = make_dataset("a", "b", "c")
    for name, channel, value in (("a", 2, 0.546), ("b", 3, -1)):
        grid = dataset.assets[name].grid
        grid[30, 25:28, 28, channel] = value
        dataset.write_grid(name, grid)
    made = dataset.assets["c"]
    coords = np.concatenate([FAR, made.coords])
    dataset.write_slat("c.npz", coords, np.resize(made.feats, (len(coords), 8)))
    return dataset


def test_no_asset_is_lost_to_a_few_odd_voxels(odd, tmp_path):
    out = tmp_path / "s.zarr"
    summary = build_store(odd.parameters(), out)
    assert summary.complete and summary.n_unphysical == 3
    store, records = open_store(out), records_of(summary.records)
    for name in "ab":
        asset = store.asset(name)
        assert (asset.grid_material[30, 25:28, 28] == 255).all()
        assert np.isnan(asset.grid_properties[:, 30, 25:28, 28]).all()
        assert (asset.material < 7).all()
        counts = records[name]["counts"]
        assert counts["unphysical"] == (3 if name == "a" else 0) and counts["unannotated"] == 3
        of_grid = (odd.assets[name].grid[..., 3] != 7).sum()
        assert counts["occupied"] == counts["annotated"] + 3 == of_grid
    assert store.column("unphysical").tolist() == [3, 0, 0]
    assert store.normalization.ranges[2].hi == pytest.approx(0.3)
    assert records["a"]["parameters"]["sample"]["max_unphysical"] == 0.1
    assert "3 voxels are unphysical" in records["a"]["warnings"][0]
    build = json.loads((summary.records.parent / "build.json").read_bytes())
    assert build["counts"]["unphysical"] == 3

    far = store.asset("c")
    assert far.valid.tolist() == [False, False] + [True] * len(odd.assets["c"].coords)
    assert far.material[:2].tolist() == [255, 255] and np.isnan(far.properties[:2]).all()
    assert (far.distance[:2] > 3.0).all()
    assert summary.n_valid == summary.n_voxels - 2
    assert verify_store(out, sources=True).ok

    assert build_store(odd.parameters(), out).n_unphysical == 3
    strict = odd.parameters(sample={"max_unphysical": 0.0})
    assert [asset_id for asset_id, _ in build_store(strict, out).problems] == ["a"]


def test_alignment_alone_counts_assets_and_gives_the_transforms(mixed, mixed_build, tmp_path):
    out, seen = tmp_path / "out" / "mixed.jsonl", list[tuple[int, int]]()
    summary = align_pairs(mixed.parameters(), out, progress=lambda *done: seen.append(done))
    assert seen == [(k, 7) for k in range(8)]
    assert summary.store is None
    assert summary.statuses == mixed_build.statuses
    aligned, built = records_of(summary.records), records_of(mixed_build.records)
    assert list(aligned) == list(built)
    for asset_id, record in aligned.items():
        assert record.get("alignment") == built[asset_id].get("alignment")
        assert record.get("normalization") is None
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mixed.jsonl"]

"""What a page says, held against the store by numpy, zlib and an HTML parser alone."""

import base64
import hashlib
import io
import json
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
import zarr
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from support.commands import document
from support.deformed import MOVES
from support.made_store import rewrite
from support.pages import HOSTILE, Page
from support.synthetic import QUARTER_TURN

from slatprep import StoreError, open_store
from slatprep.geometry.frames import apply_transform, make_transform, voxel_centres
from slatprep.inspect import report
from slatprep.inspect.overview import overview_of
from slatprep.inspect.report import write_report
from slatprep.inspect.report.content import kinds_of, nearest_quarter_turn, quarter_turns
from slatprep.inspect.report.drawn import encode_asset
from slatprep.records import RESOLUTION, UNANNOTATED
from slatprep.store.records import StoredRecords

IDS = ["ant", "bear.front", "bear.side", "cup", "dog"]


def unpack(page: Page, index: int) -> dict[str, np.ndarray]:
    """Undo the voxels of an asset as the page's script does."""
    side = page.content["detail"]["side"]
    packed = page.blocks["pack-0"][1].split("\n")[index]
    data = np.frombuffer(zlib.decompress(base64.b64decode(packed), -zlib.MAX_WBITS), np.uint8)
    slat, field = (
        np.argwhere(np.unpackbits(bits).reshape(side, side, side))
        for bits in (data[: side**3 // 8], data[side**3 // 8 : side**3 // 4])
    )
    columns = data[side**3 // 4 :][: 5 * len(slat)].reshape(5, len(slat))
    rest = data[side**3 // 4 + 5 * len(slat) :]
    material, rest = rest[: len(field)], rest[len(field) :]
    moved = np.zeros(field.shape)
    if len(rest):
        moved = rest[4:].view(np.int8).reshape(field.shape) * float(rest[:4].view("<f4")[0])
    return {"slat": slat, "field": field, "columns": columns, "field_material": material,
            "moved": moved}  # fmt: skip


def test_a_voxel_without_annotation_keeps_its_distance_however_many_properties_there_are(hostile):
    asset = open_store(hostile.store).asset(0)
    valid = np.arange(len(asset.coords)) % 2 == 0
    given = np.where(valid[:, None], asset.properties, np.nan).astype(np.float32)
    told = replace(asset, valid=valid, properties=given)
    way = StoredRecords(asset.store).place_map(asset)
    columns = []
    for properties in (told.properties, told.properties[:, :1]):
        data = encode_asset(replace(told, properties=properties), way, RESOLUTION)
        scalars = np.frombuffer(zlib.decompress(data, -zlib.MAX_WBITS), np.uint8)
        scalars = scalars[RESOLUTION**3 // 4 :][: (2 + properties.shape[1]) * len(valid)]
        columns.append(scalars.reshape(-1, len(valid)))
    assert (columns[1][-1] == columns[0][-1]).all() and (columns[1][-1] < UNANNOTATED).all()
    assert ((columns[0][1:-1] == UNANNOTATED).sum(axis=1) == (~valid).sum()).all()


# -- what it lists ------------------------------------------------------------


def test_every_asset_is_listed_with_its_state_and_why(page):
    assets = page.content["assets"]
    assert assets["id"] == [*IDS, "lone", "torn"]
    assert assets["state"] == ["good"] * 5 + ["skipped", "not built"]
    assert assets["reasons"][0] == [HOSTILE]
    assert assets["reasons"][1] == []
    assert assets["unusual"][2:5] == [[], [f"masks: {HOSTILE}", "values: is it in MPa?"], []]
    assert "SLAT" in assets["reasons"][5][0]
    assert assets["picture"] == [0, 1, 2, 3, 4, None, None]
    assert assets["annotations"] == [None] * 7
    assert {len(column) for column in assets.values()} == {7}


def test_figures_are_the_store_s(page, hostile):
    group = zarr.open_group(hostile.store, mode="r")
    assets = page.content["assets"]
    for name in ("fitness", "inlier_rmse", "valid_share", "overlap", "ambiguity"):
        np.testing.assert_allclose(assets[name][:5], group[f"asset/{name}"][:], atol=1e-5)
        assert assets[name][5:] == [None, None]
    assert assets["voxels"][:5] == np.diff(group["asset/offset"][:]).tolist()
    assert page.content["voxels"] == group["voxel/coords"].shape[0]
    assert {quarter_turns()[turn] for turn in assets["turn"][:5]} == {"x→+y y→\u2212x z→+z"}


def test_distributions_count_every_voxel_in_its_bin(page, hostile):
    group = zarr.open_group(hostile.store, mode="r")
    material, values = group["voxel/material"][:], group["voxel/properties"][:]
    grid, fields = group["grid/material"][:], group["grid/properties"][:]
    for k, entry in enumerate(page.content["properties"]):
        for kind in range(7):
            expected, _ = np.histogram(values[material == kind, k], bins=64, range=(-1, 1))
            assert entry["slat"][kind] == expected.tolist()
            expected, _ = np.histogram(fields[:, k][grid == kind], bins=64, range=(-1, 1))
            assert entry["field"][kind] == expected.tolist()
        stored = group.attrs["normalization"][entry["name"]]
        assert (entry["lo"], entry["hi"]) == (stored["lo"], stored["hi"])
    shown = [(entry["title"], entry["unit"]) for entry in page.content["properties"]]
    assert shown == [("Young's modulus", "Pa"), ("density", "kg/m³"), ("Poisson's ratio", "")]


def test_class_balance_is_by_category(page, hostile):
    group = zarr.open_group(hostile.store, mode="r")
    offsets, material = group["asset/offset"][:], group["voxel/material"][:]
    rows = {row["category"]: row for row in page.content["balance"]}
    counts = {name: row["assets"] for name, row in rows.items()}
    assert counts == {"animal": 3, HOSTILE: 1, "vessel": 1}
    animals = material[: offsets[3]]
    expected = [int((animals == kind).sum()) for kind in range(7)]
    assert rows["animal"]["classes"] == [*expected, int((animals == 255).sum())]


# -- pictures -----------------------------------------------------------------


@pytest.mark.parametrize("index", [0, 3])
def test_voxels_of_the_view_are_the_store_s(page, hostile, index):
    asset = open_store(hostile.store).asset(IDS[index])
    order = np.lexsort(asset.coords.T[::-1])
    seen = unpack(page, index)
    np.testing.assert_array_equal(seen["slat"], asset.coords[order])
    np.testing.assert_array_equal(seen["columns"][0], asset.material[order])
    shown = seen["columns"][1:4].T / 63 * 2 - 1
    assert np.abs(shown - asset.properties[order]).max() <= 1 / 63 + 1e-6
    # The boundary is that of the field, which the transform lays on the SLAT exactly.
    moved = apply_transform(asset.transform, voxel_centres(seen["field"]))
    moved = np.rint((moved + 0.5) * 64 - 0.5).astype(int)
    np.testing.assert_array_equal(np.unique(moved, axis=0), seen["slat"])


def test_a_deformed_boundary_lies_on_the_slat(deformed_build, tmp_path):
    store = open_store(deformed_build.store)
    write_report(store, tmp_path / "page.html", manifests=deformed_build.records.parent)
    page = Page(tmp_path / "page.html")
    assert page.content["assets"]["model"] == ["deformable", "affine"]
    for index, asset in enumerate(store):
        voxels = unpack(page, index)
        centres, slat = voxel_centres(voxels["field"]), voxel_centres(asset.coords)
        # Where the truth looks the places up, the SLAT's voxels are: the other way round.
        distance, nearest = cKDTree(MOVES[asset.asset_id](slat)).query(centres)
        there = distance < 0.8 / 64
        assert there.mean() > 0.9
        apart, before = (
            np.linalg.norm(apply_transform(asset.transform, at) - slat[nearest], axis=1)[there] * 64
            for at in (centres + voxels["moved"], centres)
        )
        assert np.median(apart) < 0.9
        assert np.median(apart) < 0.6 * np.median(before)


def test_thumbnails_show_three_silhouettes(page, hostile):
    asset = open_store(hostile.store).asset("cup")
    detail = page.content["detail"]
    sheet = Image.open(io.BytesIO(base64.b64decode(page.blocks["sheet-0"][1])))
    assert sheet.info["transparency"] == 0
    side = sheet.width // detail["columns"] // detail["views"]
    left = IDS.index("cup") * side * detail["views"]
    pixels = np.asarray(sheet)[:side, left : left + 3 * side]
    margin = (side - 64) // 2
    x, y, z = asset.coords.T.astype(int)
    for view, (columns, rows) in enumerate([(x, 63 - z), (y, 63 - z), (x, 63 - y)]):
        expected = np.zeros((side, side), dtype=bool)
        expected[rows + margin, columns + margin] = True
        np.testing.assert_array_equal(pixels[:, view * side :][:, :side] > 0, expected)


def test_a_store_too_large_is_shown_in_part_and_coarsely(hostile, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "ASSETS_IN_DETAIL", 3)
    monkeypatch.setattr(report, "VOXEL_BYTES", 100)
    summary = write_report(open_store(hostile.store), tmp_path / "page.html")
    page = Page(tmp_path / "page.html")
    assert (summary.assets, summary.in_detail, summary.side) == (5, 3, 32)
    assert page.content["assets"]["picture"] == [0, None, 1, None, 2]
    dog = open_store(hostile.store).asset("dog")
    np.testing.assert_array_equal(unpack(page, 2)["slat"], np.unique(dog.coords // 2, axis=0))


def test_of_a_store_too_large_to_list_a_sample_is_listed(hostile, page, tmp_path, monkeypatch):
    """And all are counted."""
    monkeypatch.setattr(report, "ASSETS_IN_DETAIL", 3)
    monkeypatch.setattr(report, "ASSETS_LISTED", 4)
    store = open_store(hostile.store)
    summary = write_report(store, tmp_path / "page.html", manifests=hostile.manifests)
    found, whole = Page(tmp_path / "page.html").content, page.content
    absent = [name for name in whole["assets"]["id"] if name not in store.ids]
    assert (summary.assets, summary.listed, summary.in_detail) == (7, 5, 3)
    assert found["assets"]["id"] == [*IDS[::2], *absent]
    for name, values in found["assets"].items():
        if name not in ("picture", "kinds"):
            assert values == [*whole["assets"][name][:5:2], *whole["assets"][name][5:]], name
    assert found["assets"]["picture"] == [0, 1, 2, None, None]
    states = {state: whole["assets"]["state"].count(state) for state in whole["assets"]["state"]}
    # The same assets as `slatprep info` and `check-alignment --ambiguous` count.
    ambiguous = overview_of(store).total.ambiguous
    expected = {"stored": 5, "assets": 7, "states": states, "ambiguous": ambiguous,
                "unusual": 1}  # fmt: skip
    assert found["all"] == whole["all"] == expected
    assert found["shared"] == []
    clips = [[one["clipped"] for one in content["properties"]] for content in (found, whole)]
    assert clips[0] == clips[1]


def test_clipped_values_are_counted_in_the_field_and_in_the_slat(copy, tmp_path):
    for name, counts in (("clipped_grid", (7, 0, 30)), ("clipped", (5, 1, 0))):
        rewrite(copy, f"asset/{name}", 0, counts)
    write_report(open_store(copy), tmp_path / "page.html")
    found = Page(tmp_path / "page.html").content["properties"]
    assert [one["clipped"] for one in found] == [[7, 5], [0, 1], [30, 0]]


def test_nearest_quarter_turn():
    assert len(set(quarter_turns())) == 24
    for angle in (0.0, 10.0, 44.0):
        tilt = Rotation.from_rotvec([np.radians(angle), 0, 0]).as_matrix()
        index, found = nearest_quarter_turn(make_transform(tilt, scale=0.8) @ QUARTER_TURN)
        assert quarter_turns()[index] == "x→+y y→\u2212x z→+z"
        assert found == pytest.approx(angle, abs=1e-4)


# -- a page that is safe and whole --------------------------------------------


def test_data_never_becomes_markup(page):
    assert not [tag for tag, _ in page.elements if tag in ("img", "iframe", "object", "link")]
    tags = [tag for tag, _ in page.elements]
    assert tags.count("script") == 5  # content, script, library, one sheet, one pack
    assert not [name for _, attributes in page.elements for name in attributes if name[:2] == "on"]
    assert page.content["assets"]["category"][3] == HOSTILE


def test_nothing_is_fetched_and_no_other_script_may_run(page):
    for _, attributes in page.elements:
        assert not attributes.get("src")
        assert (attributes.get("href") or "#").startswith("#")
    [policy] = [a["content"] for _, a in page.elements if a.get("http-equiv")]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "blob:"
    run = [text for kind, text in page.blocks.values() if kind == "script"]
    run.append(page.blocks["library"][1])
    hashes = {base64.b64encode(hashlib.sha256(t.encode()).digest()).decode() for t in run}
    assert set(re.findall(r"sha256-([^']+)", rules["script-src"])) == hashes


def test_the_bytes_do_not_depend_on_the_jobs(hostile, tmp_path):
    two = tmp_path / "two.html"
    write_report(open_store(hostile.store), two, manifests=hostile.manifests, jobs=2)
    assert two.read_bytes() == hostile.path.read_bytes()


# -- records ------------------------------------------------------------------


def test_without_records_the_page_says_so(hostile, tmp_path):
    write_report(open_store(hostile.store), tmp_path / "page.html")
    content = Page(tmp_path / "page.html").content
    assert content["records"] is False
    assert content["assets"]["id"] == IDS
    assert content["assets"]["tied"] == [None] * 5


def test_other_records_are_refused(hostile, tmp_path):
    build = json.loads((hostile.manifests / "build.json").read_text("utf-8"))
    for record, told in (
        (build | {"id": "0123" * 16}, "records of build '012301230123'"),
        ({"id": "0123"}, r"build\.json: not a record"),
        ([], r"build\.json: not a record"),
    ):
        (tmp_path / "build.json").write_text(json.dumps(record), "utf-8")
        with pytest.raises(StoreError, match=told):
            write_report(open_store(hostile.store), tmp_path / "page.html", manifests=tmp_path)
        assert not (tmp_path / "page.html").exists()


def test_numbers_that_all_reasons_of_a_kind_share_are_kept():
    reasons = [f"only {share}% lie within 1 voxel (good: 80%)" for share in (76.1, 9)]
    paths = ("a/b.npz", "/a b/c d.npz")
    kinds = kinds_of([*reasons, *(f"{path}: holds 3 rows; expected 2" for path in paths)])
    assert [kinds[reason] for reason in reasons] == ["only N% lie within 1 voxel (good: 80%)"] * 2
    assert {kinds[f"{path}: holds 3 rows; expected 2"] for path in paths} == {"holds 3 rows"}


# -- the command --------------------------------------------------------------


def test_the_command_finds_the_records_beside_the_store(mixed_build):
    told = document("report", mixed_build.store)
    path = mixed_build.store.with_name("mixed.html")
    assert told["path"] == str(path)
    assert told["size"] == path.stat().st_size
    assert (told["assets"], told["in_detail"], told["side"]) == (7, 5, 64)
    assert Page(path).content["records"] is True

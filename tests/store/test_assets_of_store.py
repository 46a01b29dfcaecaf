"""A store's table of assets, and each asset, against the arrays that zarr wrote."""

import pickle
import random
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import zarr
from support.made_store import BUILD_ID, IDS, SIZES, edit_attributes, make_store

from slatprep.errors import StoreError, UnknownAssetError
from slatprep.records import Contents, LatentSpace, Property
from slatprep.store import Store, open_store
from slatprep.store.reader import is_store

Made = tuple[Store, dict[str, np.ndarray]]
NEWER = ("confidence", "expected_accuracy", "unphysical", "contradicted")
MOST_VOXELS = 64**3


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    path = tmp_path_factory.mktemp("made") / "s.zarr"
    arrays = make_store(path)
    return open_store(path), arrays


@pytest.fixture
def own(made: Made, tmp_path: Path) -> Path:
    """A store that a test may change."""
    return Path(shutil.copytree(str(made[0].path), tmp_path / "s.zarr"))


def rows_of(arrays: dict[str, np.ndarray], name: str, row: int) -> np.ndarray:
    begin = sum(SIZES[:row])
    return arrays[f"voxel/{name}"][begin : begin + SIZES[row]]


def same(found: object, wanted: object) -> bool:
    return np.asarray(found).tolist() == np.asarray(wanted).tolist()


VOXELS = ("coords", "feats", "properties", "material", "valid", "distance", "place", "confidence")


def test_each_asset_has_its_own_rows(made):
    store, arrays = made
    assert len(store) == 4
    for row, asset_id in enumerate(IDS):
        asset = store.asset(asset_id)
        assert (asset.index, asset.asset_id) == (row, asset_id)
        for name in VOXELS:
            assert same(getattr(asset, name), rows_of(arrays, name, row)), name
            assert same(store.read(row, [name])[name], rows_of(arrays, name, row)), name
        assert same(asset.transform, arrays["asset/transform"][row])
        assert same(asset.grid_material, arrays["grid/material"][row])
        assert asset.grid_properties.tobytes() == arrays["grid/properties"][row].tobytes()
        for name, value in asset.columns.items():
            assert same(value, arrays[f"asset/{name}"][row]), name
    assert "background" not in store.attributes  # It is the usual one.
    assert list(store.read(0)) == ["coords", "feats", "properties"]
    assert store.read(0, ()) == {}


def test_an_asset_without_several_annotations_says_nothing_of_how_they_differ(made):
    store, _ = made
    for row, size in enumerate(SIZES):
        read = store.read(row, ["spread", "votes"])
        assert read["spread"].shape == (size, 3) and read["votes"].shape == (size,)
        assert all(np.isnan(values).all() for values in read.values())
        assert read["spread"].dtype == read["votes"].dtype == np.float32
    assert not store.merges and not store.asset("ant").merged


def test_an_asset_of_several_annotations_says_how_they_differ(tmp_path):
    arrays = make_store(tmp_path / "s.zarr", merged=True)
    store = open_store(tmp_path / "s.zarr")
    assert store.merges
    for row, asset_id in enumerate(IDS):
        asset = store.asset(asset_id)
        assert same(asset.spread, rows_of(arrays, "spread", row))
        assert same(asset.votes, rows_of(arrays, "votes", row))
        assert same(asset.coords, rows_of(arrays, "coords", row))
        assert asset.merged == (SIZES[row] > 0)


def test_columns_are_those_of_the_arrays(made):
    store, arrays = made
    for name in (*NEWER, "fitness", "verdict", "transform", "property_ambiguity"):
        assert same(store.column(name), arrays[f"asset/{name}"]), name
    assert store.offsets.tolist() == [0, 5, 5, 16, 23]
    assert store.ids == list(IDS)
    table, frame = store.table(), store.to_pandas()
    assert list(frame.index) == list(table["id"]) == list(IDS)
    for name in frame:
        assert same(frame[name], table[name]), name
    assert table["voxels"].tolist() == list(SIZES)
    assert same(table["confidence"], arrays["asset/confidence"])
    for column, name in enumerate(("youngs_modulus", "density", "poissons_ratio")):
        change = arrays["asset/property_ambiguity"][:, column]
        assert same(table[f"property_ambiguity_{name}"], change)
    assert "property_ambiguity" not in table
    with pytest.raises(StoreError, match=r"no column 'colour'; expected one of id, offset.*categ"):
        store.column("colour")
    with pytest.raises(StoreError, match=r"has no column 'verdikt'; did you mean verdict\?"):
        store.column("verdikt")


def test_what_is_changed_in_an_asset_or_table_changes_nothing_in_the_store(made):
    store = open_store(made[0].path)
    before = store[0].transform.copy()
    store[0].transform[0, 3] += 1
    np.testing.assert_array_equal(store[0].transform, before)
    with pytest.raises(ValueError, match="read-only"):
        store.table()["verdict"][:] = "failed"
    with pytest.raises(ValueError, match="read-only"):
        store.offsets[1] = 7
    with pytest.raises(TypeError, match="change a copy"):
        random.shuffle(store.ids)
    for change in (store.ids.sort, store.ids.reverse, store.ids.pop, store.ids.clear):
        with pytest.raises(TypeError, match="change a copy"):
            change()
    with pytest.raises(TypeError, match="change a copy"):
        del store.ids[0]
    for change in (store.ids.__iadd__, store.ids.__imul__, store.ids.extend):
        with pytest.raises(TypeError, match="change a copy"):
            change(["dog"])
    assert store.ids == list(IDS) == pickle.loads(pickle.dumps(store.ids))


def test_an_entry_of_a_mask_is_no_asset(made):
    store, _ = made
    for use in (store.match, store.rows, store.read, store.asset):
        for entry in (True, np.True_, np.False_):
            with pytest.raises(StoreError, match=r"numpy\.flatnonzero"):
                use(entry)
        for several in ([0, 1], np.ones(3, bool), None, 1.0):
            with pytest.raises(StoreError, match="names no asset; expected one id or one number"):
                use(several)
    assert store.rows(np.uint8(3)) == (16, 23)


def test_properties_are_found_by_name(made):
    store, _ = made
    for names in (["poissons_ratio", "youngs_modulus"], iter(["poissons_ratio", "youngs_modulus"])):
        assert store.columns_of(names) == [2, 0]
    assert store.columns_of("density") == [1]
    assert store.having(None, None).all()
    with pytest.raises(StoreError) as raised:
        store.columns_of(["density", "colour", "taste"])
    assert str(raised.value) == (
        f"{store.path} has no colour and no taste, only youngs_modulus, density, poissons_ratio; "
        "expected a store with density, colour, taste"
    )


def test_an_asset_is_found_by_a_beginning_that_no_other_has(made):
    store, _ = made
    assert [store.match(name) for name in ("ant", "a", "cu", "bear.s", "bear.f")] == [0, 0, 3, 2, 1]
    assert store.asset("cu").index == 3
    with pytest.raises(UnknownAssetError, match=r"'cu'; did you mean cup\?"):
        store.find("cu")
    with pytest.raises(StoreError, match="3 is no id; expected a text, or `match`"):
        store.find(3)
    assert [store.find(one) for one in IDS] == [0, 1, 2, 3] and "cup" in store
    assert "cu" not in store and 3 not in store


@pytest.mark.parametrize(("name", "hint"), [
    ("bear", r"did you mean bear\.front or bear\.side\?"),
    ("be", r"2 ids begin with 'be', such as bear\.front, bear\.side; give more of it"),
    ("BEAR.F", r"did you mean bear\.front\?"),
    ("cupp", r"did you mean cup\?"),
    ("", "has no asset ''; it has 4 assets"),
    ("zebra", "it has 4 assets"),
    ("4", "has no asset 4; it has 4 assets, numbered from 0"),
    (4, "has no asset 4; it has 4 assets, numbered from 0"),
    (-5, "has no asset -5"),
])  # fmt: skip
def test_a_name_that_none_or_several_have_is_answered(made, name, hint):
    store, _ = made
    with pytest.raises(UnknownAssetError, match=hint):
        store.match(name)


def test_assets_are_taken_by_number_id_beginning_and_slice(made):
    store, _ = made
    assert {store[name].asset_id for name in (0, "0", np.int64(-4), "a", IDS[0])} == {IDS[0]}
    assert store[-1].asset_id == store.asset("3").asset_id == IDS[3]
    assert [asset.asset_id for asset in store[1:3]] == list(IDS[1:3])
    assert [asset.asset_id for asset in store[::-1]] == list(IDS[::-1])
    assert [asset.asset_id for asset in store] == list(IDS)
    assert same(store.read(IDS[0])["coords"], store.read(0)["coords"])
    assert same(store.read(-4, "coords")["coords"], store.read(0)["coords"])
    for number in (4, -5):
        with pytest.raises(StoreError, match=f"has no asset {number}; it has 4 assets"):
            store.read(number)
    with pytest.raises(StoreError, match=r"has no column 'coordz'; did you mean coords\?"):
        store.read(0, columns=("coordz",))


def test_a_store_opened_by_a_relative_path_is_the_same_from_another_folder(made, monkeypatch):
    store = made[0]
    monkeypatch.chdir(store.path.parent)
    opened = open_store(store.path.name)
    monkeypatch.chdir("/")
    assert pickle.loads(pickle.dumps(opened)).ids == store.ids
    assert opened.group["asset/id"].shape == (len(store),)


def test_a_notebook_shows_the_store_as_a_table(made):
    store, _ = made
    shown = store._repr_html_()
    told = {"assets": 4, "assets good": 3, "assets failed": 1, "categories": 2, "voxels": 23}
    for name, value in (told | {"ranges": "p1-p99", "build": BUILD_ID[:12]}).items():
        assert f"<tr><th>{name}</th><td>{value}</td></tr>" in shown
    assert repr(store) == f"<Store {store.path}: 4 assets (3 good, 1 failed), 23 voxels>"
    assert str(store.path) in shown
    assert repr(store[2]) == "<StoredAsset bear.side: category unknown, good, 11 voxels>"


def test_a_store_that_cannot_be_read_says_so(own):
    (own / "asset" / "verdict" / "c" / "0").write_bytes(b"torn")
    damaged = open_store(own)
    assert "cannot be read" in repr(damaged) and "cannot be read" in damaged._repr_html_()


def test_without_pandas_the_table_is_offered(made, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(StoreError, match=r"pip install pandas, or take `Store.table\(\)`"):
        made[0].to_pandas()


def test_a_field_has_the_annotated_cells_in_si_units(made):
    store, arrays = made
    field = store.asset("bear.side").field
    material, properties = arrays["grid/material"][2], arrays["grid/properties"][2]
    cells = [(x, y, 22) for x in range(3, 9) for y in (5, 6)]
    assert field.voxels.tolist() == [list(cell) for cell in cells]
    assert field.material.tolist() == [material[cell] for cell in cells]
    values = np.array([properties[:, *cell] for cell in cells], np.float64)
    first, second, third = (values.T + 1) / 2
    # Ranges [2, 5], [3, 7] and [4, 9], the first two of log10.
    expected = np.stack([10 ** (2 + 3 * first), 10 ** (3 + 4 * second), 4 + 5 * third], axis=1)
    np.testing.assert_allclose(field.properties, expected, rtol=1e-5)
    assert np.array_equal(store.asset("bear.side").normalised_field.properties, values)
    # What is occupied but not annotated is a part of the shape.
    occupied = np.zeros((64, 64, 64), bool)
    occupied[3:10, 5:7, 22] = True
    assert np.array_equal(field.occupancy, occupied)
    assert field.classified
    assert [one.name for one in field.table] == ["youngs_modulus", "density", "poissons_ratio"]


def test_a_store_of_other_contents_is_read_by_its_own_tables(tmp_path):
    contents = Contents(
        (Property("density", "kg/m^3", True), Property("hue", "1", False)),
        tuple(f"class {n}" for n in range(20)),
        LatentSpace("other", 5, 128),
    )
    arrays = make_store(tmp_path / "s.zarr", contents)
    store = open_store(tmp_path / "s.zarr")
    assert store.contents == contents
    assert store.about.property_units == ("kg/m^3", "1")
    assert store.attributes["background"] == 254
    asset = store.asset("cup")
    assert same(asset.feats, rows_of(arrays, "feats", 3)) and asset.feats.shape == (7, 5)
    assert asset.spread.shape == (7, 2) and asset.latents.resolution == 128
    field = asset.normalised_field
    assert len(field.voxels) == 12 and field.occupancy.sum() == 14
    assert field.material.tolist() == arrays["grid/material"][3, 3:9, 5:7, 23].ravel().tolist()


def test_a_store_without_classes_has_fields_without(tmp_path):
    make_store(tmp_path / "s.zarr", Contents(classes=()))
    store = open_store(tmp_path / "s.zarr")
    assert not store.asset("ant").field.classified and "background" not in store.attributes


def test_rows_beyond_what_an_asset_may_have_are_refused(own):
    offsets = zarr.open_group(own, mode="r+", use_consolidated=False)["asset/offset"]
    offsets[:] = np.cumsum([0, MOST_VOXELS, 0, MOST_VOXELS + 1, -1])
    store = open_store(own)
    assert store.rows(0) == (0, MOST_VOXELS)
    assert store.rows(1) == (MOST_VOXELS, MOST_VOXELS)
    for row in (2, 3):
        with pytest.raises(StoreError, match=f"asset {row} has rows .* expected 0 to 262144 rows"):
            store.rows(row)
    for row in (-5, 4):
        with pytest.raises(StoreError, match=f"has no asset {row}; it has 4 assets"):
            store.rows(row)
    offsets[:2] = [-1, 4]
    with pytest.raises(StoreError, match="asset 0 has rows -1 to"):
        open_store(own).rows(0)


def test_what_is_no_store_is_told_from_nothing(own):
    told = r"not a slatprep store: .*none/zarr\.json does not exist; build a store"
    with pytest.raises(StoreError, match=told):
        open_store(own.parent / "none")
    for other in (own / "voxel", own / "voxel" / "feats"):
        with pytest.raises(StoreError, match="is not a slatprep store; expected a directory that"):
            open_store(other)
        assert not is_store(other)
    for content in ("", "[]", '{"attributes": {"format": "other"}}', '{"attributes": 3}'):
        (own / "zarr.json").write_text(content)
        with pytest.raises(StoreError, match="is not a slatprep store"):
            open_store(own)


@pytest.mark.parametrize("version", [None, "1", True, 1.0, 0, 2])
def test_formats_that_are_not_read_are_refused(own, version):
    edit_attributes(own, format_version=version)
    with pytest.raises(StoreError, match=f"has format version {version!r}; this slatprep reads"):
        open_store(own)
    assert is_store(own)

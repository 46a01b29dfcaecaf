import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import Dataset

from slatprep.errors import StoreError
from slatprep.pipeline.dataset import BuildSummary
from slatprep.store import open_store


def test_an_asset_comes_back_whole(mixed: Dataset, mixed_build: BuildSummary) -> None:
    store = open_store(mixed_build.store)
    assert len(store) == 5
    asset = store.asset("bear.side")
    assert np.array_equal(asset.coords, mixed.assets["bear.side"].coords)
    assert np.array_equal(asset.feats, mixed.assets["bear.side"].feats)
    assert asset.grid_material.shape == (64, 64, 64)
    assert asset.grid_properties.shape == (3, 64, 64, 64)
    assert asset.columns["object_id"] == "bear"
    assert asset.columns["verdict"] == "good"
    assert store.normalization == mixed_build.normalization


def test_an_unknown_asset_is_answered_with_those_it_might_be(mixed_build: BuildSummary) -> None:
    store = open_store(mixed_build.store)
    with pytest.raises(StoreError, match=r"'cuo'; did you mean cup\?"):
        store.find("cuo")
    with pytest.raises(StoreError, match=r"did you mean bear\.front or bear\.side\?"):
        store.asset("bear")
    with pytest.raises(StoreError, match="it has 5 assets"):
        store.find("zzzzzzzz")
    with pytest.raises(StoreError, match="3 is no id; expected a text, or `match`"):
        store.find(3)  # type: ignore[arg-type]


def test_what_is_no_store_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"does not exist; build a store"):
        open_store(tmp_path / "none.zarr")
    for content in ("", "[]", '{"attributes": {"format": "other"}}', '{"attributes": 3}'):
        (tmp_path / "zarr.json").write_text(content)
        with pytest.raises(StoreError, match="is not a slatprep store"):
            open_store(tmp_path)


def test_a_reader_that_is_let_go_of_closes_its_files_quietly(mixed_build: BuildSummary) -> None:
    code = (
        "import sys; from slatprep.store import open_store; store = open_store(sys.argv[1]); "
        "store.asset('cup').grid_properties; store.column('verdict'); del store"
    )
    told = subprocess.run(
        [sys.executable, "-X", "dev", "-c", code, str(mixed_build.store)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "ResourceWarning" not in told.stderr


def test_store_and_assets_say_what_they_are_in_a_line(
    mixed_build: BuildSummary, tmp_path: Path
) -> None:
    store = open_store(mixed_build.store)
    assert repr(store) == (f"<Store {store.path}: 5 assets (5 good), {store.offsets[-1]:,} voxels>")
    asset = store.asset("dog")
    assert repr(asset) == f"<StoredAsset dog: category unknown, good, {len(asset.coords):,} voxels>"
    shutil.copytree(store.path, tmp_path / "s.zarr")
    for chunk in (tmp_path / "s.zarr" / "asset" / "verdict" / "c").rglob("0"):
        chunk.write_bytes(b"torn")
    damaged = open_store(tmp_path / "s.zarr")
    assert "cannot be read" in repr(damaged)
    shown = store._repr_html_()
    assert "<th>assets good</th><td>5</td>" in shown and str(store.path) in shown
    assert "cannot be read" in damaged._repr_html_()


def test_the_table_of_assets_is_that_of_the_arrays(mixed_build: BuildSummary) -> None:
    store = open_store(mixed_build.store)
    assert "dog" in store and "do" not in store
    assert [asset.asset_id for asset in store] == store.ids
    frame = store.to_pandas()
    assert list(frame.index) == store.ids
    assert list(frame["voxels"]) == [len(asset.coords) for asset in store]
    assert list(frame["fitness"]) == list(store.group["asset/fitness"][:])
    change = store.group["asset/property_ambiguity"][:]
    assert np.array_equal(frame.filter(like="property_ambiguity_").to_numpy(), change)


def test_without_pandas_the_table_is_offered(
    mixed_build: BuildSummary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(StoreError, match=r"pip install pandas, or take `Store.table\(\)`"):
        open_store(mixed_build.store).to_pandas()

import json
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


def test_what_is_no_store_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"does not exist; build a store"):
        open_store(tmp_path / "none.zarr")
    for content in ("", "[]", '{"attributes": {"format": "other"}}', '{"attributes": 3}'):
        (tmp_path / "zarr.json").write_text(content)
        with pytest.raises(StoreError, match="is not a slatprep store"):
            open_store(tmp_path)


def test_a_newer_format_is_refused_in_words(tmp_path: Path) -> None:
    attributes = {"format": "slatprep-store", "format_version": 3}
    (tmp_path / "zarr.json").write_text(json.dumps({"attributes": attributes}))
    with pytest.raises(StoreError, match=r"format version 3; this slatprep reads 1 and 2"):
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

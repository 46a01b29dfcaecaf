"""A store of format 1 becomes one of today's, as if it had been built so."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr
from click.testing import CliRunner
from support.format_one import write_format_one
from support.synthetic import Dataset

from slatprep.cli.commands import slatprep
from slatprep.errors import SlatprepError, StoreError
from slatprep.inspect.verify import verify_store
from slatprep.pipeline.dataset import build_store
from slatprep.pipeline.upgrade import upgrade_store
from slatprep.store import open_store
from slatprep.store.layout import ARRAYS


def test_an_upgraded_store_holds_what_a_build_would_have_written(
    make_dataset: Callable[..., Dataset], tmp_path: Path
) -> None:
    built, old, new = (tmp_path / f"{name}.zarr" for name in ("built", "old", "new"))
    build_store(make_dataset("a", "b", "c").parameters(), built)
    write_format_one(built, old)
    summary = upgrade_store(old, new)
    assert summary is not None
    assert summary.verdicts == {"good": 3}
    wanted, held = open_store(built), open_store(new)
    assert held.format_version == 2
    assert open_store(old).format_version == 1
    for layout in ARRAYS:
        rows = wanted.shape(layout.name)[0]
        one, other = (store.read_rows(layout.name, 0, rows) for store in (wanted, held))
        if layout.dtype.startswith("float"):
            # The look-up in SI units passes through the ranges once more, in float32.
            np.testing.assert_allclose(other, one, atol=2e-3, err_msg=layout.name)
        else:
            np.testing.assert_array_equal(other, one, err_msg=layout.name)
    assert verify_store(new).ok
    assert upgrade_store(new) is None


def test_upgrade_replaces_a_store_in_place(
    make_dataset: Callable[..., Dataset], tmp_path: Path
) -> None:
    built, old = tmp_path / "built.zarr", tmp_path / "old.zarr"
    build_store(make_dataset("a", "b").parameters(), built)
    write_format_one(built, old)
    for verdicts in ({"good": 2, "doubtful": 0, "failed": 0}, None):
        result = CliRunner().invoke(slatprep, ["upgrade", str(old), "--json"])
        assert result.exit_code == 0, result.output
        assert json.loads(result.stdout).get("verdicts") == verdicts
    assert open_store(old).format_version == 2
    assert verify_store(old).ok


def test_a_store_that_is_not_as_it_was_written_is_not_upgraded(
    make_dataset: Callable[..., Dataset], tmp_path: Path
) -> None:
    built, old = tmp_path / "built.zarr", tmp_path / "old.zarr"
    build_store(make_dataset("a", "b").parameters(), built)
    write_format_one(built, old)
    chunks = [file for file in (old / "asset/record/c").rglob("*") if file.is_file()]
    assert chunks
    for file in (old / "voxel/material/zarr.json", *chunks):
        sound = file.read_bytes()
        file.write_bytes(sound[:-1] + bytes([sound[-1] ^ 1]))
        with pytest.raises(StoreError, match="slatprep verify"):
            upgrade_store(old, tmp_path / "new.zarr")
        assert not (tmp_path / "new.zarr").exists()
        file.write_bytes(sound)
    assert upgrade_store(old, tmp_path / "new.zarr") is not None


def _sheared(root: zarr.Group) -> None:
    record = json.loads(str(root["asset/record"][0]))
    record["alignment"]["transform"][0][1] += 5.0
    root["asset/record"][0] = json.dumps(record)


def _set(name: str, value: float) -> Callable[[zarr.Group], None]:
    def change(root: zarr.Group) -> None:
        root[name][...] = np.full(root[name].shape, value, root[name].dtype)

    return change


@pytest.mark.filterwarnings("ignore:Consolidated metadata")
@pytest.mark.parametrize(
    "change",
    [_sheared, _set("asset/transform", 5), _set("voxel/coords", 200), _set("voxel/coords", 7),
     _set("voxel/feats", np.nan)],
)  # fmt: skip
def test_a_strangers_store_is_refused_in_words(
    undisturbed: tuple[Dataset, Path], tmp_path: Path, change: Callable[[zarr.Group], None]
) -> None:
    """Its digests are right: whoever made it wrote them."""
    hostile = Path(shutil.copytree(undisturbed[1], tmp_path / "hostile.zarr"))
    change(zarr.open_group(hostile, mode="r+", use_consolidated=False))
    write_format_one(hostile, tmp_path / "old.zarr")
    with pytest.raises(SlatprepError):
        upgrade_store(tmp_path / "old.zarr", tmp_path / "new.zarr")
    assert not (tmp_path / "new.zarr").exists()

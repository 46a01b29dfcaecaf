"""A store of format 1 becomes one of today's, as if it had been built so."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from support.format_one import write_format_one
from support.synthetic import Dataset

from slatprep.cli.commands import slatprep
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

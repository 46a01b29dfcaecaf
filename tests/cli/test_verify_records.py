"""Where `slatprep verify` looks for the records of a store."""

import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from slatprep.cli.commands import slatprep
from slatprep.pipeline.dataset import BuildSummary


def told(store: Path) -> str:
    result = CliRunner().invoke(slatprep, ["verify", str(store)])
    assert result.exit_code == 0, result.output
    return result.output


def test_the_records_that_make_left_are_found_and_those_of_another_build_are_not(
    mixed_build: BuildSummary,
    deformed_build: BuildSummary,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    store = Path(shutil.copytree(str(mixed_build.store), "data/demo.zarr"))
    shutil.copytree(mixed_build.records.parent, "manifests/build/demo")
    assert "records: manifests/build/demo" in told(store)
    shutil.rmtree("manifests")
    shutil.copytree(deformed_build.records.parent, "manifests/build/demo")
    assert "records: none beside the store" in told(store)

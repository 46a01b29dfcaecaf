"""What `slatprep info` advises."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from support.synthetic import Dataset

from slatprep.cli.commands import slatprep
from slatprep.pipeline.dataset import build_store


@pytest.mark.parametrize("given", [True, False])
def test_table_of_categories_is_asked_for_unless_it_was_given(tmp_path: Path, given: bool) -> None:
    dataset = Dataset(tmp_path)
    dataset.add("a", seed=0)
    table = tmp_path / "classes.json"
    table.write_text(json.dumps({"b": {"obj_class": "tree"}}))
    parameters = dataset.parameters("pixie")
    if given:
        pairing = replace(parameters.pairing, categories=table)
        parameters = replace(parameters, pairing=pairing)
    build_store(parameters, tmp_path / "s.zarr")
    result = CliRunner().invoke(slatprep, ["info", str(tmp_path / "s.zarr")])
    assert result.exit_code == 0
    (line,) = [line for line in result.stdout.splitlines() if line.startswith("unknown:")]
    assert ("does not have their ids" in line) == given
    assert ("[pairing]" in line) != given

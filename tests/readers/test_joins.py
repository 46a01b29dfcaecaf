"""What joins names of the two sides: nothing of it is settled by which comes last."""

from pathlib import Path

import pytest

from slatprep.errors import ConfigError
from slatprep.readers.joins import read_categories, read_map


@pytest.mark.parametrize("header", ["object_id,slat_id,object_id", "object_id,slat_id,view,view"])
def test_a_column_that_occurs_twice_is_refused(tmp_path: Path, header: str) -> None:
    table = tmp_path / "map.csv"
    table.write_text(f"{header}\na,b,c,d\n")
    with pytest.raises(ConfigError, match="has two columns"):
        read_map(table, [], [])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": {"obj_class": "x"}, "a": {"obj_class": "y"}}', "the key 'a' occurs twice"),
        ('{"a": {"obj_class": "x", "obj_class": "y"}}', "the key 'obj_class' occurs twice"),
        ('{"a": {"obj_class": "%s"}}' % ("x" * 257), "has 257 letters; expected at most 256"),
    ],
)
def test_categories_that_are_not_plain_are_refused(tmp_path: Path, text: str, message: str) -> None:
    table = tmp_path / "categories.json"
    table.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_categories(table)

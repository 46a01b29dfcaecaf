"""Tables beside the sources: maps of ids, TRELLIS's metadata, categories."""

import json
import os

import pytest
from support.raw_sources import grid, touch

from slatprep.errors import ConfigError


def test_map_by_object_and_slat_id(find, tmp_path):
    table = tmp_path / "map.csv"
    table.write_text("object_id,slat_id\na,s1\nb,s2\nb,s3\nc,gone\n")
    pairs = find(
        [grid(name) for name in "abcd"], ["s1.npz", "s2.npz", "s3.npz", "d.npz", "e.npz"], map=table
    )
    found = {p.asset_id: p for p in pairs}
    assert list(found) == ["a", "b.s2", "b.s3", "c", "d", "e"]
    names = [found[i].slat.name for i in ("a", "b.s2", "b.s3", "d")]
    assert names == ["s1.npz", "s2.npz", "s3.npz", "d.npz"]
    assert "looked for gone.npz" in found["c"].problem
    assert "no grid for id 'e'" in found["e"].problem
    assert [i for i, p in found.items() if p.problem] == ["c", "e"]


def test_map_with_views(find, tmp_path):
    table = tmp_path / "map.csv"
    table.write_text("object_id,slat_id,view\na,s1,front\na,s2,back\nb,s3,v1\nb,s3,v2\n")
    pairs = find([grid("a"), grid("b")], ["s1.npz", "s2.npz", "s3/v1.npz", "s3/v2.npz"], map=table)
    assert [(p.asset_id, p.view, p.slat.name) for p in pairs] == [
        ("a.back", "back", "s2.npz"),
        ("a.front", "front", "s1.npz"),
        ("b.v1", "v1", "v1.npz"),
        ("b.v2", "v2", "v2.npz"),
    ]
    assert not any(p.problem for p in pairs)


def test_ids_in_a_map_cannot_leave_the_folder(find, tmp_path):
    touch(tmp_path, "secret.npz")
    table = tmp_path / "map.csv"
    table.write_text("object_id,slat_id\na,../secret\n../x,s\n")
    pairs = find([grid("a")], ["s.npz"], map=table)
    assert [pair.asset_id for pair in pairs] == ["..%2Fx", "a"]
    assert "'../x' is not allowed" in pairs[0].problem
    assert pairs[1].slat is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("id,other\na,b\n", "expected object_id and slat_id"),
        ("", "columns none"),
        ("object_id,slat_id\na,\n", "line 2: empty"),
        ("object_id,slat_id\n\x80", "cannot be read"),
        ("object_id,slat_id,object_id\na,b,c\n", "has two columns"),
        ("object_id,slat_id,view,view\na,b,c,d\n", "has two columns"),
        ("object_id;slat_id\na;1\n", "save it with commas between the columns"),
        ("\xff\xfeo\0b\0", "save it as CSV in UTF-8"),
    ],
)
def test_bad_maps(find, tmp_path, text, message):
    table = tmp_path / "map.csv"
    table.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=message) as caught:
        find([grid("a")], ["a.npz"], map=table)
    assert str(table) in str(caught.value)
    with pytest.raises(ConfigError, match="cannot be read"):
        find(map=tmp_path / "none.csv")


@pytest.mark.parametrize("key", ["map", "categories"])
def test_a_pipe_in_place_of_a_table_is_not_waited_for(find, tmp_path, key):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigError, match=r"pipe: cannot be read as .*no regular file"):
        find([grid("a")], ["a.npz"], **{key: tmp_path / "pipe"})


def test_a_list_of_categories_beyond_reason_is_not_read(find, tmp_path):
    table = tmp_path / "huge.json"
    with table.open("wb") as file:
        file.truncate(2**40)  # a hole: it takes no space on disk
    with pytest.raises(ConfigError, match="larger than 256 MiB"):
        find([grid("a")], ["a.npz"], categories=table)


def test_categories(find, tmp_path):
    table = tmp_path / "obj_ids_metadata.json"
    entry = {"obj_class": "soda_cans", "vlm_filtering": {"is_appropriate": True}}
    table.write_text(json.dumps({"a": entry}))
    pairs = find([grid("a"), grid("b")], ["a.npz", "b.npz"], categories=table)
    assert [pair.category for pair in pairs] == ["soda_cans", ""]

    for text, message in (
        ("{", "JSON"),
        ("[]", "expected an object"),
        ('{"a": 1}', "'a' has no"),
        ('{"a": {"obj_class": "x"}, "a": {"obj_class": "y"}}', "the key 'a' occurs twice"),
        ('{"a": {"obj_class": "x", "obj_class": "y"}}', "the key 'obj_class' occurs twice"),
        ('{"a": {"obj_class": "%s"}}' % ("x" * 257), "has 257 letters; expected at most 256"),
    ):
        table.write_text(text)
        with pytest.raises(ConfigError, match=message):
            find(categories=table)

from pathlib import Path

import pytest

from slatprep.storage import atomic


def directory(path: Path, content: str) -> Path:
    path.mkdir()
    (path / "file").write_text(content)
    return path


@pytest.mark.parametrize("exchange", [True, False], ids=["exchanged", "renamed twice"])
def test_the_new_takes_the_olds_place(tmp_path, monkeypatch, exchange):
    if not exchange:
        monkeypatch.setattr(atomic, "_exchange", lambda new, target: False)
    target = directory(tmp_path / "store", "old")
    atomic.replace_directory(directory(tmp_path / "new", "new"), target)
    assert (target / "file").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


def test_a_new_that_does_not_exist_leaves_the_old(tmp_path):
    atomic.replace_directory(directory(tmp_path / "new", "old"), tmp_path / "store")
    with pytest.raises(OSError):
        atomic.replace_directory(tmp_path / "absent", tmp_path / "store")
    assert (tmp_path / "store" / "file").read_text() == "old"

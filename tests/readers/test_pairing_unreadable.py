"""Folders that cannot be listed and names that are no files cost their asset alone."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.raw_sources import grid

from slatprep.errors import InputError
from slatprep.readers import read_field, read_latents


@contextmanager
def without_privileges(folder: Path) -> Iterator[None]:
    """Be nobody in particular: root may read everything."""
    if os.geteuid():
        yield
        return
    for one in (folder, *folder.parents):
        one.chmod(one.stat().st_mode | 0o755)
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.parametrize("side", ["pixie", "slat"])
def test_a_folder_that_cannot_be_listed_costs_its_asset_alone(find, tmp_path, side):
    slats = ["a/1.npz", "b/1.npz", "c.npz"]
    find([grid("a"), grid("b"), grid("c")], slats)
    (tmp_path / side / "a").chmod(0)
    with without_privileges(tmp_path):
        found = {pair.asset_id: pair for pair in find()}
    (tmp_path / side / "a").chmod(0o755)
    assert list(found) == ["a", "b", "c"]
    assert f"{tmp_path / side}/a/: cannot be listed (Permission denied)" in found["a"].problem
    assert found["a"].problem.count("cannot be listed") == 1
    assert not found["b"].problem
    assert not found["c"].problem
    with pytest.raises(InputError, match="cannot be listed") as caught:
        read_field(found["a"])
    assert type(caught.value) is InputError  # not a partner that is missing


def test_a_folder_on_the_way_to_ids_that_cannot_be_listed_is_named(find, tmp_path):
    patterns = {"pixieverse": {"grid": ("*/{id}.npy",)}, "slat": {"pattern": ("*/{id}.npz",)}}
    find(["x/a.npy", "y/b.npy"], ["x/a.npz", "y/b.npz"], **patterns)
    (tmp_path / "pixie" / "y").chmod(0)
    with without_privileges(tmp_path):
        found = {pair.asset_id: pair for pair in find(**patterns)}
    (tmp_path / "pixie" / "y").chmod(0o755)
    assert not found["a"].problem
    assert "no grid for id 'b'" in found["b"].problem
    assert "/y/: cannot be listed" in found["y%2F"].problem


def test_what_is_no_file_is_named_by_its_name(find, tmp_path):
    slats = tmp_path / "slat"
    slats.mkdir()
    for name, target in (("b", "b.npz"), ("c", "gone"), ("e", "/dev/zero")):
        (slats / f"{name}.npz").symlink_to(target)
    os.mkfifo(slats / "d.npz")
    first, *others = find(map(grid, "abcde"), ["a.npz"])
    assert not first.problem
    messages = "cannot be opened", "is a link that leads nowhere", "is not a regular", "leads to /d"
    for pair, message in zip(others, messages, strict=True):
        assert not pair.problem
        with pytest.raises(InputError, match=f"{pair.asset_id}.npz: {message}"):
            read_latents(pair)


def test_a_mask_that_leads_nowhere_is_no_missing_mask(find, tmp_path):
    find([grid("a")], ["a.npz"])
    mask = tmp_path / "pixie/a/clip_features_mask.npy"
    mask.symlink_to("gone")
    (pair,) = find()
    assert pair.mask == mask

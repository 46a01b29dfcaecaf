"""What a build takes over from the store that is there is checked first, and else made anew."""

import shutil
from typing import Any

import pytest
import zarr
from support.faults import flip
from support.made_store import edit_record, rewrite
from support.synthetic import Made
from support.trees import tree

from slatprep.inspect.verify import verify_store
from slatprep.pipeline.dataset import BuildSummary, build_store, plan_build
from slatprep.store import open_store
from slatprep.store.integrity import write_digests
from slatprep.store.layout import FILE

RECORDS = "asset/record/c/0"


def rebuilt(built: Made, undisturbed: Made) -> BuildSummary:
    """Build with other ranges, which takes over what is sound; compare with one from nothing."""
    dataset, out = built
    summary = build_store(dataset.parameters("pixie"), out)
    assert tree(out) == tree(undisturbed[1])
    assert summary.complete
    assert verify_store(out).ok
    return summary


@pytest.mark.parametrize("share", [0.1, 0.7])
def test_a_flipped_bit_of_a_record_is_never_inherited(built, undisturbed, aligned, share):
    dataset, out = built
    flip(out / RECORDS, int(share * (out / RECORDS).stat().st_size))
    assert RECORDS in {finding.file for finding in verify_store(out).findings}
    plan = plan_build(dataset.parameters(), out)
    assert all(RECORDS in asset.reason for asset in plan.assets), plan.assets
    assert plan.actions["align"] == 3
    (told,) = rebuilt(built, undisturbed).damaged
    assert told.startswith(f"{RECORDS}: its bytes changed")
    assert len(aligned) == 3


@pytest.mark.parametrize("text", ["", "[" * 100_000])
def test_a_record_that_is_none_is_made_anew(built, undisturbed, text):
    rewrite(built[1], "asset/record", 1, text)
    assert rebuilt(built, undisturbed).damaged


OF_ROWS = ("asset/fitness/c/0", "voxel/feats/c/0/0", "grid/material/c/1/0/0/0")
OF_ALL = ("asset/id/c/0", "asset/offset/c/0", "file/sha256/c/0")


@pytest.mark.parametrize("name", [*OF_ROWS, *OF_ALL])
def test_a_store_that_is_damaged_is_not_current(built, aligned, name):
    dataset, out = built
    before = tree(out)
    flip(out / name, (out / name).stat().st_size // 2)
    summary = build_store(dataset.parameters(), out)
    assert tree(out) == before
    assert len(aligned) == (3 if name in OF_ALL else 0)
    assert any(name.rpartition("/c/")[0] in told or "file" in told for told in summary.damaged)
    assert build_store(dataset.parameters(), out).damaged == ()


def test_rows_that_are_gone_are_written_again(built):
    dataset, out = built
    before = tree(out)
    (out / "voxel/feats/c/1/0").unlink()
    (told,) = build_store(dataset.parameters(), out).damaged
    assert told.startswith("voxel/feats/c/1/0: is missing")
    assert tree(out) == before


@pytest.mark.filterwarnings("ignore:Consolidated metadata")
@pytest.mark.parametrize("what", ["transform", "class"])
def test_a_transform_or_class_of_no_source_is_found_anew(built, undisturbed, aligned, what):
    """Every checksum and digest is right, and yet the record is not of these rows."""
    _, out = built

    def shift(record: dict[str, Any]) -> None:
        record["alignment"]["transform"][0][3] += 0.25

    if what == "class":
        asset = open_store(out).asset("b")
        other = 1 - asset.material[asset.valid][0] % 2
        rewrite(out, "voxel/material", open_store(out).offsets[1] + asset.valid.argmax(), other)
    else:
        edit_record(out, 1, shift)
    shutil.rmtree(out / FILE)
    write_digests(out)
    zarr.consolidate_metadata(str(out), zarr_format=3)
    (told,) = rebuilt(built, undisturbed).damaged
    assert told.startswith("b: ")
    assert aligned == ["b"]

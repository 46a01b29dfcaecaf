"""What a build says of itself at the end."""

from pathlib import Path

from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.pipeline.recipe import recipe_of, record_of_failed
from slatprep.pipeline.rows import Row
from slatprep.pipeline.summary import counts_of, nothing_usable, summarise
from slatprep.records import AssetPair, Failed, SourceRoots, Status
from slatprep.store.record import FailedRecord

PARAMETERS = BuildParameters(PixieverseSource(Path("/grids")), SlatSource(Path("/slats")))


def failed(number: int, status: Status = Status.FAILED) -> FailedRecord:
    pair = AssetPair(f"a{number:03d}", "", "", "", SourceRoots(Path(), Path()), *[None] * 4)
    return record_of_failed(Failed(pair, status, f"reason {number}"), recipe_of(PARAMETERS))


def finished(name: str, verdict: str) -> Row:
    columns = {"verdict": verdict, "unphysical": 4, "contradicted": name == "y", "n_valid": 7}
    return Row(name, 10, columns=columns)


def test_assets_are_counted_and_the_first_hundred_problems_listed():
    usable = [finished("x", "good"), finished("y", "doubtful"), finished("z", "good")]
    without = [*map(failed, range(120)), failed(120, Status.SKIPPED)]
    summary = summarise(counts_of(usable), without, Path("r"), "id", 1.0)
    assert summary.statuses == {"ok": 3, "failed": 120, "skipped": 1}
    assert summary.verdicts == {"doubtful": 1, "good": 2}
    assert (summary.n_voxels, summary.n_valid) == (30, 21)
    assert summary.n_unphysical == 12
    assert summary.contradicted == ("y",)
    assert summary.problems[0] == ("a000", "reason 0")
    assert len(summary.problems) == 100
    assert not summary.complete
    clean = summarise(counts_of(usable[-1:]), [], Path("r"), "id", 1.0)
    assert clean.complete


def test_nothing_usable_names_five_and_counts_the_rest():
    five = nothing_usable([failed(n) for n in range(5)], PARAMETERS)
    assert "none of 5 assets can be used" in five
    assert five.splitlines()[1:] == [f"  a00{n}: reason {n}" for n in range(5)]
    seven = nothing_usable([failed(n) for n in range(7)], PARAMETERS)
    assert seven.splitlines()[-1] == "  and 2 more"
    assert "no asset found in /grids and /slats" in nothing_usable([], PARAMETERS)

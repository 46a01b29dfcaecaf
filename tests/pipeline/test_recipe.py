"""What decides an asset's key, and what is said when it has another one."""

from dataclasses import replace
from pathlib import Path

import pytest

from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.pipeline.dataset import BuildSummary
from slatprep.pipeline.recipe import Recipe
from slatprep.store.record import AssetRecord, StageParameters
from slatprep.store.record_json import read_asset_record

RECIPE = Recipe(
    StageParameters(AlignParameters(), SampleParameters()),
    {"numpy": "2.0", "scipy": "1.11"},
    "c0de",
)
DIGESTS = {"grid": "0" * 64, "slat": "1" * 64}


@pytest.fixture(scope="module")
def record(mixed_build: BuildSummary) -> AssetRecord:
    first, *_ = Path(str(mixed_build.records)).read_text("utf-8").splitlines()
    return read_asset_record(first, "its first line")


def test_all_that_touches_the_numbers_is_in_the_key_and_no_order():
    others = (
        RECIPE.key("b", DIGESTS),
        RECIPE.key("a", {**DIGESTS, "slat": "2" * 64}),
        RECIPE.key("a", {"grid": DIGESTS["slat"], "slat": DIGESTS["grid"]}),
        replace(RECIPE, versions={"numpy": "2.1", "scipy": "1.11"}).key("a", DIGESTS),
        replace(RECIPE, code="c0de2").key("a", DIGESTS),
        replace(
            RECIPE,
            parameters=StageParameters(AlignParameters(), SampleParameters(max_distance=1.0)),
        ).key("a", DIGESTS),
    )
    key = RECIPE.key("a", DIGESTS)
    assert len({key, *others}) == 1 + len(others)
    turned = replace(RECIPE, versions=dict(reversed(RECIPE.versions.items())))
    assert turned.key("a", dict(reversed(DIGESTS.items()))) == key


def test_what_changed_is_said(record):
    same = Recipe(record.parameters, dict(record.versions), record.code)
    assert same.difference(record, record.sources) == "sources changed: "
    grid, slat = record.sources
    other = replace(slat, sha256="f" * 64)
    assert same.difference(record, (grid, other)) == f"sources changed: {slat.role}"
    assert same.difference(record, (grid,)) == f"sources changed: {slat.role}"
    assert replace(same, code="other").difference(record, record.sources) == "code changed"
    newer = replace(same, versions={**record.versions, "numpy": "99.0"})
    was = record.versions["numpy"]
    assert newer.difference(record, ()) == f"libraries changed: numpy was {was}, is 99.0"
    unknown = replace(same, versions={"small_gicp": "1.0"})
    assert unknown.difference(record, ()) == "libraries changed: small_gicp was None, is 1.0"

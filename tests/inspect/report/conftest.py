"""A store with hostile strings, and its page."""

import json
import shutil
from pathlib import Path

import pytest
import zarr
from support.pages import HOSTILE, Page, Report

from slatprep.inspect.report import write_report
from slatprep.pipeline.dataset import BuildSummary
from slatprep.store import open_store


@pytest.fixture(scope="session")
def hostile(mixed_build: BuildSummary, tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Copy `mixed`, put `HOSTILE` wherever data can say anything, and write its page."""
    folder = tmp_path_factory.mktemp("report")
    store = Path(shutil.copytree(mixed_build.store, folder / "mixed.zarr"))
    manifests = Path(shutil.copytree(mixed_build.records.parent, folder / "mixed.manifests"))
    group = zarr.open_group(store, mode="r+")
    categories = group["asset/category"][:]
    categories[:] = ["animal", "animal", "animal", HOSTILE, "vessel"]
    group["asset/category"][:] = categories
    texts = group["asset/record"][:]
    for row, text in enumerate(texts):
        record = json.loads(str(text))
        if record["asset_id"] == "ant":
            record["judgement"]["reasons"] = [HOSTILE]
            texts[row] = json.dumps(record)
    group["asset/record"][:] = texts
    build = json.loads((manifests / "build.json").read_text("utf-8"))
    for record in build["failed"]:
        if record["status"] == "failed":
            record["reason"] = HOSTILE
    (manifests / "build.json").write_text(json.dumps(build), "utf-8")
    path = folder / "page.html"
    write_report(open_store(store), path, manifests=manifests)
    return Report(store, manifests, path)


@pytest.fixture(scope="session")
def page(hostile: Report) -> Page:
    """Return the page of `hostile`, taken apart."""
    return Page(hostile.path)

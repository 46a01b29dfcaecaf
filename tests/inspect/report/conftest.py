"""A store with hostile strings, and its page."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.made_store import edit_json, edit_record, rewrite
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
    categories = np.array(["animal", "animal", "animal", HOSTILE, "vessel"], dtype=object)
    rewrite(store, "asset/category", slice(None), categories)
    unusual = ["", "", "", f"masks: {HOSTILE}\nvalues: is it in MPa?", ""]
    rewrite(store, "asset/unusual", slice(None), np.array(unusual, dtype=object))
    edit_record(store, 0, lambda record: record["judgement"].update(reasons=[HOSTILE]))

    def give_reasons(build: dict[str, Any]) -> None:
        for record in build["failed"]:
            if record["status"] == "failed":
                record["reason"] = HOSTILE

    edit_json(manifests / "build.json", give_reasons)
    path = folder / "page.html"
    write_report(open_store(store), path, manifests=manifests)
    return Report(store, manifests, path)


@pytest.fixture(scope="session")
def page(hostile: Report) -> Page:
    """Return the page of `hostile`, taken apart."""
    return Page(hostile.path)

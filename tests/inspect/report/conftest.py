"""A store with hostile strings, its page, and a browser to open it."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import zarr
from support.pages import HOSTILE, Page, Report

from slatprep.inspect.report import write_report
from slatprep.pipeline.dataset import BuildSummary
from slatprep.store import open_store

if TYPE_CHECKING:
    from selenium.webdriver import Chrome


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


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chrome]:
    """Start a headless Chromium; without one the tests are skipped, but never in CI."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    chromedriver = shutil.which("chromedriver")
    if chromium is None or chromedriver is None:
        text = "no chromium and chromedriver here; apt-get install chromium chromium-driver"
        if os.environ.get("SLATPREP_NEEDS_BROWSER"):
            pytest.fail(text)
        pytest.skip(text)
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (
        "--headless=new",
        "--no-sandbox",  # which root has to do without
        "--disable-dev-shm-usage",
        "--disable-background-networking",
        "--disable-component-update",
        "--no-first-run",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--force-prefers-reduced-motion",
        "--window-size=1400,1000",
        f"--user-data-dir={tmp_path_factory.mktemp('chromium')}",
    ):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(chromedriver))
    try:
        yield driver
    finally:
        driver.quit()

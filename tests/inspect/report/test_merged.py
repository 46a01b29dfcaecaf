"""What a page says of labels that are merged of several annotations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.pages import Page
from support.synthetic import MakeDataset

from slatprep.inspect.report import write_report
from slatprep.pipeline.dataset import BuildSummary, build_store
from slatprep.store import open_store

FACTORS = {"a": (1.0, 2.0), "b": (1.0, 1.1, 1.0)}
"""What the samples of the objects make of Young's modulus."""


@pytest.fixture
def merged(make_dataset: MakeDataset, tmp_path: Path) -> BuildSummary:
    dataset = make_dataset("a", "b", "c")
    for name, factors in FACTORS.items():
        for sample, factor in enumerate(factors):
            grid = dataset.assets[name].grid.copy()
            grid[grid[..., 3] != 7, 1] *= factor
            path = dataset.root / "pixieverse" / name / f"sample_{sample}" / "material_grid.npy"
            path.parent.mkdir(exist_ok=True)
            np.save(path, grid)
    (dataset.root / "pixieverse/b/sample_2/material_grid.npy").write_bytes(b"torn")
    parameters = dataset.parameters()
    source = replace(parameters.pixieverse, samples="merge")
    return build_store(replace(parameters, pixieverse=source), tmp_path / "s.zarr")


def test_assets_say_how_many_annotations_agree(merged, browser, tmp_path):
    path = tmp_path / "page.html"
    store = open_store(str(merged.store))
    write_report(store, path, manifests=merged.records.parent)
    assets = Page(path).content["assets"]
    assert assets["annotations"] == [[2, 2], [2, 3], None]
    assert assets["votes"] == [1.0, 1.0, None]
    modulus = store.normalization.ranges[0]
    expected = [
        np.std(np.log10(FACTORS[name][:2])) * 2 / (modulus.hi - modulus.lo) for name in "ab"
    ]
    np.testing.assert_allclose([one[0] for one in assets["spreads"][:2]], expected, atol=1e-4)
    assert assets["spreads"][2] is None

    browser.get("about:blank")
    browser.get(f"{path.as_uri()}#asset=a")
    assert "assets with merged labels\n2" in browser.find_element("id", "tiles").text
    text = browser.find_element("id", "asset-figures").text.split("\n")
    figures = dict(zip(text[::2], text[1::2], strict=False))
    assert figures["Annotations merged"] == "2"
    assert figures["Votes for the class"] == "100.0 %"
    assert figures["Young's modulus, spread"] == "factor 1.41"  # 10 to the std of log10 1 and 2
    assert figures["Poisson's ratio, spread"] == "± 0"
    script = "return [...document.querySelectorAll('td.id')].map(cell => cell.textContent)"
    order = []
    for _ in range(2):
        browser.execute_script("document.querySelector('[data-sort=spread]').click()")
        order.append(browser.execute_script(script))
    assert order == [["b", "a", "c"], ["a", "b", "c"]]
    assert browser.get_log("browser") == []


def test_a_page_without_merged_labels_has_no_such_columns(make_dataset, browser, tmp_path):
    made = build_store(make_dataset("a").parameters(), tmp_path / "s.zarr")
    path = tmp_path / "page.html"
    write_report(open_store(str(made.store)), path, manifests=made.records.parent)
    assert Page(path).content["assets"]["annotations"] == [None]
    browser.get(path.as_uri())
    assert browser.find_elements("css selector", "[data-sort=votes]") == []
    assert browser.get_log("browser") == []

"""A store of hostile texts that `verify` accepts: none of them runs in a browser."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.pages import HOSTILE
from support.synthetic import Dataset

from slatprep.inspect.report import write_report
from slatprep.inspect.verify import verify_store
from slatprep.parameters import (
    BuildParameters,
    PairingParameters,
    PixieverseSource,
    SlatSource,
)
from slatprep.pipeline.dataset import build_store
from slatprep.store import open_store

pytest.importorskip("selenium")

IN_NAMES = '<img src=x onerror="window.broken = 1"><svg onload=alert(1)>'
"""What a name of a file can hold: no slash."""

SOUND = ("ant", "__proto__", "constructor")
REFUSED = (f"a{IN_NAMES}", "javascript:window.broken = 1", "${window.broken = 1}", '`"><b>')
"""Ids: only those of plain letters go into a store, and a page lists the others."""

READY = "return performance.getEntriesByName('slatprep-ready').length"

EVERYTHING = """
const pressed = (selector) => [...document.querySelectorAll(selector)].map((one) => one.click());
pressed("[data-sort], [data-state], [data-key] .bin, .chip, [data-mode], [data-switch], summary");
for (const choice of document.querySelectorAll("select"))
  for (const option of choice.options) {
    choice.value = option.value;
    choice.dispatchEvent(new Event("change"));
  }
for (const one of document.querySelectorAll("*"))
  for (const kind of ["mouseover", "mouseenter", "pointermove", "focus"])
    one.dispatchEvent(new Event(kind, {bubbles: true}));
"""
"""Presses, chooses and points at all that there is."""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build such a store from its sources, and write its page."""
    root = tmp_path_factory.mktemp("texts") / IN_NAMES
    dataset = Dataset(root)
    (root / "voxels").mkdir(parents=True)
    units = {"density": HOSTILE, "friction": f"{HOSTILE}\u2028\n", "heat": "\\u003cscript>"}
    for number, name in enumerate((*SOUND, *REFUSED, "torn")):
        dataset.add(name, number)
        asset = dataset.assets[name]
        voxels = np.argwhere(asset.grid[..., 3] != 7)
        columns = {unit: asset.grid[tuple(voxels.T)][:, 0].astype(np.float64) for unit in units}
        np.savez(root / "voxels" / f"{name}.npz", voxels=voxels, **columns)
    (root / "voxels" / "torn.npz").write_bytes(b"PK torn")
    np.savez(root / "slat" / f"lone{IN_NAMES}.npz", coords=np.zeros((1, 3)))
    np.savez(root / "voxels/strange.npz", **{IN_NAMES: np.zeros(1)})
    dataset.write_slat("strange.npz", dataset.assets["ant"].coords, dataset.assets["ant"].feats)
    described = [{"name": name, "unit": unit, "scale": "log10"} for name, unit in units.items()]
    (root / "voxels/source.json").write_text(
        json.dumps({"properties": described, "classes": False})
    )
    kinds = (HOSTILE, "__proto__", f"{HOSTILE}\u2028`${{window.broken = 1}}")
    categories = {name: {"obj_class": kind} for name, kind in zip(SOUND, kinds, strict=True)}
    (root / "categories.json").write_text(json.dumps(categories))
    parameters = BuildParameters(
        PixieverseSource(root / "voxels", adapter="voxels"),
        SlatSource(root / "slat"),
        pairing=PairingParameters(categories=root / "categories.json"),
        name=HOSTILE,
    )
    summary = build_store(parameters, root / f"{IN_NAMES}.zarr")
    assert summary.statuses["ok"] == len(SOUND)
    assert verify_store(root / f"{IN_NAMES}.zarr", sources=True).findings == ()
    store = open_store(root / f"{IN_NAMES}.zarr")
    out = root / f"{IN_NAMES}.html"
    write_report(store, out, manifests=summary.records.parent)
    return out


def test_no_text_of_a_store_that_verify_accepts_runs(browser, page):
    from selenium.webdriver.support.ui import WebDriverWait

    for end in ("", "#asset=0", f"#asset={IN_NAMES}", f"#{HOSTILE}", "#asset=${window.broken=1}"):
        browser.get("about:blank")
        browser.get(page.as_uri() + end)
        WebDriverWait(browser, 300).until(lambda it: it.execute_script(READY))
        shown = browser.execute_script("return document.body.textContent")
        assert [text for text in (*SOUND, *REFUSED, IN_NAMES, HOSTILE) if text not in shown] == []
        browser.execute_script(EVERYTHING)
        for _ in range(len(SOUND) + 2):
            browser.execute_script("document.getElementById('next').click()")
        assert browser.execute_script("return typeof window.broken") == "undefined"
        strange = "return document.querySelectorAll('img, body script[src], svg[onload], b').length"
        assert browser.execute_script(strange) == 0
        fetched = "return performance.getEntriesByType('resource').map(entry => entry.name)"
        assert [name for name in browser.execute_script(fetched) if name[:5] != "blob:"] == []
        assert browser.get_log("browser") == []

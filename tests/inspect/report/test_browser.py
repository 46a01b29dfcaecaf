"""The page in a real browser, opened from disk."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image
from support.faults import wait_until
from support.made_store import edit_record, rewrite
from support.pages import HOSTILE, Page, Report
from support.synthetic import Dataset, MakeDataset

from slatprep.inspect.report import write_report
from slatprep.inspect.verify import verify_store
from slatprep.pipeline.dataset import BuildSummary, build_store
from slatprep.store import open_store
from slatprep.store.records import manifests_of

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

pytest.importorskip("selenium")

LIBRARY = '<script type="text/plain" id="library">'


def open_page(browser: Chrome, report: Report, end: str = "") -> None:
    browser.get("about:blank")  # else a change of the address' end loads nothing
    browser.get(report.path.as_uri() + end)
    ready = "return performance.getEntriesByName('slatprep-ready').length"
    wait_until(lambda: browser.execute_script(ready))


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
        "headless=new", "no-sandbox",  # which root has to do without
        "disable-dev-shm-usage", "disable-background-networking", "disable-component-update",
        "no-first-run", "use-angle=swiftshader", "enable-unsafe-swiftshader",
        "force-prefers-reduced-motion", "window-size=1400,1000",
        "force-device-scale-factor=0.5",  # a quarter of the pixels to draw
        f"user-data-dir={tmp_path_factory.mktemp('chromium')}",
    ):  # fmt: skip
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(chromedriver))
    try:
        yield driver
    finally:
        driver.quit()


@pytest.fixture
def opened(browser: Chrome, hostile: Report) -> Chrome:
    open_page(browser, hostile)
    return browser


def page_of(made: BuildSummary, path: Path) -> Report:
    """Write the page of a build."""
    store, manifests = Path(str(made.store)), made.records.parent
    write_report(open_store(store), path, manifests=manifests)
    return Report(store, manifests, path)


def cut(browser: Chrome) -> list[str]:
    """Return the headings and numbers of the table that are not shown whole."""
    script = """const shown = (cell) => cell.clientWidth && cell.scrollWidth > cell.clientWidth;
        return [...document.querySelectorAll("thead button, thead .plain, td.right")].filter(shown)
        .map((cell) => cell.textContent)"""
    return list(browser.execute_script(script))


def rows(browser: Chrome) -> list[str]:
    script = "return [...document.querySelectorAll('td.id')].map(cell => cell.textContent)"
    return list(browser.execute_script(script))


def drawn(browser: Chrome) -> Callable[[], bytes]:
    """Wait until the 3D view shows something; return what takes a picture of it."""
    script = """const {x, y, width, height} = byId("canvas").getBoundingClientRect();
        return {x: x + scrollX, y: y + scrollY, width, height, scale: 1}"""

    def pixels() -> bytes:
        picture = {"clip": browser.execute_script(script), "optimizeForSpeed": True}
        taken = browser.execute_cdp_cmd("Page.captureScreenshot", picture)
        return base64.b64decode(taken["data"])

    wait_until(lambda: len(Image.open(io.BytesIO(pixels())).convert("P").getcolors() or ()) > 8)
    return pixels


def click(browser: Chrome, selector: str) -> None:
    browser.execute_script("document.querySelector(arguments[0]).click()", selector)


def choose(browser: Chrome, menu: str, value: str) -> None:
    """Choose an entry of a menu."""
    script = """const menu = document.getElementById(arguments[0]); menu.value = arguments[1];
        menu.dispatchEvent(new Event('change'))"""
    browser.execute_script(script, menu, value)


def assert_quiet(browser: Chrome) -> None:
    """Nothing went wrong, nothing was fetched, and no data was run."""
    assert browser.get_log("browser") == []
    assert browser.execute_script("return typeof window.broken") == "undefined"
    assert browser.execute_script("return document.querySelectorAll('img').length") == 0
    fetched = "return performance.getEntriesByType('resource').map(entry => entry.name)"
    assert [name for name in browser.execute_script(fetched) if name[:5] != "blob:"] == []


def test_it_opens_sorts_and_filters(opened):
    from selenium.webdriver.common.keys import Keys

    everything = {"ant", "bear.front", "bear.side", "cup", "dog", "lone", "torn"}
    assert set(rows(opened)) == everything
    click(opened, "[data-sort=id]")
    assert rows(opened) == sorted(everything)
    assert opened.find_elements("css selector", "[data-sort=votes]") == []  # No labels are merged.
    click(opened, "[data-sort=id]")
    assert rows(opened) == sorted(everything, reverse=True)
    click(opened, "[data-sort=voxels]")  # Those not in the store have none, and come last.
    assert set(rows(opened)[-2:]) == {"lone", "torn"}

    click(opened, "#state-chips [data-state=skipped]")
    assert rows(opened) == ["lone"]
    click(opened, "#state-chips [data-state=skipped]")
    search = opened.find_element("id", "search")
    search.send_keys("BEAR")
    assert set(rows(opened)) == {"bear.front", "bear.side"}
    assert opened.find_element("id", "count").text == "2 of 7 assets"
    search.send_keys(Keys.CONTROL, "a", Keys.NULL, Keys.BACKSPACE)
    search.send_keys("onerror=")
    assert set(rows(opened)) == {"ant", "cup", "torn"}
    search.send_keys(Keys.CONTROL, "a", Keys.NULL, Keys.BACKSPACE)
    choose(opened, "category", f"={HOSTILE}")
    assert rows(opened) == ["cup"]
    choose(opened, "category", "*")
    click(opened, "[data-key=confidence] .bin")
    assert 0 < len(rows(opened)) < 7
    click(opened, "#applied .chip")
    assert set(rows(opened)) == everything
    assert HOSTILE in opened.find_element("id", "balance").text
    assert HOSTILE in opened.find_element("id", "why").text
    assert_quiet(opened)


def test_a_good_verdict_is_no_more_than_it_rests_on(opened):
    assert "stored assets good\n100.0 %\n" in opened.find_element("id", "tiles").text
    assert cut(opened) == []
    unusual = opened.find_elements("css selector", "#statelist .chip")[-1]
    assert unusual.text == "⚠ unusual 1"
    # A page that still moves would have a pointer miss it.
    opened.execute_script("arguments[0].click()", unusual)
    wait_until(lambda: rows(opened) == ["cup"])
    row = opened.find_element("css selector", "tbody tr:not(.space)")
    assert "⚠" in row.text and f"unusual masks: {HOSTILE}" in row.text
    row.click()
    told = opened.find_element("id", "asset-reasons").text
    assert told == f"unusual masks: {HOSTILE}\nunusual values: is it in MPa?"
    share = r"\d+\.\d %"
    rests = rf"good: confidence {share} = same object {share} . right placement {share}"
    assert re.search(rests, opened.find_element("id", "asset-state").text)
    click(opened, "#close")
    click(opened, "#applied .chip")
    assert len(rows(opened)) == 7
    search = opened.find_element("id", "search")
    search.send_keys("in mpa?")
    assert rows(opened) == ["cup"]
    assert_quiet(opened)


def test_a_reason_is_shown_without_its_path(browser, mixed_build, tmp_path):
    open_page(browser, page_of(mixed_build, tmp_path / "page.html"))
    click(browser, "#state-chips [data-state='not built']")
    cell = browser.find_element("css selector", "tbody tr:not(.space) td:nth-child(4)")
    whole, told = cell.get_attribute("title"), "the SLAT is empty; expected at least one voxel"
    assert whole.startswith("/") and whole.endswith(f"torn.npz: {told}")
    assert cell.text == f"not built\n{told}"


def test_each_line_of_reasons_shows_its_own_assets(browser, copy, tmp_path):
    why = ["only 51.4% of the labels can be expected to be right"]
    for row, verdict in enumerate(("doubtful", "failed", "failed")):
        rewrite(copy, "asset/verdict", row, verdict)
        said = {"reasons": why, "verdict": verdict}
        edit_record(copy, row, lambda one, said=said: one["judgement"].update(said))
    page = Report(copy, Path(str(manifests_of(copy))), tmp_path / "page.html")
    write_report(open_store(copy), page.path, manifests=page.manifests)
    open_page(browser, page)
    lines = browser.execute_script("return document.querySelectorAll('#why button').length")
    numbers = [
        one.get_attribute("textContent")
        for one in browser.find_elements("css selector", "#why .number")
    ]
    assert {"1", "2"} <= {*numbers} and lines == len(numbers)
    for number, line in zip(numbers, range(lines), strict=True):
        browser.execute_script(f"document.querySelectorAll('#why button')[{line}].click()")
        assert len(rows(browser)) == int(number)


def test_numbers_have_the_digits_that_tell_them_apart(opened):
    for call, text in (
        ("scientific(5.99990)", "1.0 \u00d7 10⁶"), ("scientific(-5.2)", "6.3 \u00d7 10⁻⁶"),
        ("scientific(2.9999)", "1000"), ("scientific(2)", "100"),
        ("within({lo: 1e-5, hi: 3e-5})(1e-5)", "0.0000100"),
        ("within({lo: 0.21, hi: 0.449})(0.3333)", "0.333"),
        ("within({lo: -40, hi: 1234567})(-7)", "\u22127"),
        ("within({lo: 1e6, hi: 3e7})(2345678)", "2,345,678"),
    ):  # fmt: skip
        assert opened.execute_script(f"return Format.{call}") == text, call


def test_it_opens_an_asset_that_turns(opened):
    from selenium.webdriver.common.keys import Keys

    click(opened, "[data-sort=id]")
    opened.find_element("css selector", "tbody tr:not(.space)").send_keys(Keys.ARROW_DOWN)
    opened.switch_to.active_element.send_keys(Keys.ENTER)
    title = opened.find_element("id", "asset-title")
    assert title.text.startswith("bear.front")
    canvas, pixels = opened.find_element("id", "canvas"), drawn(opened)
    front = pixels()
    assert opened.find_element("id", "scale").text.split() == ["jelly", "metal"]
    canvas.send_keys(Keys.ARROW_RIGHT * 4)
    wait_until(lambda: pixels() != front)
    still = pixels()
    click(opened, "[data-mode='property.youngs_modulus']")
    wait_until(lambda: pixels() != still)
    assert "Pa" in opened.find_element("id", "scale").text
    click(opened, "[data-switch=turning]")
    moving = pixels()
    wait_until(lambda: pixels() != moving)
    click(opened, "[data-switch=turning]")
    for switch in ("field", "before", "before", "slat"):
        before = pixels()
        click(opened, f"[data-switch={switch}]")
        wait_until(lambda before=before: pixels() != before)
    click(opened, "#next")
    wait_until(lambda: title.text.startswith("bear.side"))
    assert opened.current_url.endswith("#asset=bear.side")
    canvas.send_keys(Keys.ESCAPE)
    wait_until(lambda: not opened.execute_script("return document.getElementById('asset').open"))
    assert_quiet(opened)


def test_an_address_may_name_an_asset_in_short(browser, hostile):
    def opened_by(name: str) -> str:
        open_page(browser, hostile, f"#asset={name}")
        shown = browser.execute_script("return document.getElementById('asset').open")
        return browser.current_url.partition("#asset=")[2] if shown else ""

    assert opened_by("bear.s") == opened_by("bear.side") == "bear.side"
    assert opened_by("0") == "ant"
    for name in ("bear.", "nonsense", "400"):
        assert opened_by(name) == ""
        told = browser.find_element("id", "nowhere")
        assert told.is_displayed() and name in told.text


def test_an_address_opens_an_asset_before_the_page_has_been_read(browser, hostile, tmp_path):
    # So much stands between the scripts and the library that the asset is asked for first.
    text = hostile.path.read_text("utf-8")
    assert text.count(LIBRARY) == 1
    filler = "<!--" + "x" * 4_000_000 + "-->"
    slow = tmp_path / "slow.html"
    slow.write_text(text.replace(LIBRARY, f"{filler}{LIBRARY}"), "utf-8")
    browser.get("about:blank")
    browser.get(f"{slow.as_uri()}#asset=ant")
    drawn(browser)
    assert browser.find_element("id", "message").text == ""
    assert_quiet(browser)


def test_an_asset_without_a_picture_says_why_it_is_not_there(opened):
    click(opened, "#state-chips [data-state='not built']")
    click(opened, "tbody tr:not(.space)")
    assert "no 3D view" in opened.find_element("id", "message").text
    assert HOSTILE in opened.find_element("id", "asset-reasons").text
    assert_quiet(opened)


def test_a_deformed_asset_is_found_and_shown_through_its_map(browser, deformed_build, tmp_path):
    open_page(browser, page_of(deformed_build, tmp_path / "page.html"))
    assert set(rows(browser)) == {"bent", "long"}
    click(browser, "[data-sort=model]")
    assert rows(browser) == ["long", "bent"]
    click(browser, "[data-sort=confidence]")
    confidences = browser.execute_script("return ASSETS.confidence")
    least = confidences.index(min(confidences))
    assert rows(browser)[0] == browser.execute_script("return ASSETS.id[arguments[0]]", least)
    choose(browser, "model", "=deformable")
    assert rows(browser) == ["bent"]
    click(browser, "tbody tr:not(.space)")
    pixels = drawn(browser)
    click(browser, "[data-switch=field]")
    click(browser, "[data-switch=slat]")
    after = pixels()
    click(browser, "[data-switch=before]")
    wait_until(lambda: pixels() != after)
    click(browser, "[data-switch=before]")
    wait_until(lambda: pixels() == after)
    assert_quiet(browser)


def test_tied_placements_are_stepped_through(browser, copy, tmp_path):
    turned = np.diag([-1.0, -1.0, 1.0, 1.0]).tolist()
    placements = [{"transform": turned, "score": 1.0, "displacement": 40.0}]
    row = open_store(copy).ids.index("cup")
    edit_record(copy, row, lambda record: record["alignment"].update(placements=placements))
    path = tmp_path / "page.html"
    write_report(open_store(copy), path, manifests=manifests_of(copy))
    browser.get("about:blank")
    browser.get(f"{path.as_uri()}#asset=cup")
    pixels = drawn(browser)
    assert browser.find_element("id", "ties").text.split("\n")[1:] == ["as taken", "tie 1"]
    click(browser, "#ties button:nth-of-type(1)")
    click(browser, "[data-switch=slat]")
    click(browser, "[data-switch=slat]")
    taken = pixels()
    click(browser, "#ties button:nth-of-type(2)")
    wait_until(lambda: pixels() != taken)
    click(browser, "#ties button:nth-of-type(1)")
    wait_until(lambda: pixels() == taken)
    click(browser, "#next")
    wait_until(lambda: browser.find_element("id", "asset-title").text.startswith("dog"))
    assert not browser.find_element("id", "ties").is_displayed()
    assert_quiet(browser)


@pytest.mark.parametrize(("theme", "other"), [("dark", "light"), ("light", "dark")])
def test_light_and_dark(browser, hostile, theme, other):
    feature = {"name": "prefers-color-scheme", "value": theme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    open_page(browser, hostile)
    ground = "return getComputedStyle(document.body).backgroundColor"
    button = browser.find_element("id", "theme")
    here = browser.execute_script(ground)
    assert button.get_attribute("aria-label") == f"Use {other} colours"
    click(browser, "#theme")
    assert browser.execute_script(ground) != here
    assert button.get_attribute("aria-label") == f"Use {theme} colours"
    click(browser, "#theme")
    assert browser.execute_script(ground) == here
    assert_quiet(browser)


def test_a_phone_shows_whole_headings_and_numbers(browser, hostile):
    phone = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", phone)
    try:
        open_page(browser, hostile)
        head = browser.find_element("css selector", "thead").text
        assert all(title in head for title in ("Asset", "Verdict", "Confidence"))
        assert cut(browser) == []
        page = "return document.documentElement.scrollWidth - innerWidth"
        assert browser.execute_script(page) == 0
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


# -- merged labels -----------------------------------------------------------


FACTORS = {"a": (1.0, 2.0), "b": (1.0, 1.1, 1.0)}
"""What the samples of the objects make of Young's modulus."""


@pytest.fixture
def merged(make_dataset: MakeDataset, tmp_path: Path) -> BuildSummary:
    dataset = make_dataset("a", "b", "c")
    for name, factors in FACTORS.items():
        for sample, factor in enumerate(factors):
            grid = dataset.assets[name].grid.copy()
            grid[grid[..., 3] != 7, 1] *= factor
            dataset.write_grid(name, grid, sample)
    (dataset.root / "pixieverse/b/sample_2/material_grid.npy").write_bytes(b"torn")
    return build_store(dataset.parameters(pixieverse={"samples": "merge"}), tmp_path / "s.zarr")


def test_assets_say_how_many_annotations_agree(merged, browser, tmp_path):
    report = page_of(merged, tmp_path / "page.html")
    assets = Page(report.path).content["assets"]
    assert assets["annotations"] == [[2, 2], [2, 3], None]
    assert assets["votes"] == [1.0, 1.0, None]
    modulus = open_store(report.store).normalization.ranges[0]
    spreads = [np.std(np.log10(FACTORS[name][:2])) for name in "ab"]
    expected = np.multiply(spreads, 2 / (modulus.hi - modulus.lo))
    np.testing.assert_allclose([one[0] for one in assets["spreads"][:2]], expected, atol=1e-4)
    assert assets["spreads"][2] is None

    open_page(browser, report, "#asset=a")
    assert "assets with merged labels\n2" in browser.find_element("id", "tiles").text
    text = browser.find_element("id", "asset-figures").text.split("\n")
    figures = dict(zip(text[::2], text[1::2], strict=False))
    assert figures["Annotations merged"] == "2"
    assert figures["Votes for the class"] == "100.0 %"
    assert figures["Young's modulus, spread"] == "factor 1.41"  # 10 to the std of log10 1 and 2
    assert figures["Poisson's ratio, spread"] == "± 0"
    order = []
    for _ in range(2):
        click(browser, "[data-sort=spread]")
        order.append(rows(browser))
    assert order == [["b", "a", "c"], ["a", "b", "c"]]
    assert browser.get_log("browser") == []


# -- a store of hostile texts that `verify` accepts ----------------------------


IN_NAMES = '<img src=x onerror="window.broken = 1"><svg onload=alert(1)>'
"""What a name of a file can hold: no slash."""

SOUND = ("ant", "__proto__", "constructor")
REFUSED = (f"a{IN_NAMES}", "javascript:window.broken = 1", "${window.broken = 1}", '`"><b>')
"""Ids: only those of plain letters go into a store, and a page lists the others."""

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
def strange(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Build such a store from its sources, and write its page."""
    root = tmp_path_factory.mktemp("texts") / IN_NAMES
    dataset = Dataset(root)
    (root / "voxels").mkdir(parents=True)
    units = {"slat": HOSTILE, "friction": f"{HOSTILE}\u2028\n", "distance": "\\u003cscript>"}
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
    about = {"properties": described, "classes": False}
    (root / "voxels/source.json").write_text(json.dumps(about))
    kinds = (HOSTILE, "__proto__", f"{HOSTILE}\u2028`${{window.broken = 1}}")
    categories = {name: {"obj_class": kind} for name, kind in zip(SOUND, kinds, strict=True)}
    (root / "categories.json").write_text(json.dumps(categories))
    source = {"root": root / "voxels", "adapter": "voxels"}
    pairing = {"categories": root / "categories.json"}
    parameters = replace(dataset.parameters(pixieverse=source, pairing=pairing), name=HOSTILE)
    summary = build_store(parameters, root / f"{IN_NAMES}.zarr")
    assert summary.statuses["ok"] == len(SOUND)
    assert verify_store(root / f"{IN_NAMES}.zarr", sources=True).findings == ()
    return page_of(summary, root / f"{IN_NAMES}.html")


def test_a_property_may_have_the_name_of_anything_else_that_is_shown(browser, strange):
    open_page(browser, strange, "#asset=0")
    drawn(browser)
    lengths = browser.execute_async_script(
        "const keys = ['slat', 'property.slat', 'distance', 'property.distance'];"
        "const done = arguments[0];"
        "Data.voxels(0).then((of) => done(keys.map((key) => of[key].length)))"
    )
    assert lengths[0] == 3 * lengths[1] > 0 and lengths[1:] == [lengths[1]] * 3
    click(browser, "[data-mode='property.distance']")
    pressed = browser.find_elements("css selector", "[data-mode][aria-pressed=true]")
    assert [one.get_attribute("data-mode") for one in pressed] == ["property.distance"]
    assert "voxel" not in browser.find_element("id", "scale").text
    assert_quiet(browser)


def test_a_state_that_no_asset_has_cannot_be_chosen(browser, strange):
    open_page(browser, strange)
    chips = browser.find_elements("css selector", "#statelist .chip")
    counts = {one.text: one.is_enabled() for one in chips}
    assert {text.endswith(" 0") for text in counts} == {True, False}
    assert all(enabled != text.endswith(" 0") for text, enabled in counts.items())


def test_no_text_of_a_store_that_verify_accepts_runs(browser, strange):
    for end in ("", "#asset=0", f"#asset={IN_NAMES}", f"#{HOSTILE}", "#asset=${window.broken=1}"):
        open_page(browser, strange, end)
        shown = browser.execute_script("return document.body.textContent")
        assert [text for text in (*SOUND, *REFUSED, IN_NAMES, HOSTILE) if text not in shown] == []
        browser.execute_script(EVERYTHING)
        for _ in range(len(SOUND) + 2):
            click(browser, "#next")
        odd = "return document.querySelectorAll('body script[src], svg[onload], b').length"
        assert browser.execute_script(odd) == 0
        assert_quiet(browser)

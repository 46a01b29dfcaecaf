"""The page in a real browser, opened from disk."""

from __future__ import annotations

import io
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import zarr
from PIL import Image
from support.pages import HOSTILE, Report

from slatprep.inspect.report import write_report
from slatprep.store import open_store

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

pytest.importorskip("selenium")

LIBRARY = '<script type="text/plain" id="library">'

PATIENCE = 600  # A loaded machine draws 3D slowly without a graphics card.


def wait(condition: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "the page did not get there"
        time.sleep(0.05)


def open_page(browser: Chrome, report: Report, end: str = "") -> None:
    browser.get("about:blank")  # else a change of the address' end loads nothing
    browser.get(report.path.as_uri() + end)
    ready = "return performance.getEntriesByName('slatprep-ready').length"
    wait(lambda: browser.execute_script(ready))


@pytest.fixture
def opened(browser: Chrome, hostile: Report) -> Chrome:
    open_page(browser, hostile)
    return browser


def rows(browser: Chrome) -> list[str]:
    script = "return [...document.querySelectorAll('td.id')].map(cell => cell.textContent)"
    return list(browser.execute_script(script))


def drawn(browser: Chrome) -> Callable[[], bytes]:
    """Wait until the 3D view shows something; return what takes a picture of it."""
    canvas = browser.find_element("id", "canvas")

    def pixels() -> bytes:
        return bytes(canvas.screenshot_as_png)

    wait(lambda: len(Image.open(io.BytesIO(pixels())).convert("P").getcolors() or ()) > 8)
    return pixels


def click(browser: Chrome, selector: str) -> None:
    browser.execute_script("document.querySelector(arguments[0]).click()", selector)


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
    choose = (
        "const s = document.getElementById('category'); s.value = '=' + arguments[0];"
        "s.dispatchEvent(new Event('change'))"
    )
    opened.execute_script(choose, HOSTILE)
    assert rows(opened) == ["cup"]
    opened.execute_script(choose.replace("'=' + arguments[0]", "'*'"))
    click(opened, "[data-key=confidence] .bin")
    assert 0 < len(rows(opened)) < 7
    click(opened, "#applied .chip")
    assert set(rows(opened)) == everything
    assert HOSTILE in opened.find_element("id", "balance").text
    assert HOSTILE in opened.find_element("id", "why").text
    assert_quiet(opened)


def test_it_opens_an_asset_that_turns(opened):
    from selenium.webdriver.common.keys import Keys

    click(opened, "[data-sort=id]")
    row = opened.find_element("css selector", "tbody tr:not(.space)")
    row.send_keys(Keys.ARROW_DOWN)
    opened.switch_to.active_element.send_keys(Keys.ENTER)
    title = opened.find_element("id", "asset-title")
    assert title.text.startswith("bear.front")
    canvas, pixels = opened.find_element("id", "canvas"), drawn(opened)
    front = pixels()
    assert opened.find_element("id", "scale").text.split() == ["jelly", "metal"]
    canvas.send_keys(Keys.ARROW_RIGHT * 4)
    wait(lambda: pixels() != front)
    still = pixels()
    click(opened, "[data-mode=youngs_modulus]")
    wait(lambda: pixels() != still)
    assert "Pa" in opened.find_element("id", "scale").text
    click(opened, "[data-switch=turning]")
    moving = pixels()
    wait(lambda: pixels() != moving)
    click(opened, "[data-switch=turning]")
    for switch in ("field", "before", "before", "slat"):
        before = pixels()
        click(opened, f"[data-switch={switch}]")
        wait(lambda before=before: pixels() != before)
    click(opened, "#next")
    wait(lambda: title.text.startswith("bear.side"))
    assert opened.current_url.endswith("#asset=bear.side")
    canvas.send_keys(Keys.ESCAPE)
    wait(lambda: not opened.execute_script("return document.getElementById('asset').open"))
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


def test_a_deformed_asset_is_found_by_its_model_and_shown_through_its_map(
    browser, deformed_build, tmp_path
):
    path = tmp_path / "page.html"
    records = deformed_build.records.parent
    write_report(open_store(deformed_build.store), path, manifests=records)
    open_page(browser, Report(Path(deformed_build.store), records, path))
    assert set(rows(browser)) == {"bent", "long"}
    click(browser, "[data-sort=model]")
    assert rows(browser) == ["long", "bent"]
    click(browser, "[data-sort=confidence]")
    least = browser.execute_script(
        "return ASSETS.confidence.indexOf(Math.min(...ASSETS.confidence))"
    )
    assert rows(browser)[0] == browser.execute_script("return ASSETS.id[arguments[0]]", least)
    browser.execute_script(
        "const s = document.getElementById('model'); s.value = '=deformable';"
        "s.dispatchEvent(new Event('change'))"
    )
    assert rows(browser) == ["bent"]
    click(browser, "tbody tr:not(.space)")
    pixels = drawn(browser)
    click(browser, "[data-switch=field]")
    click(browser, "[data-switch=slat]")
    after = pixels()
    click(browser, "[data-switch=before]")
    wait(lambda: pixels() != after)
    click(browser, "[data-switch=before]")
    wait(lambda: pixels() == after)
    assert_quiet(browser)


def test_tied_placements_are_stepped_through(browser, mixed_build, tmp_path):
    store = Path(shutil.copytree(mixed_build.store, tmp_path / "mixed.zarr"))
    texts = (group := zarr.open_group(store, mode="r+"))["asset/record"][:]
    turned = np.eye(4)
    turned[:2, :2] = [[-1, 0], [0, -1]]
    for row, text in enumerate(texts):
        record = json.loads(str(text))
        if record["asset_id"] == "cup":
            record["alignment"]["placements"] = [
                {"transform": turned.tolist(), "score": 1.0, "displacement": 40.0}
            ]
            texts[row] = json.dumps(record)
    group["asset/record"][:] = texts
    path = tmp_path / "page.html"
    write_report(open_store(store), path, manifests=mixed_build.records.parent)
    browser.get("about:blank")
    browser.get(f"{path.as_uri()}#asset=cup")
    pixels = drawn(browser)
    assert browser.find_element("id", "ties").text.split("\n")[1:] == ["as taken", "tie 1"]
    click(browser, "#ties button:nth-of-type(1)")
    click(browser, "[data-switch=slat]")
    click(browser, "[data-switch=slat]")
    taken = pixels()
    click(browser, "#ties button:nth-of-type(2)")
    wait(lambda: pixels() != taken)
    click(browser, "#ties button:nth-of-type(1)")
    wait(lambda: pixels() == taken)
    click(browser, "#next")
    wait(lambda: browser.find_element("id", "asset-title").text.startswith("dog"))
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
        widths = """const shown = (cell) => cell.clientWidth && cell.textContent;
            return [...document.querySelectorAll("thead button, td.right")].filter(shown)
            .map((cell) => [cell.textContent, cell.scrollWidth <= cell.clientWidth])"""
        fits = browser.execute_script(widths)
        assert {"Asset", "State", "Confidence"} <= {text for text, _ in fits}
        assert [text for text, whole in fits if not whole] == []
        page = "return document.documentElement.scrollWidth - innerWidth"
        assert browser.execute_script(page) == 0
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})

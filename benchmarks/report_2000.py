"""Measure the page of a large store: its size, and the time until it can be used.

    python benchmarks/report_2000.py STORE.zarr [--assets 2000] [--noise 0.05] [--jobs 2]

STORE.zarr is any store with its records beside it or in manifests/build/NAME. Its
assets are repeated until there are enough; with --noise, each repeat gets its own noise in the
normalised properties. A fresh headless Chromium then opens the page from disk, several times. It
prints the page's size in bytes, the seconds to make it, and in milliseconds the median time
from opening the file to a usable table, to the end of loading and to the first picture of
an asset in 3D, and the longest frame while the table is scrolled from end to end.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import tempfile
import time
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from slatprep.inspect.report import write_report
from slatprep.parameters import StoreParameters
from slatprep.store import open_store
from slatprep.store.integrity import open_for_writing
from slatprep.store.layout import ARRAYS, RECORD_ARRAY
from slatprep.store.records import found_manifests, manifests_of
from slatprep.store.writer import create_store

RUNS = 3

SCROLL = """
const done = arguments[0], box = document.getElementById('tablebox');
let last = performance.now(), longest = 0, step = 0;
function frame(now) {
  longest = Math.max(longest, now - last);
  last = now;
  box.scrollTop = (step++ / 120) * box.scrollHeight;
  step <= 120 ? requestAnimationFrame(frame) : done(longest);
}
requestAnimationFrame((now) => { last = now; frame(now); });
"""

OPEN = """
const done = arguments[0], begin = performance.now();
document.querySelector('tbody tr:not(.space)').click();
(function wait() {
  const drawn = document.getElementById('scale').textContent;
  drawn ? requestAnimationFrame(() => done(performance.now() - begin)) : setTimeout(wait, 2);
})();
"""


def records_of(store: Path) -> Path:
    """Return the folder of a store's records, where `slatprep report` looks for it too."""
    found = found_manifests(store, open_store(store).about.manifest)
    if found is None:
        raise SystemExit(f"{store}: no records of it found")
    return Path(str(found))


def repeat_store(source: Path, folder: Path, assets: int, noise: float) -> tuple[Path, Path]:
    """Write a store of `assets` assets, those of `source` over and over, and its records."""
    known = records_of(source)
    store = open_store(source)
    chosen = list(islice(cycle(range(len(store))), assets))
    lengths = np.diff(store.offsets)[chosen]
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    ids = np.array([f"{number:05d}.{store.ids[k]}" for number, k in enumerate(chosen)])
    rng = np.random.default_rng(0)
    path = folder / "repeated.zarr"
    create_store(path, assets, int(offsets[-1]), StoreParameters(), store.contents)
    root = open_for_writing(path)
    root.attrs.update(store.group.attrs.asdict())
    for name in (layout.name for layout in ARRAYS):
        whole = store.group[name]
        if name in ("asset/id", "asset/offset"):
            root[name][:] = ids if name == "asset/id" else offsets
        elif name.startswith("asset/"):
            root[name][:] = whole[:][chosen]
        elif name.startswith("grid/"):
            for start in range(0, assets, 32):
                part = chosen[start : start + 32]
                root[name][start : start + len(part)] = np.stack([whole[k] for k in part])
        elif name == "voxel/feats":  # latents are not on the page, but a store has them
            root[name][:] = np.ones(root[name].shape, dtype=np.float32)
        else:
            rows = [whole[store.offsets[k] : store.offsets[k + 1]] for k in range(len(store))]
            values = np.concatenate([rows[k] for k in chosen])
            if noise and name == "voxel/properties":
                values += rng.normal(scale=noise, size=values.shape).astype(np.float32)
                np.clip(values, -1, 1, out=values)
            root[name][:] = values
    manifests = Path(str(manifests_of(path)))
    manifests.mkdir()
    shutil.copy(known / "build.json", manifests)
    with (known / "assets.jsonl").open(encoding="utf-8") as lines:
        records = {record["asset_id"]: record for record in map(json.loads, lines)}
    told = zip(ids, chosen, strict=True)
    texts = [json.dumps({**records[store.ids[k]], "asset_id": str(name)}) for name, k in told]
    root[RECORD_ARRAY][:] = np.array(texts, dtype=object)
    (manifests / "assets.jsonl").write_text("\n".join(texts) + "\n", encoding="utf-8")
    return path, manifests


def measure(page: Path) -> dict[str, float]:
    """Open a page in a fresh browser and return what it took, in milliseconds."""
    from selenium import webdriver

    with tempfile.TemporaryDirectory() as profile:
        options = webdriver.ChromeOptions()
        options.binary_location = shutil.which("chromium") or "chromium"
        for flag in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run",
                     "--disable-background-networking", "--use-angle=swiftshader",
                     "--enable-unsafe-swiftshader", "--force-prefers-reduced-motion",
                     "--window-size=1400,1000", f"--user-data-dir={profile}"):  # fmt: skip
            options.add_argument(flag)
        options.page_load_strategy = "normal"
        service = webdriver.ChromeService(shutil.which("chromedriver"))
        driver = webdriver.Chrome(options=options, service=service)
        try:
            driver.set_script_timeout(120)
            driver.get(page.as_uri())
            ready, loaded = driver.execute_script(
                "return [performance.getEntriesByName('slatprep-ready')[0].startTime,"
                "performance.timing.loadEventEnd - performance.timing.navigationStart]"
            )
            frame = driver.execute_async_script(SCROLL)
            opened = driver.execute_async_script(OPEN)
        finally:
            driver.quit()
    return {"ready": ready, "loaded": loaded, "longest frame": frame, "first 3D": opened}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("--assets", type=int, default=2000)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="copy the page here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        path, manifests = repeat_store(options.store, Path(name), options.assets, options.noise)
        begin = time.perf_counter()
        page = Path(name) / "page.html"
        summary = write_report(open_store(path), page, manifests=manifests, jobs=options.jobs)
        seconds = time.perf_counter() - begin
        print(f"{summary.assets} assets, 3D views of {summary.side}^3, noise {options.noise:g}")
        print(f"{'page':>14} {summary.size / 1e6:8.1f} MB, made in {seconds:.0f} s")
        runs = [measure(page) for _ in range(RUNS)]
        for key in runs[0]:
            values = [run[key] for run in runs]
            print(f"{key:>14} {statistics.median(values):8.0f} ms (most {max(values):.0f})")
        if options.keep:
            shutil.copy(page, options.keep)


if __name__ == "__main__":
    main()

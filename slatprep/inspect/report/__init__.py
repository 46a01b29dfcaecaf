"""Write the report on a dataset: a single HTML file that opens in a browser without a network.

It is a template with its style, its scripts and the data. Data cannot run as code: browsers do not
execute data blocks, and the page shows data only as text. A content security policy allows only
the page's own scripts, by their hashes, and no requests.
"""

from __future__ import annotations

import hashlib
import html
import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from operator import attrgetter
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from slatprep.errors import StoreError
from slatprep.inspect.report.content import Columns, build_of, page_content, told_by_records
from slatprep.inspect.report.drawn import COARSE, FULL, PER_SHEET, Drawn, draw_asset, sheet
from slatprep.inspect.tallies import Tally
from slatprep.inspect.verify import WORDS
from slatprep.pipeline.rows import SourceStore
from slatprep.records import Place, Verdict
from slatprep.storage.atomic import staged, writing
from slatprep.store.reader import Store
from slatprep.workers import Progress, counted
from slatprep.workers.local import run_unordered

__all__ = ["ReportSummary", "write_report"]

ASSETS_IN_DETAIL = 5_000
"""Largest number of assets with a thumbnail and a 3D view."""

ASSETS_LISTED = 50_000
"""Largest number of assets in the table; for a larger store it has only the assets in detail."""

VOXEL_BYTES = 36_000_000
"""Largest size in bytes of voxels at full detail, before base64 makes them a third larger."""


SCRIPTS = ("format", "data", "charts", "table", "viewer", "sections", "app")
"""Names of the page's own scripts; a script may use the scripts before it."""


@dataclass(frozen=True)
class ReportSummary:
    """The size and contents of a page.

    Attributes
    ----------
    path : Path
        The HTML file.
    size : int
        Size of the file in bytes.
    assets : int
        Number of assets of the build, in the store or not.
    listed : int
        Number of assets in the table: all, or a sample if there are more than `ASSETS_LISTED`.
    in_detail : int
        Number of assets with a thumbnail and a 3D view.
    side : int
        Voxels per edge of the 3D views: 64, or 32 if 64 would exceed `VOXEL_BYTES`.
    """

    path: Path
    size: int
    assets: int
    listed: int
    in_detail: int
    side: int


def write_report(
    store: Store,
    out: Path,
    *,
    manifests: Place | None = None,
    jobs: int = 1,
    progress: Progress | None = None,
) -> ReportSummary:
    """Write the report on a store.

    Parameters
    ----------
    store : Store
        Open store, from `slatprep.store.open_store`.
    out : Path
        The HTML file; an existing file is replaced when the new one is complete.
    manifests : Path, optional
        Folder of the build's records. Without them the page cannot say which assets are
        missing from the store, and why.
    jobs : int
        Worker processes. The page's bytes do not depend on it.
    progress : callable, optional
        Called with the number of assets done and the number of all assets.

    Returns
    -------
    ReportSummary
        Size and contents of the page.

    Raises
    ------
    StoreError
        If the store or its records cannot be read, or belong to different builds.
    """
    _refuse_other_words(store)
    chosen = _chosen(store)
    listed = range(len(store)) if len(store) <= ASSETS_LISTED else chosen
    built, told = None, dict[int, Columns]()
    if manifests is not None:
        built = build_of(manifests, store, ASSETS_LISTED)
        told = told_by_records(store, listed)
    drawn: list[Drawn] = []
    tallies: dict[str, Tally] = {}
    categories = list(map(str, store.column("category")))
    source = SourceStore(store)
    made = run_unordered(draw_asset, ((source, row) for row in chosen), jobs)
    for one, counts in counted(made, len(chosen), progress):
        drawn.append(one)
        category = categories[one.index]
        tallies[category] = tallies[category] + counts if category in tallies else counts
    drawn.sort(key=attrgetter("index"))
    full = sum(len(one.voxels[FULL]) for one in drawn)
    side = FULL if full <= VOXEL_BYTES else COARSE
    content = page_content(store, built, told, tallies, listed, drawn, side)
    with writing(str(out), Path(out).parent), staged(Path(out)) as temporary:
        with temporary.open("w", encoding="utf-8", newline="\n") as file:
            _write_page(file, content, drawn, side)
        size = temporary.stat().st_size
    total, in_table = content["all"]["assets"], len(content["assets"]["id"])
    return ReportSummary(Path(out), size, total, in_table, len(chosen), side)


def _refuse_other_words(store: Store) -> None:
    for name, words in WORDS.items():
        other = set(map(str, store.column(name))) - set(words)
        if other:
            raise StoreError(
                f"{store.path}/asset/{name}: {min(other)!r} is none of {', '.join(words)}, and "
                "cannot be drawn; run `slatprep verify`"
            )


def _chosen(store: Store) -> list[int]:
    """Return the rows of the assets shown in detail, at most `ASSETS_IN_DETAIL`."""
    total = len(store)
    if total <= ASSETS_IN_DETAIL:
        return list(range(total))
    # Up to half are assets that are not good; the others are at even steps through the store.
    doubtful = np.flatnonzero(store.column("verdict") != str(Verdict.GOOD))
    doubtful = doubtful[: ASSETS_IN_DETAIL // 2]
    spread = np.linspace(0, total - 1, ASSETS_IN_DETAIL - len(doubtful)).round().astype(int)
    return [int(index) for index in np.union1d(doubtful, spread)]


def _write_page(
    file: TextIO, content: Mapping[str, Any], drawn: Sequence[Drawn], side: int
) -> None:
    """Write a page from `page_content`, with `drawn` assets at `side` voxels per edge."""
    sheets = [drawn[start : start + PER_SHEET] for start in range(0, len(drawn), PER_SHEET)]
    style = _asset("style.css")
    script = "\n".join(_asset("js", f"{name}.js") for name in SCRIPTS)
    library = _asset("vendor", "three.min.js")
    policy = (
        "default-src 'none'; img-src blob:; base-uri 'none'; form-action 'none'; "
        f"style-src {_hash(style)}; script-src {_hash(script)} {_hash(library)}"
    )
    head, body = _asset("page.html").split("{{content}}")
    title = html.escape(str(content["title"]))
    for name, text in (("style", style), ("policy", policy), ("title", title)):
        head = head.replace(f"{{{{{name}}}}}", text)
    file.write(head)
    # The table's data precede the pictures, so the table works while the browser reads these.
    _block(file, "content", "application/json", _json(content))
    file.write(f"<script>{script}</script>\n")
    _block(file, "library", "text/plain", library)
    for number, own in enumerate(sheets):
        png = sheet([one.thumbnail for one in own])
        _block(file, f"sheet-{number}", "text/plain", b64encode(png).decode("ascii"))
    for number, own in enumerate(sheets):
        pack = (b64encode(one.voxels[side]).decode() for one in own)
        _block(file, f"pack-{number}", "text/plain", "\n".join(pack))
    file.write(body)


def _json(content: Mapping[str, Any]) -> str:
    """Return JSON without characters that could end its block."""
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _block(file: TextIO, name: str, kind: str, text: str) -> None:
    """Write a block of data, which browsers do not execute."""
    if "</script" in text.lower() or "<!--" in text:
        raise ValueError(f"the block {name} would end before its end")
    file.write(f'<script type="{kind}" id="{name}">{text}</script>\n')


def _hash(text: str) -> str:
    return f"'sha256-{b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _asset(*path: str) -> str:
    return resources.files("slatprep.inspect.report").joinpath("assets", *path).read_text("utf-8")

"""The page as text: one template, its style and scripts, and the data, all inside.

Whatever comes from data stays data: it lies in blocks that no browser runs,
is shown as text alone, and a content security policy lists the page's own
scripts by their hash, so that nothing else could run, and nothing be fetched.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Iterable, Mapping
from importlib import resources
from typing import Any, TextIO

SCRIPTS = ("format", "data", "charts", "table", "viewer", "sections", "app")
"""The page's own scripts, each of which uses those before it."""


def write_page(
    file: TextIO,
    title: str,
    content: Mapping[str, Any],
    sheets: Iterable[bytes],
    packs: Iterable[list[str]],
) -> None:
    """Write a page.

    Parameters
    ----------
    file : text file
        Open for writing in UTF-8, with plain line feeds.
    title : str
        Of the page.
    content : mapping
        From `slatprep.inspect.report.content.page_content`.
    sheets : iterable of bytes
        PNG files of thumbnails.
    packs : iterable of list of str
        For each sheet, its assets' voxels in base64.
    """
    style = _asset("style.css")
    script = "\n".join(_asset("js", f"{name}.js") for name in SCRIPTS)
    library = _asset("vendor", "three.min.js")
    policy = (
        "default-src 'none'; img-src blob:; base-uri 'none'; form-action 'none'; "
        f"style-src {_hash(style)}; script-src {_hash(script)} {_hash(library)}"
    )
    head, body = _asset("page.html").split("{{content}}")
    for name, text in (("style", style), ("policy", policy), ("title", html.escape(title))):
        head = head.replace(f"{{{{{name}}}}}", text)
    file.write(head)
    # The table can be used while the pictures below it are still being read.
    _block(file, "content", "application/json", _json(content))
    file.write(f"<script>{script}</script>\n")
    _block(file, "library", "text/plain", library)
    for number, png in enumerate(sheets):
        _block(file, f"sheet-{number}", "text/plain", base64.b64encode(png).decode("ascii"))
    for number, pack in enumerate(packs):
        _block(file, f"pack-{number}", "text/plain", "\n".join(pack))
    file.write(body)


def _json(content: Mapping[str, Any]) -> str:
    """Return JSON that no string inside can end the block of."""
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _block(file: TextIO, name: str, kind: str, text: str) -> None:
    """Write a block of data, which a browser keeps and does not run."""
    if "</script" in text.lower() or "<!--" in text:
        raise ValueError(f"the block {name} would end before its end")
    file.write(f'<script type="{kind}" id="{name}">{text}</script>\n')


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _asset(*path: str) -> str:
    return resources.files("slatprep.inspect.report").joinpath("assets", *path).read_text("utf-8")

"""The page as text: a template with its style, its scripts and the data.

Data cannot run as code: browsers do not execute its blocks, and the page shows it only as text. A
content security policy allows the page's own scripts by their hashes, and no requests.
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
"""The page's own scripts; each may use those before it."""


def write_page(
    file: TextIO,
    title: str,
    content: Mapping[str, Any],
    sheets: Iterable[bytes],
    packs: Iterable[list[str]],
) -> None:
    """Write a page to a UTF-8 file with plain line feeds.

    `content` is from `slatprep.inspect.report.content.page_content`. `sheets` are PNG files of
    thumbnails; `packs` has for each of them the voxels of its assets in base64.
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
    # The data come first, so that the table works while the browser still reads the pictures.
    _block(file, "content", "application/json", _json(content))
    file.write(f"<script>{script}</script>\n")
    _block(file, "library", "text/plain", library)
    for number, png in enumerate(sheets):
        _block(file, f"sheet-{number}", "text/plain", base64.b64encode(png).decode("ascii"))
    for number, pack in enumerate(packs):
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
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _asset(*path: str) -> str:
    return resources.files("slatprep.inspect.report").joinpath("assets", *path).read_text("utf-8")

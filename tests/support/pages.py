"""A page taken apart, and strings that try to break it."""

import json
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

HOSTILE = '</script><img src=x onerror="window.broken = 1"><!--\'&amp;'
"""Ends a script block, starts an element and a comment, and runs if it is ever markup."""


class Page(HTMLParser):
    """A page taken apart: its blocks of script by id or number, and its elements."""

    def __init__(self, path: Path) -> None:
        super().__init__(convert_charrefs=True)
        self.path = path
        self.blocks: dict[str, tuple[str, str]] = {}
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self._open: tuple[str, str] | None = None
        self.feed(path.read_text("utf-8"))
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        self.elements.append((tag, attributes))
        if tag in ("script", "style"):
            name = attributes.get("id") or f"{tag}-{len(self.blocks)}"
            self._open = (name, attributes.get("type") or tag)
            self.blocks[name] = (self._open[1], "")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("script", "style"):
            self._open = None

    def handle_data(self, data: str) -> None:
        if self._open:
            name, kind = self._open
            self.blocks[name] = (kind, self.blocks[name][1] + data)

    @property
    def content(self) -> dict[str, Any]:
        """Return the data of the page."""
        return dict(json.loads(self.blocks["content"][1]))


@dataclass(frozen=True)
class Report:
    """A store and its page."""

    store: Path
    manifests: Path
    path: Path

"""Write the tutorial as a notebook, to standard output: into examples/tutorial.ipynb.

Its text and code are those of docs/tutorial.md, which the tests run, so the two
cannot say different things; the tests compare them.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "tutorial.md"

_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.M | re.S)
_LINK = re.compile(r"\]\((?!https?:)([\w./#-]+)\)")


def notebook(page: str) -> str:
    """Return a page as a notebook: its Python as cells, its shell as cells of ``%%sh``."""
    cells: list[dict[str, object]] = []

    def add(kind: str, text: str) -> None:
        if text := text.strip("\n"):
            extra = {"execution_count": None, "outputs": []} if kind == "code" else {}
            lines = text.splitlines(keepends=True)
            name = f"cell-{len(cells)}"
            cells.append({"cell_type": kind, "id": name, "metadata": {}, **extra, "source": lines})

    end = 0
    for block in _BLOCK.finditer(page):
        add("markdown", _LINK.sub(r"](../docs/\1)", page[end : block.start()]))
        language, text = block.groups()
        if language != "text":  # What is printed a notebook shows itself.
            add("code", f"%%sh\n{text}" if language == "sh" else text)
        end = block.end()
    add("markdown", _LINK.sub(r"](../docs/\1)", page[end:]))
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    document = {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4,
                "nbformat_minor": 5}  # fmt: skip
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    sys.stdout.write(notebook(PAGE.read_text("utf-8")))

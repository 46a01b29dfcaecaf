"""Run the tutorial as a notebook, and write it with its outputs: examples/tutorial.ipynb.

Its text and code come from docs/tutorial.md, which the tests run and compare with
the notebook. Pictures are reduced in size.
"""

from __future__ import annotations

import base64
import io
import json
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "tutorial.md"
NOTEBOOK = ROOT / "examples" / "tutorial.ipynb"
WIDTH = 1000
"""Largest width of a picture, in pixels."""

_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.M | re.S)
_LINK = re.compile(r"\]\((?!https?:)([\w./#-]+)\)")


def notebook(page: str) -> str:
    """Return a page as a notebook: Python as cells, shell commands as ``%%sh`` cells."""
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
        if language != "text":  # A notebook shows printed output itself.
            add("code", f"%%sh\n{text}" if language == "sh" else text)
        end = block.end()
    add("markdown", _LINK.sub(r"](../docs/\1)", page[end:]))
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    document = {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4,
                "nbformat_minor": 5}  # fmt: skip
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def run(text: str, folder: Path) -> str:
    """Run a notebook in a folder; return it with the printed output and pictures of its cells."""
    import nbformat
    from nbclient import NotebookClient

    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = nbformat.reads(text, as_version=4)
    patient = {"timeout": None, "startup_timeout": 600, "iopub_timeout": 600}
    NotebookClient(done, resources={"metadata": {"path": str(folder)}}, **patient).execute()
    shown: dict[str, list[Any]] = {}
    for cell in done.cells:
        outputs = [one for one in cell.get("outputs", []) if one.get("name") != "stderr"]
        for one in outputs:
            if picture := one.get("data", {}).get("image/png"):
                one["data"] = {"image/png": small(picture)}
        shown[cell.id] = outputs
    document = json.loads(text)
    for number, cell in enumerate(c for c in document["cells"] if c["cell_type"] == "code"):
        cell |= {"execution_count": number + 1, "outputs": shown[cell["id"]]}
        for one in cell["outputs"]:
            if "execution_count" in one:
                one["execution_count"] = number + 1
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def small(picture: str) -> str:
    """Return a base64 PNG reduced to at most `WIDTH` pixels of width and 128 colours."""
    from PIL import Image

    image = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")
    image.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    made = io.BytesIO()
    image.quantize(128).save(made, "PNG", optimize=True)
    return base64.b64encode(made.getvalue()).decode()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        NOTEBOOK.write_text(run(notebook(PAGE.read_text("utf-8")), Path(scratch)), "utf-8")

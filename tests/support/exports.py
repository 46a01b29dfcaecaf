"""What is in an export."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def index_of(directory: Path) -> list[dict[str, Any]]:
    return json.loads((directory / "index.json").read_text("utf-8"))["assets"]


def bytes_of(path: Path) -> dict[str, bytes]:
    if path.is_file():
        return {"": path.read_bytes()}
    return {file.name: file.read_bytes() for file in path.iterdir()}

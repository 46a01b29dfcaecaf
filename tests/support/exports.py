"""What is in an export."""

import json
from pathlib import Path
from typing import Any


def index_of(directory: Path) -> list[dict[str, Any]]:
    return json.loads((directory / "index.json").read_text("utf-8"))["assets"]


def bytes_of(path: Path) -> dict[str, bytes]:
    if path.is_file():
        return {"": path.read_bytes()}
    files = (file for file in path.rglob("*") if file.is_file())
    return {file.relative_to(path).as_posix(): file.read_bytes() for file in files}

"""What lies in a directory or on an object store, and what a build's records say."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any


def tree(directory: Path | None) -> dict[str, str]:
    """Return the hash of every file below a directory."""
    assert directory is not None
    return {
        path.relative_to(directory).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in directory.rglob("*")
        if path.is_file()
    }


def contents(s3: Any, place: str) -> dict[str, str]:
    """Return the hash of every object below a place, by its name relative to that."""
    base = place.removeprefix("s3://").rstrip("/") + "/"
    return {
        name.removeprefix(base): hashlib.sha256(s3.cat_file(name)).hexdigest()
        for name in s3.find(base)
    }


def records_of(lines: Path) -> dict[str, dict[str, Any]]:
    """Return the records of a build by their asset's id: lines, in their order, and the failed."""
    records = list(map(json.loads, lines.read_text("utf-8").splitlines()))
    build = lines.with_name("build.json")
    if lines.name == "assets.jsonl" and build.exists():
        records += json.loads(build.read_text("utf-8"))["failed"]
    return {record["asset_id"]: record for record in records}

"""What lies in a directory or on an object store, and what a build's records say."""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any


def files_below(place: Path | None) -> dict[str, Path]:
    """Return every file below a directory by its name relative to that, or the one file itself."""
    assert place is not None
    below = [place] if place.is_file() else filter(Path.is_file, place.rglob("*"))
    return {path.relative_to(place).as_posix(): path for path in below}


def tree(place: Path | None) -> dict[str, str]:
    """Return the hash of every file below a directory, or of a file."""
    return {name: digest(path.read_bytes()) for name, path in files_below(place).items()}


def copied(store: Path, to: Path) -> Path:
    """Copy a store and its records: what is built on it need not be aligned again."""
    shutil.copytree(store.with_suffix(".manifests"), to.with_suffix(".manifests"))
    return Path(shutil.copytree(store, to))


def inodes(directory: Path) -> dict[str, int]:
    """Return the inode of every file below a directory."""
    return {name: path.stat().st_ino for name, path in files_below(directory).items()}


def contents(s3: Any, place: str) -> dict[str, str]:
    """Return the hash of every object below a place, by its name relative to that."""
    base = place.removeprefix("s3://").rstrip("/") + "/"
    found = s3.find(base, detail=True)
    # The ETag of what came in one part is the hash of what lies there.
    tags = {name: about["ETag"].strip('"') for name, about in found.items()}
    return {
        name.removeprefix(base): digest(s3.cat_file(name)) if "-" in tag else tag
        for name, tag in tags.items()
    }


def digest(data: bytes) -> str:
    return hashlib.md5(data, usedforsecurity=False).hexdigest()


def records_of(lines: Path) -> dict[str, dict[str, Any]]:
    """Return the records of a build by their asset's id: lines, in their order, and the failed."""
    records = list(map(json.loads, lines.read_text("utf-8").splitlines()))
    build = lines.with_name("build.json")
    if lines.name == "assets.jsonl" and build.exists():
        records += json.loads(build.read_text("utf-8"))["failed"]
    return {record["asset_id"]: record for record in records}


def records_beside(store: Path) -> dict[str, dict[str, Any]]:
    """Return the records of the build of a store."""
    return records_of(store.with_suffix(".manifests") / "assets.jsonl")

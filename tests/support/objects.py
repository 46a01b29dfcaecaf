"""What lies on an object store."""

from __future__ import annotations

import hashlib
from typing import Any


def contents(s3: Any, place: str) -> dict[str, str]:
    """Return the hash of every object below a place, by its name relative to that."""
    base = place.removeprefix("s3://").rstrip("/") + "/"
    return {
        name.removeprefix(base): hashlib.sha256(s3.cat_file(name)).hexdigest()
        for name in s3.find(base)
    }

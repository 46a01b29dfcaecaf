"""File names from ids, and paths from the names of an archive's members."""

from __future__ import annotations

import hashlib
from urllib.parse import quote

_LONGEST_NAME = 180


def file_name(asset_id: str, *, dots: bool = True) -> str:
    """Return a file name for an asset of any id, without suffix.

    Plain ids stay unchanged. Characters that mean something to a shell, an archive or a file system
    are percent-encoded, as are a leading sign and, without `dots`, dots. Names that would be too
    long end in a hash.

    >>> file_name("0a1b2c.front"), file_name("0a1b2c.front", dots=False)
    ('0a1b2c.front', '0a1b2c%2Efront')
    >>> file_name("../a b"), file_name("-rf")
    ('%2E.%2Fa%20b', '%2Drf')
    """
    name = quote(asset_id, safe="") or "%"
    if not dots:
        name = name.replace(".", "%2E")
    if name.startswith((".", "_", "-", "~")):
        name = f"%{ord(name[0]):02X}{name[1:]}"
    if len(name) > _LONGEST_NAME:
        digest = hashlib.sha256(asset_id.encode()).hexdigest()[:32]
        name = f"{name[:_LONGEST_NAME]}~{digest}"
    return name


def plain_name(name: str) -> str:
    """Return the name of a member as a path below a folder; empty if it could be none."""
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if name.startswith("/") or ".." in parts or "\\" in name or "\0" in name:
        return ""
    return "/".join(parts)

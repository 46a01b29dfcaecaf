"""Where an export goes: complete, or not at all, and never over something else."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import orjson

from slatprep.errors import ConfigError, SlatprepError
from slatprep.storage.atomic import replace_directory, staged

FORMAT = "slatprep-export"
FORMAT_VERSION = 1
INDEX = "index.json"
"""Name of the file that says what is in an exported directory."""


@contextmanager
def directory(out: Path) -> Iterator[Path]:
    """Yield a new directory that takes the place of `out` when all went well.

    Raises
    ------
    ConfigError
        If `out` is there and is neither empty nor an export.
    SlatprepError
        If nothing can be written there.
    """
    # What a link points at is replaced, not the link.
    out = out.resolve()
    if out.exists() and not _may_be_replaced(out):
        raise _not_an_export(out)
    with _writable(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        new = work / "export"
        new.mkdir()
        with _writable(out):
            yield new
            replace_directory(new, out)
    finally:
        shutil.rmtree(work, ignore_errors=True)


@contextmanager
def file(out: Path, is_export: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield a new file that takes the place of `out` when all went well.

    Raises
    ------
    ConfigError
        If `out` is there and is no export.
    SlatprepError
        If nothing can be written there.
    """
    out = out.resolve()
    if out.exists() and not (out.is_file() and is_export(out)):
        raise _not_an_export(out)
    with _writable(out), staged(out) as path:
        yield path


def write_index(path: Path, about: dict[str, Any], entries: Sequence[dict[str, Any]]) -> None:
    """Write what an exported directory holds, one asset a line."""
    head = orjson.dumps(about, option=orjson.OPT_INDENT_2).removesuffix(b"\n}")
    rows = b",\n    ".join(map(orjson.dumps, entries))
    (path / INDEX).write_bytes(head + b',\n  "assets": [\n    ' + rows + b"\n  ]\n}\n")


def _may_be_replaced(out: Path) -> bool:
    if not out.is_dir():
        return False
    if not any(out.iterdir()):
        return True
    try:
        index = json.loads((out / INDEX).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(index, dict) and index.get("format") == FORMAT


def _not_an_export(out: Path) -> ConfigError:
    return ConfigError(
        f"{out} exists and is not an export of slatprep; expected an export to replace, "
        "or a new path"
    )


@contextmanager
def _writable(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SlatprepError(
            f"{out}: cannot write there ({error.strerror or error}); nothing was replaced"
        ) from error

"""The target of an export: written completely or not at all, and never over other files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

import orjson

from slatprep.errors import ConfigError, StoreError
from slatprep.storage.atomic import (
    flush,
    flush_tree,
    replace_directory,
    staged,
    telling_if_stopped,
    writing,
)
from slatprep.storage.work import scratch_beside

FORMAT = "slatprep-export"
FORMAT_VERSION = 1
INDEX = "index.json"
"""Name of the file that lists the contents of an exported folder."""


@contextmanager
def directory(out: Path, kind: str) -> Iterator[Path]:
    """Yield a new empty folder that replaces `out` on success.

    If `out` holds other files beside an export, only the export's files are replaced, one by one.
    ConfigError if `out` is neither empty nor an export of the same kind, or another file has the
    name of a new one.
    StoreError if it cannot be written, or another export is writing it.
    """
    # A link stays; its target is replaced.
    out = out.resolve()
    # The finished assets of an interrupted build to this path stay.
    told, work = list[str](), scratch_beside(out, "export")
    with telling_if_stopped(told), work as scratch, writing(str(out), out.parent):
        own = _files_of_export(out, kind)
        new = scratch / "export"
        new.mkdir()
        yield new
        if out.exists() and (others := set(_names_below(out)) - own):
            told.append(f"{out} holds files of the old export, the new one, or both; run it again")
            try:
                _replace_files(new, out, own, others)
            except OSError as error:
                raise StoreError(f"{error.strerror}: {told[0]}") from None
        else:
            told.append(_whole(out))
            replace_directory(new, out)


@contextmanager
def file(out: Path, is_export: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield the path of a new file that replaces `out` on success.

    Raises ConfigError if `out` exists and `is_export` denies it, SlatprepError if writing fails.
    """
    out = out.resolve()
    if out.exists() and not (out.is_file() and is_export(out)):
        raise _not_an_export(out, "file")
    told: list[str] = []
    with telling_if_stopped(told), writing(str(out), out.parent), staged(out) as path:
        yield path
        told.append(_whole(out))


def _whole(out: Path) -> str:
    """Return in which state an export is while it replaces what is at `out`."""
    old = "the old one" if out.exists() else "not there"
    return f"{out} is the new export, whole, or {old}; run it again"


def write_index(path: Path, about: dict[str, Any], entries: Sequence[dict[str, Any]]) -> None:
    """Write the index of an exported folder, with a line for each asset."""
    head = orjson.dumps(about, option=orjson.OPT_INDENT_2).removesuffix(b"\n}")
    rows = b",\n    ".join(map(orjson.dumps, entries))
    (path / INDEX).write_bytes(head + b',\n  "assets": [\n    ' + rows + b"\n  ]\n}\n")


def _files_of_export(out: Path, kind: str) -> frozenset[str]:
    """Return the names of an export's files and folders; none if there is nothing.

    ConfigError if it is no export, or one of another kind, which the user hardly wants to lose.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return frozenset()
    try:
        index = json.loads((out / INDEX).read_text(encoding="utf-8"))
        if index["format"] != FORMAT:
            raise ValueError
        there = index["kind"]
        names = [*index.get("files", ()), *(entry["file"] for entry in index["assets"])]
        files = [PurePosixPath(name) for name in names]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise _not_an_export(out, "folder") from None
    if there != kind:
        raise ConfigError(
            f"{out} has an export in another format, {there}; expected one in {kind} to replace, "
            "or a new path"
        )
    folders = (str(parent) for file in files for parent in file.parents[:-1])
    return frozenset({INDEX, *map(str, files), *folders})


def _names_below(directory: Path) -> Iterator[str]:
    """Yield the names of all files and folders below a folder; links are not followed."""
    for parent, folders, files in os.walk(directory):
        for name in (*folders, *files):
            yield Path(parent, name).relative_to(directory).as_posix()


def _replace_files(new: Path, out: Path, own: frozenset[str], others: set[str]) -> None:
    """Replace the files of an old export by those of a new one; keep all other files."""
    names = sorted(_names_below(new), key=lambda name: (name == INDEX, name))
    folders = {name for name in names if (new / name).is_dir()}
    there = {name for name in names if (out / name).is_dir() and not (out / name).is_symlink()}
    if taken := sorted(others.intersection(names) - (folders & there) | there - folders):
        raise ConfigError(
            f"{out / taken[0]} is of no export of slatprep, and the new export has a "
            "file of this name; move it away, or export to a new path"
        )
    flush_tree(new)
    own = own.intersection(_names_below(out))  # The index may contain any path.
    # If this is stopped, the next export knows the files of both, and a reader finds no asset.
    index = json.loads((new / INDEX).read_bytes())
    there_now = {"assets": [], "files": sorted(own.union(names) - {INDEX})}
    with staged(out / INDEX) as path:
        path.write_text(json.dumps(index | there_now))
    for name in names[:-1]:
        if name not in folders:
            (new / name).replace(out / name)
        elif name not in there:
            (out / name).unlink(missing_ok=True)
            (out / name).mkdir()
    for name in sorted(own.difference(names), reverse=True):  # Files before their folders.
        if (out / name).is_dir():
            with suppress(OSError):  # Other files lie in it.
                (out / name).rmdir()
        else:
            (out / name).unlink()
    (new / INDEX).replace(out / INDEX)
    flush(out)


def _not_an_export(out: Path, wanted: str) -> ConfigError:
    there = "folder" if out.is_dir() else "file"
    if there != wanted:
        return ConfigError(
            f"{out} exists and is a {there}, but this format writes a {wanted}; expected a new path"
        )
    return ConfigError(
        f"{out} exists and is not an export of slatprep; expected an export to replace, "
        "or a new path"
    )

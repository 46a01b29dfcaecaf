"""A fingerprint of the code that makes an asset's numbers.

Work done by other code must be done again, but a new command, a new comment
or a new release must not cost a day of alignment. So the fingerprint covers
only the modules that the stages read, align, sample and judge can reach, and
the JSON files of the same names. It covers statements, without comments, layout
and docstrings, those of constants included.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

ROOMS = ("align", "geometry", "judge", "readers", "records")
"""Rooms that the stages reach, and whose modules make an asset's numbers."""

# Parameters enter an asset's key as values, so their defaults may change. Errors are words, and a
# record only holds numbers. Digests identify bytes, however these come from a disk or a network.
ALONE = (
    "slatprep.normalize",
    "slatprep.pipeline.annotate",
    "slatprep.sample",
    "slatprep.storage.chunks",
)
"""Modules that do so in other places."""

PACKING = (
    "slatprep.normalize",
    "slatprep.pipeline.pack",
    "slatprep.pipeline.passes",
    "slatprep.pipeline.recipe",
    "slatprep.pipeline.rows",
    "slatprep.pipeline.settle",
    "slatprep.pipeline.spool",
    "slatprep.store.attributes",
    "slatprep.store.layout",
    "slatprep.store.record_json",
    "slatprep.store.shard_writer",
    "slatprep.store.writer",
)
"""Modules that make ranges, settle ties, and pack rows and records; their imports do not count."""


@lru_cache(maxsize=1)
def packing_fingerprint() -> str:
    """Return the beginning of the SHA-256, in hex, of the statements of `PACKING`.

    Rows that were packed by other code are packed anew, but their assets are not aligned again.
    """
    return _digest_of(map(_source, PACKING))[:16]


@lru_cache(maxsize=1)
def code_fingerprint() -> str:
    """Return the SHA-256, in hex, of the statements of `numeric_modules`."""
    return _digest_of(numeric_modules().values())


def _digest_of(modules: Iterable[Path]) -> str:
    """Digest the statements of modules, and the JSON file of a module's name beside it."""
    digest = hashlib.sha256()
    for path in modules:
        digest.update(f"{_dump(_parsed(path.read_bytes()))}\n".encode())
        with suppress(FileNotFoundError):
            digest.update(path.with_suffix(".json").read_bytes())
    return digest.hexdigest()


def numeric_modules() -> dict[str, Path]:
    """Return the modules of `ROOMS` and `ALONE`, sorted, and their files."""
    found = {name: _source(name) for name in ALONE}
    for room in ROOMS:
        for path in _source(f"slatprep.{room}").parent.glob("*.py"):
            found[f"slatprep.{room}.{path.stem}".removesuffix(".__init__")] = path
    return dict(sorted(found.items()))


def _source(name: str) -> Path:
    # Not by importlib, which would import and compile the package of the name.
    place = Path(__file__).parents[1].joinpath(*name.split(".")[1:])
    return place / "__init__.py" if place.is_dir() else place.with_name(f"{place.name}.py")


def _parsed(text: bytes) -> ast.Module:
    """Return a module without docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [one for one in node.body if not _is_text(one)]
    return tree


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def _dump(node: object) -> str:
    """Write a tree as `ast.dump` does, but alike under every Python.

    Newer versions have more fields, which are empty for older syntax, and leave
    out some empty fields. So all empty fields are left out here.
    """
    if isinstance(node, ast.AST):
        values = [(name, getattr(node, name, None)) for name in node._fields]
        fields = [f"{name}={_dump(v)}" for name, v in values if v is not None and v != []]
        return f"{type(node).__name__}({', '.join(fields)})"
    if isinstance(node, list):
        return f"[{', '.join([_dump(one) for one in node])}]"
    return ascii(node)  # repr() depends on the version of Unicode in this Python.

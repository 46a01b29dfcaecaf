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
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

STAGES = (
    "slatprep.readers",
    "slatprep.align",
    "slatprep.sample",
    "slatprep.judge",
    "slatprep.pipeline.annotate",
)
"""Modules that make an asset's numbers; a package stands for all of its modules."""

# These make no numbers. Parameters enter an asset's key as values, so their
# defaults may change. Errors are words, and a record only holds numbers. The
# package itself has only the version.
_NOT_NUMBERS = (
    "slatprep",
    "slatprep.errors",
    "slatprep.parameters",
    "slatprep.store.record",
    "slatprep.workers",
    "slatprep.workers.local",
)

# Digests identify bytes, however these come from a disk or a network. But these
# modules make values from bytes.
_DECODING = ("slatprep.storage.chunks",)

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
    return _digest_of(map(_module, PACKING))[:16]


@lru_cache(maxsize=1)
def code_fingerprint() -> str:
    """Return the SHA-256, in hex, of the statements of `numeric_modules`."""
    digest = _digest_of(numeric_modules().values())
    _parsed.cache_clear()  # Trees are large.
    return digest


def _digest_of(modules: Iterable[Path]) -> str:
    """Digest the statements of modules, and the JSON file of a module's name beside it."""
    digest = hashlib.sha256()
    for path in modules:
        digest.update(f"{_dump(_parsed(path.read_bytes()))}\n".encode())
        with suppress(FileNotFoundError):
            digest.update(path.with_suffix(".json").read_bytes())
    return digest.hexdigest()


def numeric_modules() -> dict[str, Path]:
    """Return the modules that `STAGES` reach by imports, sorted, and their files."""
    found: dict[str, Path] = {}
    waiting = list(STAGES)
    while waiting:
        name = waiting.pop()
        carries = name.startswith("slatprep.storage") and name not in _DECODING
        # A name that is no module is defined in one, as in `from slatprep.records import Verdict`.
        path = _module(name) if name in STAGES else _source(name)
        if name in found or name in _NOT_NUMBERS or carries or path is None:
            continue
        found[name] = path
        if path.name == "__init__.py":
            waiting += [f"{name}.{module.stem}" for module in path.parent.glob("[!_]*.py")]
        waiting += _imports(path)
    return dict(sorted(found.items()))


def _module(name: str) -> Path:
    path = _source(name)
    if path is None:
        raise ValueError(f"{name} is no module of slatprep")
    return path


def _source(name: str) -> Path | None:
    # Not by importlib, which would import and compile the package of the name.
    place = Path(__file__).parents[1].joinpath(*name.split(".")[1:])
    files = (place.with_name(f"{place.name}.py"), place / "__init__.py")
    return next((file for file in files if file.is_file()), None)


@lru_cache(maxsize=256)
def _parsed(text: bytes) -> ast.Module:
    """Return a module without docstrings; the cache serves the second call."""
    tree = ast.parse(text)
    for node in _statements(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [one for one in node.body if not _is_text(one)]
    return tree


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def _imports(path: Path) -> Iterator[str]:
    for node in _statements(_parsed(path.read_bytes())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("slatprep"):
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("slatprep"))


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and every statement in it, in less time than `ast.walk` takes."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.expr):  # An expression holds no statement.
            yield from _statements(child)


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
